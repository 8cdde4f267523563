"""Flight software in a rerun: what can be stepped flies, what is behind a device or was attached to is played back."""

from dataclasses import replace
from itertools import groupby
from types import SimpleNamespace

import pytest
from constellation_fakes import parameters

from madns_runtime.errors import BlamedError
from madns_runtime.simulations.constellation import simulation
from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.check_flight import flight_faults
from madns_runtime.simulations.constellation.flight.recorded_commands import (
    COMMANDS_MAX,
    RecordedCommands,
)
from madns_runtime.simulations.constellation.flight_settings import FlightAttached, FlightClass
from madns_runtime.simulations.constellation.rerun import for_rerun
from madns_runtime.simulations.constellation.vehicle.commands import COMMANDS_PER_TICK_MAX

ATTACHED = {"interface": {"transport": {"kind": "tcp", "address": "127.0.0.1:4000"}}}
BEHIND = {
    "interface": {
        "transport": {"kind": "device", "device": "mcu-${name}"},
        "protocol": "frames",
        "clock": "own",
    }
}
FREE = {
    "command": ["cat"],
    "interface": {"transport": {"kind": "stdio"}, "protocol": "frames", "clock": "own"},
}
NAMES = (("agent-01", "star-1"),)


def test_software_that_can_be_stepped_stays_as_it_is_and_is_told_results_as_in_real_time(tmp_path):
    given = parameters(flight=[{"command": ["cat"]}])
    (tmp_path / "agents" / "agent-01").mkdir(parents=True)
    (tmp_path / "agents" / "agent-01" / "ticks.jsonl").touch()

    found = for_rerun(given, ("agent-01",), tmp_path)

    assert found.parameters == replace(given, recorded_agents=str(tmp_path / "agents"))
    assert found.remarks == ()


def test_of_a_run_in_lockstep_results_are_told_as_they_come(tmp_path):
    given = parameters(flight=[{"command": ["cat"]}])
    again = replace(given, recorded_agents="runs/1/agents")  # it was a rerun itself

    assert for_rerun(given, ("agent-01",), tmp_path).parameters == given
    assert for_rerun(again, ("agent-01",), tmp_path).parameters == replace(
        given, recorded_agents=str(tmp_path / "agents")
    )


def test_vehicles_that_command_nothing_have_no_recorded_results(tmp_path):
    given = parameters()

    assert for_rerun(given, ("agent-01",), tmp_path).parameters == given


def test_recorded_results_are_of_lockstep_alone(tmp_path):
    given = replace(parameters(), recorded_agents=str(tmp_path))

    assert any("recorded_agents" in one for one in find_faults(given, 1, tmp_path))
    assert not any(
        "recorded_agents" in one for one in find_faults(given, 1, tmp_path, is_lockstep=True)
    )


@pytest.mark.parametrize(
    ("rule", "why"), [(ATTACHED, "only attached to"), (FREE, "a clock of its")]
)
def test_software_that_cannot_be_stepped_is_named_and_its_commands_are_played(rule, why, tmp_path):
    given = parameters(flight=[{**rule, "rate_hz": 20.0}])

    found = for_rerun(given, ("agent-01",), tmp_path)

    [played] = found.parameters.flight
    assert isinstance(played, FlightClass)
    assert played.rate_hz == 20.0
    assert played.settings == {"agents": str(tmp_path / "agents")}
    assert "flight[0] (agents *)" in found.remarks[0] and why in found.remarks[0]
    assert not flight_faults(found.parameters, NAMES, tmp_path, is_lockstep=True)


def test_software_behind_a_device_is_played_back_in_lockstep_whatever_its_clock(tmp_path):
    given = parameters(flight=[BEHIND])
    assert flight_faults(given, NAMES, tmp_path, is_lockstep=True)

    found = for_rerun(given, ("agent-01",), tmp_path)

    [played] = found.parameters.flight
    assert isinstance(played, FlightAttached) and played.interface.transport.recorded
    assert not any("sent" in name for name in found.unlike)
    assert not flight_faults(found.parameters, NAMES, tmp_path, is_lockstep=True)
    assert simulation.rerun is not None


class Desk(SimpleNamespace):
    def note(self, *values, **more):
        self.given.append((*values, *more.values()))


