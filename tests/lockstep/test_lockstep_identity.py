"""A run in lockstep repeats to the bit, whatever the number of its workers; and what happens when in it."""

import pytest

pytestmark = pytest.mark.process


def summaries(result):
    agents = {name: agent["simulation"] for name, agent in result["agents"].items()}
    return result["simulation"], agents, result["messages"]


def test_records_and_summaries_are_the_same_for_any_number_of_workers(start_host):
    runs = [
        start_host(per_process=6, run="0001-lockstep"),
        start_host(per_process=3, run="0002-lockstep"),
        start_host(per_process=2, run="0003-lockstep"),
        start_host(per_process=3, run="0004-lockstep"),
    ]
    results = [run.result() for run in runs]

    assert [result["status"] for result in results] == ["complete"] * 4
    assert [result["workers"] for result in results] == [1, 2, 3, 2]
    first = runs[0].hashes()
    assert len(first) == 3 + 6 * 3  # events and log of each, and what the simulation opened
    for run, result in zip(runs, results, strict=True):
        assert run.hashes() == first
        assert summaries(result) == summaries(results[0])


def test_another_seed_gives_other_records(start_host):
    runs = [start_host(seed=7), start_host(seed=8)]
    results = [run.result() for run in runs]

    assert summaries(results[0]) != summaries(results[1])
    changed = {
        path for path, digest in runs[0].hashes().items() if runs[1].hashes()[path] != digest
    }
    assert "host/heard.jsonl" in changed
    assert "agents/agent-04/log.jsonl" in changed


def test_everything_happens_at_its_simulated_time(start_host):
    run = start_host()
    result = run.result()

    heard = run.records("host/heard.jsonl")
    times = [t_s for t_s, _, _ in heard]
    assert times == sorted(times)
    # Jobs of set-up are done before all else, in the order in which they were submitted.
    assert heard[:6] == [[-0.5, "job", [n + 1, n * n]] for n in range(6)]
    # What agents send while they set themselves up comes next, in the order of agents.
    assert [who for _, who, what in heard[6:12]] == [f"agent-0{n}" for n in range(1, 7)]
    assert all(what == ["set up", True] for _, _, what in heard[6:12])
    of_agents = [(t_s, who, what) for t_s, who, what in heard if who.startswith("agent")]
    ticks = [(t_s, who, what[1]) for t_s, who, what in of_agents if what[0] == "tick"]
    assert ticks == [(n / 10, f"agent-0{m}", n) for n in range(10) for m in range(1, 7)]
    # A job takes no simulated time: its value is there before the next message.
    at = heard.index(next(one for one in heard if one[1:] == ["job", [7, 100 * 100]]))
    assert heard[at][0] == 0.2
    assert heard[at - 1][1:] == ["agent-01", heard[at - 1][2]]
    # The timer is called at exactly the times that it asked for.
    timers = [what for _, who, what in heard if who == "timer"]
    assert timers[0] == -0.5
    assert timers == sorted(timers) and timers[-1] <= 1.0
    assert all(b == a + 0.037 for a, b in zip(timers, timers[1:], strict=False))
    assert result["messages"]["best"]["sent"] == 4 * 6 * 2
    # The last word is theirs: after `finish` no job's value is handed in.
    assert heard[-6:] == [[1.0, f"agent-0{n}", ["last word", n - 1]] for n in range(1, 7)]


def test_an_answer_comes_before_the_next_tick(start_host):
    run = start_host()
    run.result()

    own = run.records("agents/agent-05/own.jsonl")
    kinds = ["tick" if isinstance(what[0], int) else "answer" for _, what in own]
    assert kinds == ["tick"] + ["answer", "tick"] * 9 + ["answer"]
    assert [t_s for t_s, _ in own] == [0.0] + [n / 10 for n in range(1, 10) for _ in "ab"] + [1.0]
    index, t_s, period_s, lateness_s, missed, deadline_s = own[4][1]
    assert (index, t_s, period_s, lateness_s, missed, deadline_s) == (2, 0.2, 0.1, 0.0, 0, 0.2)


def test_the_host_tells_how_far_it_is_and_how_fast(start_host):
    run = start_host()
    result = run.result()

    states = [event["state"] for event in run.events if event["event"] == "state"]
    assert states[:5] == [
        "HOST_STARTUP",
        "SIMULATION_SETUP",
        "HOST_SIMULATION_READY",
        "SIMULATION_START",
        "SIMULATION_COMPLETE",
    ]
    last = [event for event in run.events if event["event"] == "progress"][-1]
    assert last["is_lockstep"]
    told = (last["t_s"], last["running"], last["complete"])
    assert told == (result["duration_s"], 0, len(result["agents"]))
    assert result["rtf"] == pytest.approx(result["duration_s"] / result["wall_s"], abs=1e-2)
    assert run.process.returncode == 0


def test_a_deadline_that_lies_in_the_past_is_counted(start_host):
    run = start_host(fault="send_late")
    result = run.result()

    assert result["status"] == "complete"
    assert result["messages"]["sync"]["deadlines_broken"] == 6


def test_what_agents_send_comes_in_their_order_whoever_shares_a_process(start_host):
    simulation = "./answering_simulation.py:simulation"
    runs = [start_host(per_process=number, simulation=simulation) for number in (6, 2, 1)]
    for run in runs:
        assert run.result()["status"] == "complete"

    heard = runs[0].records("host/heard.jsonl")
    in_tick = [[who, what] for t_s, who, what in heard if t_s == 0.1]
    assert in_tick == [[f"agent-0{n}", what] for n in range(1, 7) for what in ("answer", "step")]
    assert runs[1].hashes() == runs[0].hashes()
    assert runs[2].hashes() == runs[0].hashes()
