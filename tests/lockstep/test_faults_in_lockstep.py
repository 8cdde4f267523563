"""Faults of a timeline in lockstep: what they do, at which tick, and that two runs have the same bytes."""

from pathlib import Path

import pytest
from harness.nights import by_night

from madns_runtime.conditions.condition import Condition, ValueBounds
from madns_runtime.timeline.entries import ScheduledEntry

pytestmark = pytest.mark.process

HARNESS = Path(__file__).resolve().parents[1] / "harness"
A4 = ("agent-04",)
SOME = ("agent-02", "agent-04")
ALL = tuple(f"agent-{number:02}" for number in range(1, 7))


def entry(action, agents=A4, at_s=0.3, for_s=None, **parameters):
    if action.endswith("messages") or action == "link_down":
        parameters = {"traffic": "all"} | parameters
    return ScheduledEntry(
        action=action, agents=agents, at_s=at_s, for_s=for_s, parameters=parameters
    )


@pytest.fixture
def run_faults(start_host):
    """Return a function that starts a run with a timeline."""

    def run(*timeline, per_process=2, restarts_max=0, conditions=()):
        return start_host(
            conditions=conditions,
            simulation=f"{HARNESS}/fault_simulation.py:simulation",
            timeline=timeline,
            restarts_max=restarts_max,
            per_process=per_process,
        )

    return run


def steps(run, agent="agent-04", number=""):
    return [row[1] for row in run.records(f"agents/{agent}/steps{number}.jsonl")]


def at_host(run, who="agent-04", kind="up"):
    rows = run.records("host/heard.jsonl")
    return [(round(t_s, 3), what[1:]) for t_s, name, what in rows if (name, what[0]) == (who, kind)]


def numbers(run, who="agent-04"):
    return [what[0] for _, what in at_host(run, who)]


def between(run, agent, sender):
    rows = run.records(f"agents/{agent}/heard.jsonl")
    return [what[1] for _, who, what in rows if who == sender]


@pytest.fixture
def restarted(start_host):
    """Return the result of a run in which agent-04 is restarted at 0.3 s, and back at 0.5 s."""
    run = start_host(
        simulation=f"{HARNESS}/returning_simulation.py:simulation",
        timeline=(entry("restart"),),
        restarts_max=0,
    )
    return run.result()


def test_what_the_host_sends_with_the_initial_data_of_one_that_returns_arrives(restarted):
    agents = restarted["agents"]

    assert all(agent["simulation"]["told"].count("welcome") == 1 for agent in agents.values())
    assert agents["agent-04"]["messages"]["not_sent"] == 0


def test_no_deadline_is_taken_in_set_up_by_one_that_returns_either(restarted):
    told = [agent["simulation"]["told"][0] for agent in restarted["agents"].values()]

    assert set(told) == {"deadline_s is simulated time, which has not begun"}


def test_what_is_sent_to_agents_on_a_message_of_the_host_is_of_its_tick_and_not_late(restarted):
    agents, carried = restarted["agents"], restarted["between_agents"]

    for name in ("agent-02", "agent-03"):
        told, counts = (agents[name]["simulation"][key] for key in ("told", "counts"))
        assert told[-1] == ["passed on", 0.4, 0.5]
        assert counts == {"received": 1, "held": 0, "late": 0, "no_room": 0}
    assert carried["known_late"] == 0


KINDS = {
    "kill": [entry("kill")],
    "kill and return": [entry("kill", for_s=0.3)],
    "kill two of one process": [entry("kill", ("agent-03", "agent-04"), for_s=0.2)],
    "kill all and return": [entry("kill", ALL, for_s=0.3)],
    "restart": [entry("restart")],
    "hang": [entry("hang", for_s=0.3)],
    "slow": [entry("slow", SOME, for_s=0.6, factor=2.5)],
    "lose": [entry("lose_messages", ALL, probability=0.2)],
    "lose with host": [entry("lose_messages", SOME, probability=0.7, traffic="with_host")],
    "lose between": [entry("lose_messages", ALL, probability=0.2, traffic="between_agents")],
    "lose all": [entry("lose_messages", for_s=0.4, probability=1.0)],
    "delay": [entry("delay_messages", SOME, delay_s=0.2, jitter_s=0.0)],
    "delay with jitter": [entry("delay_messages", ALL, delay_s=0.05, jitter_s=0.3)],
    "reorder": [entry("reorder_messages", ALL, probability=0.5, within_s=0.3)],
    "duplicate": [entry("duplicate_messages", ALL, probability=0.5)],
    "link down": [entry("link_down", SOME, for_s=0.4)],
    "link down with host": [entry("link_down", SOME, for_s=0.4, traffic="with_host")],
    "partition": [entry("partition", SOME, for_s=0.5)],
    "three sides": [entry("partition", SOME), entry("partition", ("agent-01",))],
    "lossy and killed": [
        entry("lose_messages", ALL, at_s=0.1, probability=0.3),
        entry("kill", for_s=0.3),
        entry("hang", ("agent-01",), for_s=0.2),
    ],
    "hang until a stop": [
        entry("link_down", ALL, at_s=0.0),
        entry("hang", at_s=0.44, for_s=0.3),
        entry("stop", (), at_s=0.5),
    ],
}
"""Twenty kinds of faults, by name, and one that lasts until the run is stopped."""


