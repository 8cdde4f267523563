"""What of a scenario's checks and timeline a rerun has, and what it tells of the rest."""

import pytest

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.evidence.run_directory import RunDirectory, write_json
from cosmos_cli.rerun.carried_over import carried_over
from cosmos_cli.rerun.recorded_run import FlownRun, RecordedAgent
from madns_runtime.config import Agents, RunConfig, TimeSettings

SCENARIO = """\
name: flown
vars: {when_s: 3}
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 60}
timeline:
  - {at_s: "${when_s}", action: hang, agents: [agent-01], for_s: 1}
  - {rate_per_h: 60, action: device_fault, agents: ["*"], device: gps, fault: freeze, for_s: 2}
  - {at_s: 20, action: stop}
  - {at_s: 30, action: kill, agents: [agent-02]}
checks:
  - {name: few, stream: round_trips, statistic: count, below: 10, stop_when_broken: true}
"""


@pytest.fixture
def flown(tmp_path):
    """Return a function that makes a run of the scenario with its last tick at a time."""

    def make(last_s, mode="realtime", text=SCENARIO):
        (tmp_path / "scenario.yaml").write_text(text)
        config = RunConfig(
            run="0001-flown",
            scenario="flown",
            simulation="counter",
            base_directory=str(tmp_path),
            agents=Agents(count=2, tick_hz=10.0),
            time=TimeSettings(duration_s=60.0, mode=mode),
        )
        agents = {
            name: RecordedAgent(ticks=None, last_s=each_s)
            for name, each_s in (("agent-01", last_s), ("agent-02", last_s / 2))
        }
        run = RunDirectory(tmp_path)
        return FlownRun(run=run, config=config, agents=agents, devices=())

    return make


def test_a_run_in_real_time_that_ended_early_ends_again_with_its_last_tick(flown):
    found = carried_over(flown(20.2))

    entries = found.values()["timeline"]
    assert [entry["action"] for entry in entries] == [
        "hang",
        "annotate",
        "annotate",
        "kill",
        "stop",
    ]
    assert entries[0]["at_s"] == 3
    assert entries[1] == {
        "rate_per_h": 60,
        "for_s": 2,
        "action": "annotate",
        "text": "on record: device_fault gps freeze",
    }
    assert entries[-1]["at_s"] == pytest.approx(20.25)
    assert found.loses_agents
    assert not found.checks[0]["stop_when_broken"]
    assert "it ended early: so does the rerun, with the tick of 20.2 s" in found.remarks


def test_a_run_that_missed_its_last_ticks_is_not_said_to_have_ended_early(flown):
    recorded = flown(59.5)
    for document, told in (
        ({"status": "complete", "duration_s": 60.0}, "its last ticks were missed: the rerun ends"),
        ({"status": "complete", "duration_s": 59.6}, "it ended early: so does the rerun"),
        ({"status": "interrupted", "duration_s": 60.0}, "it ended early: so does the rerun"),
    ):
        write_json(recorded.run.run_json, document)

        (remark,) = [each for each in carried_over(recorded).remarks if "59.5 s" in each]
        assert remark.startswith(told)


def test_a_run_in_real_time_that_came_to_its_end_is_not_stopped(flown):
    assert [e["action"] for e in carried_over(flown(59.9)).values()["timeline"]] == [
        "hang",
        "annotate",
        "annotate",
        "kill",
    ]


def test_a_run_in_lockstep_ends_by_what_ended_it(flown):
    found = carried_over(flown(20.0, mode="lockstep"))

    assert [e["action"] for e in found.values()["timeline"]][2:] == ["stop", "kill"]
    assert found.checks[0]["stop_when_broken"]


def test_what_is_refused_is_left_out_and_told_by_its_place_on_record(flown):
    found = carried_over(flown(59.9))

    first = found.leave_out(
        InputError(faults=[Fault(text="no station", path="timeline[3].station")])
    )
    second = found.leave_out(InputError(faults=[Fault(text="no stream", path="checks[0].stream")]))
    other = found.leave_out(InputError(faults=[Fault(text="no gain", path="parameters.gain")]))

    assert (first, second, other) == (True, True, False)
    assert found.remarks[1:] == [
        "timeline[3] (kill): left out: no station",
        "checks[0] (few): left out: no stream",
    ]
    assert (found.left_out, found.loses_agents, found.checks) == (["kill"], False, {})


CONDITIONAL = """\
name: flown
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 60}
timeline:
  - {when: {stream: ticks, field: tick, above: 5}, action: kill, agents: [agent-01], for_s: 1}
  - {at_s: 5, action: stop}
  - {at_s: 6, action: lose_messages, agents: ["*"], probability: 0.5, for_s: 1}
"""


def test_a_remark_keeps_the_place_of_what_is_left_out_by_which_chance_is_drawn(flown):
    found = carried_over(flown(59.9, text=CONDITIONAL))
    refused = InputError(faults=[Fault(text="no ticks in lockstep", path="timeline[0].when")])

    assert found.leave_out(refused)

    first, second, third = found.values()["timeline"]
    assert first == {"at_s": 0.0, "for_s": 1, "action": "annotate", "text": "on record: kill"}
    assert second == {"at_s": 5, "action": "annotate", "text": "on record: stop"}
    assert third["action"] == "lose_messages"
    assert found.left_out == ["kill"]
    assert found.leave_out(refused)  # what can stand at no time at all
    assert len(found.values()["timeline"]) == 2
    assert (found.left_out, len(found.remarks)) == (["kill"], 1)


UNPLUGGED = """\
name: flown
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 60}
timeline:
  - {at_s: 5.07, action: device_fault, agents: ["*"], device: imu, fault: disconnect}
  - {at_s: 6, action: device_fault, agents: ["*"], device: imu, fault: bias, value: 2, for_s: 3}
  - {at_s: 7, action: device_fault, agents: ["*"], device: gps, fault: bias, value: 2, for_s: 3}
  - {at_s: 8, action: device_fault, agents: ["*"], device: imu, fault: clear}
"""


def test_in_lockstep_a_device_is_unplugged_again_as_no_sample_tells_it(flown):
    found = carried_over(flown(59.9, mode="lockstep", text=UNPLUGGED))

    unplugged, bias, other, clear = found.values()["timeline"]
    assert (unplugged["at_s"], unplugged["fault"]) == (5.07, "disconnect")
    assert (bias["fault"], bias["value"], bias["for_s"]) == ("drop", 0, 3)  # its end clears all
    assert other["action"] == "annotate"
    assert clear["fault"] == "clear"
    assert [remark[:11] for remark in found.remarks] == ["timeline[1]", "timeline[2]"]


@pytest.mark.parametrize(
    ("mode", "text"),
    [("realtime", UNPLUGGED), ("lockstep", UNPLUGGED.replace("bias, value", "delay, value"))],
)
def test_a_device_is_not_unplugged_again_where_samples_may_have_come_behind_it(flown, mode, text):
    found = carried_over(flown(59.9, mode=mode, text=text))

    assert {entry["action"] for entry in found.values()["timeline"]} == {"annotate"}


def test_a_run_whose_scenario_cannot_be_read_says_so(flown):
    found = carried_over(flown(59.9, text="timeline: [\n"))

    assert found.values() == {"timeline": [], "checks": []}
    assert found.remarks[0].startswith("no checks and no timeline: ")
