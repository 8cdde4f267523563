"""Numbers of commands: those of a vehicle that rejoins follow all that it can have given, however long the run."""

import numpy as np
import pytest
from constellation_fakes import FakeContext, parameters, tell, tick
from test_device_commands import BODY, THRUSTER, VALVE, Valve

from madns_runtime.plugin.api import Tick
from madns_runtime.simulations.constellation.agent import ConstellationAgent
from madns_runtime.simulations.constellation.command_numbers import (
    COMMANDS_MAX,
    DEVICE_NUMBER_FIRST,
    first_number,
    is_of_device,
)
from madns_runtime.simulations.constellation.messages import (
    Command,
    CommandResult,
    Initial,
    Segment,
)
from madns_runtime.simulations.constellation.truth.maneuvers.actuators import number_fault

HZ = 100.0
DAY_S = 86_400.0
GUIDANCE = """
class Guidance:
    heard = []
    def setup(self, context):
        self.context = context
        self.first_number = context.first_number
    def step(self, t_s, readings):
        self.number = self.context.delta_v((0.0, 0.1, 0.0), at_s=t_s + 1.0)
    def command_result(self, result):
        self.heard.append(result.number)
    def finish(self):
        return {"first_number": self.first_number, "heard": self.heard}
"""


class Rejoined:
    """A vehicle with flight software and a device that commands, which rejoins its run at some time."""

    def __init__(self, folder, joined_s):
        (folder / "guidance.py").write_text(GUIDANCE)
        vehicle = {"thruster": THRUSTER, "attitude": BODY, "actuation": [VALVE]}
        self.valve = Valve([])
        self.context = FakeContext(
            "agent-01",
            ("agent-01",),
            parameters(vehicles=[vehicle], flight={"software": "guidance.py:Guidance"}),
            tick_hz=HZ,
            duration_s=1e9,
            base_directory=folder,
            clock_s=joined_s,
            hardware={"valve": self.valve},
        )
        self.valve.now_s = self.context.now_s
        states = np.full((11, 6), 7e6)
        segment = Segment(revision=0, t0_s=joined_s, knot_s=1.0, states=states)
        first = Initial(
            satellite="S", frame="TEME", epoch_utc="2026-01-01T00:00:00Z", segment=segment
        )
        self.agent = ConstellationAgent()
        self.agent.setup(self.context, first.to_message())
        self.index = round(joined_s * HZ)

    def tick(self):
        t_s = self.context.clock_s = self.index / HZ
        tick(self.agent, Tick(self.index, t_s, 1.0 / HZ, 0.0, 0))
        self.index += 1
        sent, self.context.sent = self.context.sent, []
        return [Command.from_message(message) for _, _, message in sent]


@pytest.mark.parametrize("days", [0.0, 7.0, 7.75, 16.0, 10_000.0])
def test_commands_of_a_vehicle_that_rejoins_late_are_taken_and_their_results_told(tmp_path, days):
    ship = Rejoined(tmp_path, days * DAY_S)
    ship.tick()
    ship.valve.samples.append((ship.context.clock_s, 1.0))

    own, device = ship.tick()
    for command in (own, device):
        result = CommandResult(
            number=command.number, status="accepted", at_s=command.at_s, revision=1
        )
        tell(ship.agent, result.to_message())
    ship.tick()

    assert (number_fault(own), number_fault(device)) == ("", "")
    told = ship.agent.finish()
    assert told["flight"]["heard"] == [own.number] == [told["flight"]["first_number"] + 1]
    assert [row[1] for row in ship.context.records["command_results"]] == [
        own.number,
        device.number,
    ]


def test_numbers_of_runs_that_nobody_rejoins_late_are_as_ever_and_no_two_are_the_same():
    given = [0, 16, 2**29, 2**30 - 2**24, 2**30 - 2**24 + 16, 2**30, 2**31, 2**40]

    own = [first_number(count) for count in given]
    devices = [first_number(count, of_device=True) for count in given]

    assert own[:4] == given[:4]
    assert devices[:4] == [DEVICE_NUMBER_FIRST + count for count in given[:4]]
    for numbers, is_device in ((own, False), (devices, True)):
        assert numbers == sorted(set(numbers))
        assert [is_of_device(number) for number in numbers] == [is_device] * len(numbers)
    assert max(own + devices) < COMMANDS_MAX


def test_a_number_out_of_bounds_is_refused_with_both_of_them():
    command = Command(
        number=COMMANDS_MAX, kind="delta_v", commanded_s=0.0, at_s=1.0, frame="rtn",
        vector=(0.0, 1.0, 0.0),
    )  # fmt: skip

    assert number_fault(command) == f"expected a number from 0 on below {2**53}, got {2**53}"