def returns_after_s(run):
    events = run.events_of("agents/agent-04")
    return next(e["returns_after_s"] for e in events if e["event"] == "killed")


@pytest.mark.parametrize("kind", by_night(KINDS, day=[*KINDS][::3]))
def test_a_run_with_a_fault_survives_it_and_repeats_to_the_bit(run_faults, kind):
    runs = [run_faults(*KINDS[kind], per_process=number) for number in (2, 6)]
    results = [run.result() for run in runs]

    for result in results:
        assert (result["status"], result["lost"], result["not_stopped"]) == ("complete", [], [])
    events = runs[0].events_of("host")
    assert [e["action"] for e in events if e["event"] == "action_began"] == [
        each.action for each in sorted(KINDS[kind], key=lambda each: each.at_s)
    ]
    assert not [e for e in events if e["event"] == "action_refused"]
    assert runs[0].hashes() == runs[1].hashes()
    assert results[0]["faults"] == results[1]["faults"]
    for counts in [results[0]["faults"].get("with_host", {})]:
        seen = [counts.get(name, 0) for name in ("passed", "lost", "late")]
        assert counts.get("seen", 0) == sum(seen)
        assert counts.get("late", 0) == counts.get("released", 0) + counts.get("left", 0)


def test_what_agents_record_of_a_run_that_is_stopped_bears_the_time_of_its_end(run_faults):
    run = run_faults(entry("stop", (), at_s=0.5))
    run.result()

    assert run.events_of("agents/agent-04")[-1] == {
        "t_s": 0.5,
        "utc": "1970-01-01T00:00:00.500000Z",
        "event": "end",
    }
    heard_s = [row[0] for row in run.records("agents/agent-04/heard.jsonl")]
    assert max(heard_s) == 0.5


def test_an_agent_that_is_killed_returns_when_it_is_said_and_is_not_judged(run_faults):
    run = run_faults(entry("kill", for_s=0.3))
    result = run.result()

    assert steps(run) == [0, 1, 2]
    assert steps(run, number=".2") == [6, 7, 8, 9]
    assert result["lost_on_purpose"] == ["agent-04"]
    assert result["agents"]["agent-04"]["ended_on_purpose"] == [1]
    assert at_host(run, kind="lost") == [(0.3, ["killed on purpose at t = 0.3 s for 0.3 s"])]
    assert at_host(run, kind="rejoined") == [(0.6, [])]
    said = [e["event"] for e in run.events_of("agents/agent-04")]
    assert said == ["start", "killed", "end"]  # no emergency, which checks look for
    assert not [row for row in run.records("agents/agent-04/log.jsonl") if row[2] == "critical"]
    assert returns_after_s(run) == 0.3


@pytest.mark.parametrize(
    ("action", "at_s", "for_s", "told_s"),
    [
        ("kill", 0.3, None, None),
        ("kill", 0.3, 0.9, None),
        ("kill", 0.7, 0.2, 0.2),  # at the last tick, 0.9 s
        ("kill", 0.7, 0.25, None),  # behind it, before the run's end
        ("restart", 0.3, None, 0),
    ],
)
def test_an_agent_records_when_it_is_to_return_as_in_real_time(
    run_faults, action, at_s, for_s, told_s
):
    run = run_faults(entry(action, at_s=at_s, for_s=for_s))
    run.result()

    assert returns_after_s(run) == told_s


@pytest.mark.parametrize("timeline", [[], [entry("stop", (), at_s=0.5)]])
def test_an_agent_that_was_to_return_after_the_last_tick_is_not_judged(run_faults, timeline):
    at_s = 0.45 if timeline else 0.92
    run = run_faults(entry("kill", at_s=at_s - 0.1, for_s=0.1), *timeline)
    result = run.result()

    assert (result["status"], result["lost"]) == ("complete", [])
    assert result["lost_on_purpose"] == ["agent-04"]


