"""Commands of devices: from a channel's sample to truth, by the rules of flight software's commands."""

import math

import pytest
from constellation_fakes import Star, parameters

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.device_view import ChannelReading
from madns_runtime.simulations.constellation.actuation import Actuation, actuation_faults
from madns_runtime.simulations.constellation.check import device_uses, find_faults
from madns_runtime.simulations.constellation.command_numbers import DEVICE_NUMBER_FIRST
from madns_runtime.simulations.constellation.vehicle.device_commands import DeviceCommands

BODY = {
    "inertia_kg_m2": [1.0, 1.2, 0.9],
    "wheels": {"torque_n_m_max": 0.1, "momentum_n_m_s_max": 1.0},
    "magnetorquers": {"dipole_a_m2_max": 5.0},
}
THRUSTER = {"isp_s": 220.0, "propellant_kg": 5.0}
VALVE = {"channel": "valve.line", "command": "delta_v", "vector": [0.0, 0.1, 0.0], "threshold": 0.5}


class Valve:
    """A device that has the samples it was given, by the time from which on each is the newest."""

    name = "valve"
    inputs = ("line",)

    def __init__(self, samples):
        self.samples, self.now_s = samples, lambda: 0.0

    def __getitem__(self, channel):
        assert channel == "line"
        past = [value for at_s, value in self.samples if at_s <= self.now_s()]
        return ChannelReading(past[-1] if past else None, 0.0, len(past), "ok", math.nan)


def fly(samples, actuation=VALVE, *, until_s=4.0, vehicle=None, **rest):
    valve = Valve(samples)
    params = parameters(
        vehicles=[{"thruster": THRUSTER, "actuation": [actuation]} | (vehicle or {})], **rest
    )
    star = Star(params, 1, hardware={"valve": valve}, base_directory=rest.get("folder"))
    valve.now_s = star.contexts["agent-01"].now_s
    star.run(until_s)
    return star


def rows(star, stream, *names):
    context = star.contexts["agent-01"]
    fields = [field.name for field in context.streams[stream]]
    return [
        tuple(dict(zip(fields, row, strict=True))[name] for name in names)
        for row in context.records[stream]
    ]


def test_each_sample_above_the_threshold_is_one_command_without_any_flight_software():
    star = fly([(0.95, 0.0), (1.0, 1.0), (1.2, 0.4), (1.5, 2.0)])

    assert rows(star, "commands", "number", "kind", "at_s", "frame", "y") == [
        (DEVICE_NUMBER_FIRST, "delta_v", pytest.approx(1.1), "rtn", 0.1),
        (DEVICE_NUMBER_FIRST + 1, "delta_v", pytest.approx(1.6), "rtn", 0.2),
    ]
    told = rows(star, "command_results", "status", "delta_v_m_s")
    assert [status for status, _ in told].count("executed") == 2
    summary = star.summaries()["agent-01"]
    assert summary["actuation"] == {
        "commands": 2, "executed": 2, "postponed": 0, "refused": 0, "refused_on_board": 0,
        "samples_skipped": 0,
    }  # fmt: skip
    assert star.host.finish()["maneuvers"]["delta_v_m_s"] == pytest.approx(0.3)
    assert len(star.contexts["agent-01"].records["truth_changes"]) == 2


def test_what_is_refused_is_counted_and_told_once():
    star = fly(
        [(1.0, 1.0), (1.5, 1.0)],
        vehicle={"thruster": {"isp_s": 220.0, "propellant_kg": 0.0}},
    )

    assert star.summaries()["agent-01"]["actuation"]["refused"] == 2
    warnings = [text for level, text in star.contexts["agent-01"].logs if level == "warning"]
    assert len(warnings) == 1
    assert "0 kg are left" in warnings[0]


def test_samples_that_no_tick_saw_are_counted():
    star = fly([(1.0, 1.0), (1.01, 1.0), (1.02, 1.0), (1.5, 1.0)])

    # The first that is seen is at 1.1 s: what was before it, nobody waited for.
    counts = star.summaries()["agent-01"]["actuation"]
    assert (counts["commands"], counts["samples_skipped"]) == (3, 1)


def test_an_agent_that_is_started_anew_gives_no_command_of_its_predecessor_a_second_time():
    star = fly([(1.0, 1.0)])
    first = star.summaries()["agent-01"]["actuation"]["commands"]
    context = star.contexts["agent-01"]
    again = DeviceCommands(context, context.parameters.vehicles[0], has_flight=True)
    again.step(41, 4.1, 0.0)
    seen = again.finish()["commands"]
    context.hardware["valve"].samples.append((3.0, 2.0))
    again.step(42, 4.2, 0.0)

    assert (first, seen, again.finish()["commands"]) == (1, 0, 1)