def record_commands(agents, rows):
    """Leave commands of agent-01 as a run records them."""
    names = ("tick", "number", "kind", "at_s", "frame", "x", "y", "z", "duration_s")
    fields = ",".join(f'{{"name":"{name}","unit":"","kind":"float"}}' for name in names)
    folder = agents / "agent-01"
    folder.mkdir()
    (folder / "commands.jsonl").write_text(
        f'{{"schema":1,"stream":"commands","shape":"array","fields":[{fields}]}}\n{rows}'
    )


def test_recorded_commands_are_given_in_their_ticks_and_those_of_devices_are_not(tmp_path):
    rows = (
        '[2,0,"delta_v",1.5,"rtn",0.0,0.1,0.0,0.0]\n'
        '[2,1,"torque",1.5,"body",1.0,0.0,0.0,0.5]\n'
        f'[2,{2**30},"dipole",1.5,"body",1.0,0.0,0.0,0.5]\n'
    )
    record_commands(tmp_path, rows)
    desk = Desk(given=[])
    context = SimpleNamespace(
        name="agent-01",
        tick_hz=10.0,
        settings={"agents": str(tmp_path)},
        delta_v=desk.note,
        torque=desk.note,
        dipole=desk.note,
    )
    software = RecordedCommands()
    software.setup(context)

    software.step(0.1, {})
    assert desk.given == []
    software.step(0.2, {})

    assert desk.given == [((0.0, 0.1, 0.0), 1.5, "rtn"), ((1.0, 0.0, 0.0), 1.5, 0.5)]
    assert COMMANDS_MAX == COMMANDS_PER_TICK_MAX
    again = RecordedCommands()
    again.setup(context)
    desk.given.clear()
    again.step(0.1, {})
    again.step(0.12, {})  # of software that is faster than the ticks, in the first step of the tick
    assert len(desk.given) == 2
    again.step(0.2, {})
    assert len(desk.given) == 2
    context.name = "agent-02"
    with pytest.raises(BlamedError, match="expected the commands of the recorded run, found none"):
        RecordedCommands().setup(context)


def test_recorded_commands_of_several_answers_that_came_at_once_are_given_again(tmp_path):
    rows = "".join(f'[2,{n},"delta_v",1.5,"rtn",0.0,0.1,0.0,0.0]\n' for n in range(40))
    record_commands(tmp_path, rows)
    desk = Desk(given=[])
    context = SimpleNamespace(
        name="agent-01",
        tick_hz=10.0,
        settings={"agents": str(tmp_path)},
        delta_v=desk.note,
        begin_answer=lambda: desk.given.append("another answer"),
    )
    software = RecordedCommands()
    software.setup(context)

    software.step(0.2, {})

    answers = [
        len(list(group))
        for key, group in groupby(desk.given, lambda each: each != "another answer")
        if key
    ]
    assert answers == [COMMANDS_PER_TICK_MAX, COMMANDS_PER_TICK_MAX, 40 - 2 * COMMANDS_PER_TICK_MAX]


def test_recorded_estimates_are_given_again_with_what_was_believed_of_nothing(tmp_path):
    folder = tmp_path / "agent-01"
    folder.mkdir()
    empty = '{"schema":1,"stream":"commands","shape":"array","fields":[{"name":"tick","unit":"","kind":"int"}]}\n'
    (folder / "commands.jsonl").write_text(empty)
    names = [("tick", "int"), ("a_m", "float"), ("e", "float")]
    fields = ",".join(f'{{"name":"{name}","unit":"","kind":"{kind}"}}' for name, kind in names)
    (folder / "estimates.jsonl").write_text(
        f'{{"schema":1,"stream":"estimates","shape":"array","fields":[{fields}]}}\n'
        "[1,7e6,0.1]\n[3,7.1e6,null]\n[3,7.2e6,0.2]\n"
    )
    desk = Desk(given=[])
    software = RecordedCommands()
    software.setup(
        SimpleNamespace(
            name="agent-01", tick_hz=10.0, settings={"agents": str(tmp_path)}, estimate=desk.note
        )
    )

    for t_s in (0.0, 0.1, 0.2, 0.3, 0.4):
        software.step(t_s, {})

    assert desk.given == [
        ({"a_m": 7e6, "e": 0.1},),
        ({"a_m": 7.1e6, "e": None},),
        ({"a_m": 7.2e6, "e": 0.2},),
    ]