def test_an_agent_that_is_away_is_named_and_the_others_take_part(run_faults):
    timeline = [
        entry("kill", at_s=at_s, for_s=0.4, agents=who) for at_s, who in ((0.2, A4), (0.4, SOME))
    ]
    run = run_faults(*timeline, entry("hang", SOME, at_s=0.5, for_s=0.1))
    result = run.result()

    assert result["lost_on_purpose"] == list(SOME)
    began = [e for e in run.events_of("host") if e["event"].startswith("action_began")]
    assert [e.get("not_there") for e in began] == [None, ["agent-04"]]
    (refused,) = [e for e in run.events_of("host") if e["event"] == "action_refused"]
    assert "agent-02, agent-04: not running" in refused["reason"]


def test_everybody_may_be_killed_if_some_return(run_faults):
    run = run_faults(entry("kill", ALL, for_s=0.3))
    result = run.result()

    assert (result["status"], result["lost_on_purpose"]) == ("complete", list(ALL))
    assert steps(run, number=".2") == [6, 7, 8, 9]


def test_a_hung_agent_takes_no_step_and_its_records_say_which(run_faults):
    run = run_faults(entry("hang", for_s=0.3))
    run.result()

    assert steps(run) == [0, 1, 2, 6, 7, 8, 9]
    events = {e["event"]: e for e in run.events_of("agents/agent-04")}
    assert events["hang_begins"]["t_s"] == pytest.approx(0.3)
    assert events["hang_ends"]["t_s"] == pytest.approx(0.6)
    assert events["hang_ends"]["ticks_withheld"] == 3


@pytest.mark.parametrize(("fault", "given"), [("hang", {}), ("slow", {"factor": 9.0})])
def test_what_a_hung_agent_recorded_last_goes_on_to_hold(run_faults, fault, given):
    stuck = Condition(
        number=0,
        name="stuck",
        stream="steps",
        field="tick",
        bounds=ValueBounds.within(2.0, 2.0),
        agents=A4,
        for_s=0.3,
    )
    run = run_faults(
        entry(fault, for_s=0.5, **given),
        ScheduledEntry(action="annotate", condition=0, parameters={"text": "stuck"}),
        conditions=(stuck,),
    )
    run.result()

    assert steps(run) == [0, 1, 2, 8, 9]
    times = {e["event"]: round(e["t_s"], 6) for e in run.events_of("host")}
    assert times["condition_met"] == 0.5


def test_the_end_of_a_hang_from_before_a_restart_leaves_the_next_one_in_force(run_faults):
    first, second = entry("hang", at_s=0.1, for_s=0.5), entry("hang", at_s=0.5, for_s=0.3)
    run = run_faults(first, entry("restart", at_s=0.2), second)
    run.result()

    assert steps(run, number=".2") == [4, 8, 9]
    said = [(e["event"], round(e["t_s"], 3)) for e in run.events_of("agents/agent-04", number=".2")]
    assert said[1:3] == [("hang_begins", 0.5), ("hang_ends", 0.8)]


def test_a_link_that_is_down_loses_telemetry_and_delays_the_rest(run_faults):
    run = run_faults(entry("link_down", for_s=0.4))
    result = run.result()

    assert sorted(numbers(run)) == [0, 1, 2, 4, 5, 7, 8, 9]
    late = {what[0]: t_s for t_s, what in at_host(run)}
    assert late[4] >= 0.7 and late[5] >= 0.7
    assert between(run, "agent-01", "agent-04") == [0, 1, 2, 7, 8]
    assert between(run, "agent-01", "agent-02") == list(range(9))
    assert result["messages"]["reliable"]["lost"] == 0


def test_sides_of_a_partition_do_not_hear_each_other_and_the_host_hears_all(run_faults):
    run = run_faults(entry("partition", SOME, for_s=0.4))
    result = run.result()

    assert between(run, "agent-02", "agent-04") == list(range(9))
    assert between(run, "agent-01", "agent-04") == [0, 1, 2, 7, 8]
    assert between(run, "agent-04", "agent-01") == [0, 1, 2, 7, 8]
    assert numbers(run) == list(range(10))
    counts = result["between_agents"]
    assert (
        counts["sent"]
        == counts["delivered"] + counts["lost"] + counts["undelivered"] + (counts["in_flight"])
    )


def test_a_kill_is_refused_where_the_run_would_end_by_it(run_faults):
    run = run_faults(entry("kill"), restarts_max=None)
    result = run.result()

    [refused] = [e for e in run.events_of("host") if e["event"] == "action_refused"]
    assert "on_agent_loss: continue" in refused["reason"]
    assert (result["status"], result["lost"], result["lost_on_purpose"]) == ("complete", [], [])