@pytest.mark.parametrize(
    ("entry", "value", "expected"),
    [
        ({"command": "torque", "duration_s": 0.5}, (0.01, 0.0, -0.02), (0.01, 0.0, -0.02)),
        ({"command": "dipole", "duration_s": 0.1, "scale": 2.0}, (1.0, 0.0, 0.5), (2.0, 0.0, 1.0)),
        (
            {
                "command": "dipole",
                "duration_s": 0.1,
                "matrix": [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
            },
            (1.0, 2.0, 3.0),
            (2.0, -1.0, 3.0),
        ),
    ],
)
def test_three_numbers_are_turned_into_the_bodys_axes(entry, value, expected):
    star = fly([(1.0, value)], {"channel": "valve.line", **entry}, vehicle={"attitude": BODY})

    assert rows(star, "commands", "kind", "x", "y", "z") == [(entry["command"], *expected)]
    assert star.summaries()["agent-01"]["actuation"]["executed"] == 1


GAUGES = """
class Gauges:
    def setup(self, context):
        self.context, self.told, self.mass = context, 0, []

    def step(self, t_s, readings):
        if t_s == 2.0:
            self.number = self.context.delta_v((0.0, 0.1, 0.0), at_s=2.3)
        if "mass" in readings:
            self.mass.append(readings["mass"].values[1])

    def command_result(self, result):
        self.told += 1

    def finish(self):
        return {"told": self.told, "masses": len(self.mass), "number": self.number}
"""


def test_flight_software_keeps_its_numbers_and_reads_what_a_device_has_changed(tmp_path):
    (tmp_path / "gauges.py").write_text(GAUGES)
    valve = Valve([(1.0, 1.0)])
    params = parameters(
        vehicles=[{"thruster": THRUSTER, "actuation": [VALVE]}], flight="gauges.py:Gauges"
    )
    star = Star(params, 1, hardware={"valve": valve}, base_directory=tmp_path)
    valve.now_s = star.contexts["agent-01"].now_s
    star.run(4.0)

    told = star.summaries()["agent-01"]["flight"]
    assert told == {"told": 2, "masses": 2, "number": 0}


@pytest.mark.parametrize(
    ("channel", "words"),
    [("pump.line", "expected a device of this agent's, one of valve, got 'pump'"),
     ("valve.flow", "expected an input of valve, one of line, got 'flow'")],
)  # fmt: skip
def test_a_channel_that_is_not_there_is_named(channel, words):
    with pytest.raises(BlamedError, match=words):
        fly([], VALVE | {"channel": channel}, until_s=0.1)


def test_values_of_another_size_are_blamed_on_their_entry():
    with pytest.raises(BlamedError, match=r"expected 1 numbers \(with vector\), got 3 from valve"):
        fly([(1.0, (1.0, 2.0, 3.0))])


@pytest.mark.parametrize(
    ("entry", "field", "words"),
    [
        ({"channel": "valve"}, "channel", "a device and its input such as valve.line"),
        ({"duration_s": 1.0}, "duration_s", "leave it out"),
        ({"command": "torque"}, "duration_s", "a torque needs one"),
        ({"frame": "body"}, "command", "a vehicle with attitude"),
        ({"scale": 0.0}, "scale", "a scale other than 0"),
        ({"matrix": [[1.0, 0.0, 0.0]] * 3}, "matrix", "give one of them"),
    ],
)
def test_validate_tells_what_is_wrong_with_an_entry(tmp_path, entry, field, words):
    given = parameters(vehicles=[{"thruster": THRUSTER, "actuation": [VALVE | entry]}])
    faults = find_faults(given, 1, tmp_path)

    assert any(
        fault.startswith(f"parameters.vehicles[0].actuation[0].{field}: ") and words in fault
        for fault in faults
    )


def test_a_dipole_needs_magnetorquers():
    entry = Actuation(channel="coil.m", command="dipole", duration_s=0.1)

    assert not list(actuation_faults(entry, has_attitude=True, has_torquers=True))
    assert list(actuation_faults(entry, has_attitude=True, has_torquers=False)) == [
        ("command", "needs a vehicle with attitude.magnetorquers")
    ]


def test_the_channels_that_command_are_looked_for_before_a_run(tmp_path):
    coil = {"channel": "coil.m", "command": "dipole", "duration_s": 0.1}
    given = parameters(
        vehicles=[{"thruster": THRUSTER, "attitude": BODY, "actuation": [VALVE, coil]}]
    )

    first, second = device_uses(given, ("agent-01",), tmp_path)
    assert (first.device, first.channel, first.size) == ("valve", "line", 1)
    assert (second.device, second.channel, second.size) == ("coil", "m", 3)
    assert second.field == "parameters.vehicles[0].actuation[1].channel"
