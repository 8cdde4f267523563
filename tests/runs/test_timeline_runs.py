"""Whole runs with a timeline by the real command: what happens when, that it repeats, and how a stop ends a run."""

import json

import pytest
import yaml
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

ENTRIES = [
    {"at_s": 1, "action": "annotate", "text": "warm", "for_s": 2},
    {"every_s": 2, "from_s": 1, "to_s": 7, "action": "annotate", "text": "again"},
    {"rate_per_h": 3000, "action": "annotate", "text": "chance"},
    {"at_s": 6.05, "action": "stop"},
]


@pytest.fixture
def cosmos(tmp_path):
    return CosmosCommand(tmp_path)


def written(folder, entries, *, mode="lockstep", duration_s=10):
    path = folder / "timeline.yaml"
    scenario = {
        "name": "timeline",
        "simulation": "counter",
        "agents": {"count": 2, "tick_hz": 10},
        "time": {"mode": mode, "duration_s": duration_s},
        "deadline": {"max_miss_ratio": 1},
        "timeline": entries,
    }
    path.write_text(yaml.safe_dump(scenario))
    return path


def actions(cosmos, result):
    lines = (cosmos.directory(result) / "host" / "events.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    return [each for each in events if str(each.get("event")).startswith("action_")]


def test_a_timeline_in_lockstep_repeats_to_the_bit_and_a_stop_completes_the_run(cosmos, tmp_path):
    path = written(tmp_path, ENTRIES)

    first, second = (cosmos.run(path, f"agents.per_process={number}") for number in (1, 2))
    other = cosmos.run(path, "seed=9")

    for code, result in (first, second):
        assert (code, result["status"], result["duration_s"]) == (0, "complete", 6.1)
        assert result["timing"]["ticks"] == 2 * 61
        assert result["data"]["complete"]
    assert first[1]["records_sha256"] == second[1]["records_sha256"] != other[1]["records_sha256"]
    found = actions(cosmos, first[1])
    assert [(e["t_s"], e["event"]) for e in found if e["parameters"] == {"text": "warm"}] == [
        (1.0, "action_began"),
        (3.0, "action_ended"),
    ]
    assert [e["t_s"] for e in found if e["parameters"] == {"text": "again"}] == [1.0, 3.0, 5.0]
    assert any(e["parameters"] == {"text": "chance"} for e in found)
    assert found[-1]["action"] == "stop"
    assert all(e["delay_s"] == 0.0 for e in found)


def test_of_a_run_that_is_stopped_at_its_begin_no_tick_was_due(cosmos, tmp_path):
    code, result = cosmos.run(written(tmp_path, [{"at_s": 0, "action": "stop"}]))

    assert (code, result["status"], result["duration_s"]) == (0, "complete", 0.0)
    assert (result["timing"]["ticks"], result["timing"]["missed"]) == (0, 0)


def test_a_stop_in_real_time_ends_all_agents_with_the_same_tick(cosmos, tmp_path):
    path = written(
        tmp_path,
        [
            {"at_s": 0.2, "action": "stress", "agents": ["agent-01"], "for_s": 0.3},
            # Long after the stress, which may begin late and end as late.
            {"at_s": 5, "action": "stop"},
        ],
        mode="realtime",
        duration_s=60,
    )

    code, result = cosmos.run(path, "agents.per_process=2", *LOOSE)

    assert (code, result["status"]) == (0, "complete")
    assert 5.3 <= result["duration_s"] < 30
    found = [(e["event"], e["action"]) for e in actions(cosmos, result)]
    assert found == [
        ("action_began", "stress"),
        ("action_ended", "stress"),
        ("action_began", "stop"),
    ]


def test_a_clock_that_is_stepped_is_found_again_and_recorded(cosmos, tmp_path):
    entries = [
        {"at_s": 2, "action": "step_clock", "agents": ["*"], "by_ms": 150},
        {"at_s": 3, "action": "drift_clock", "agents": ["agent-01"], "ppm": 300, "for_s": 1},
    ]
    path = written(tmp_path, entries, mode="realtime", duration_s=8)

    code, result = cosmos.run(path, "agents.per_process=2", *LOOSE)

    assert (code, result["status"]) == (0, "complete")
    found = [(e["event"], e["action"]) for e in actions(cosmos, result)]
    assert found == [
        ("action_began", "step_clock"),
        ("action_began", "drift_clock"),
        ("action_ended", "drift_clock"),
    ]
    folder = cosmos.directory(result) / "agents"
    told = [
        json.loads(line).get("event")
        for agent in sorted(folder.iterdir())
        for line in (agent / "events.jsonl").read_text().splitlines()
    ]
    # Agents that share a process share its clock: it is put wrong once.
    words = ("clock_stepped", "clock_drift_begins", "clock_drift_ends")
    assert [told.count(word) for word in words] == [1, 1, 1]
    rows = [json.loads(x) for x in (folder / "agent-01/clock.jsonl").read_text().splitlines()]
    offsets_us = [row[1] for row in rows if isinstance(row, list)]
    assert offsets_us[-1] - offsets_us[0] == pytest.approx(-150_000 - 300, abs=20_000)


@pytest.mark.parametrize("killed_s", [0.5, 1.5], ids=["at once", "later"])
def test_a_clock_that_drifts_for_an_agent_that_is_lost_is_right_for_those_that_share_it(
    cosmos, tmp_path, killed_s
):
    entries = [
        {"at_s": 0.5, "action": "drift_clock", "agents": ["agent-01"], "ppm": 300},
        {"at_s": killed_s, "action": "kill", "agents": ["agent-01"]},
    ]
    path = written(tmp_path, entries, mode="realtime", duration_s=3)

    code, result = cosmos.run(path, "agents.per_process=2", "on_agent_loss=continue", *LOOSE)

    assert (code, result["status"]) == (0, "complete")
    text = (cosmos.directory(result) / "agents" / "agent-01" / "events.jsonl").read_text()
    told = [json.loads(line).get("event") for line in text.splitlines()]
    assert [
        each for each in told if each in ("clock_drift_begins", "killed", "clock_drift_ends")
    ] == [
        "clock_drift_begins",
        "killed",
        "clock_drift_ends",
    ]


AWAITED = [
    {
        "when": {"stream": "round_trips", "field": "packet", "above": 20},
        "action": "annotate",
        "text": "twenty packets",
    },
    {
        "when": {"stream": "round_trips", "field": "packet", "above": 30, "agents": ["agent-02"]},
        "action": "stop",
    },
]


def test_a_condition_begins_its_action_once_at_the_end_of_its_tick_in_lockstep(cosmos, tmp_path):
    path = written(tmp_path, AWAITED)

    first, second = (cosmos.run(path, f"agents.per_process={number}") for number in (1, 2))

    assert (first[0], first[1]["records_sha256"]) == (0, second[1]["records_sha256"])
    found = actions(cosmos, first[1])
    assert [(each["action"], each["delay_s"]) for each in found] == [("annotate", 0), ("stop", 0)]
    began_s = found[1]["t_s"]
    assert 2.9 < began_s < 3.5
    assert first[1]["duration_s"] == pytest.approx(began_s + 0.1)  # the tick under way is the last


def test_a_condition_is_heard_of_in_real_time_and_the_delay_recorded(cosmos, tmp_path):
    path = written(tmp_path, AWAITED, mode="realtime", duration_s=100)

    code, result = cosmos.run(path, *LOOSE)

    found = actions(cosmos, result)
    assert (code, result["status"]) == (0, "complete")
    assert [each["action"] for each in found] == ["annotate", "stop"]
    assert all(0.0 <= each["delay_s"] < 60.0 for each in found)
    assert result["duration_s"] < 100


def test_what_a_timeline_asked_for_and_the_run_did_not_do_is_a_remark(cosmos, tmp_path):
    late = {"stream": "round_trips", "field": "packet", "above": 4000}
    soon = {"stream": "round_trips", "field": "packet", "above": 4}
    path = written(
        tmp_path,
        [
            {"at_s": 1, "action": "kill", "agents": ["agent-02"]},
            {"at_s": 1, "action": "kill", "agents": ["agent-02"], "for_s": 1},
            {"at_s": 2, "action": "kill", "agents": ["agent-02"]},
            {"at_s": 2, "action": "hang", "agents": ["agent-02"]},
            {"when": late, "action": "stop"},
            {"when": soon, "action": "annotate", "text": "soon"},
        ],
        duration_s=3,
    )

    code, result = cosmos.run(path, "on_agent_loss=continue")

    why = "host: agent-02: not running, so there is nothing to"
    assert (code, result["status"]) == (0, "complete")
    assert [each for each in result["remarks"] if each.startswith("timeline")] == [
        f"timeline: kill was refused 2 times, first by {why} kill",
        f"timeline: hang was refused 1 time by {why} hang",
        "timeline[4] (stop): its condition was never met",
    ]


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_what_waits_for_a_condition_that_is_met_in_set_up_takes_place_at_time_zero(
    cosmos, tmp_path, mode
):
    started = {"stream": "events", "field": "event", "equals": "start"}
    entry = {"when": started, "action": "annotate", "text": "started"}
    path = written(tmp_path, [entry], mode=mode, duration_s=4)

    code, result = cosmos.run(path, *LOOSE)

    assert code == 0, result["verdict"]
    (found,) = actions(cosmos, result)
    assert (found["event"], found["parameters"]) == ("action_began", {"text": "started"})
    assert found["t_s"] >= 0.0
