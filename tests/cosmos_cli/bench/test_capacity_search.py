"""Doubling and bisection, and what ends a search; no run is started."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.bench.capacity import SCENARIO, CapacityFound, CapacityTrials, find_capacity
from cosmos_cli.bench.child_run import ChildRunOutcome
from cosmos_cli.bench.prediction import predict
from cosmos_cli.bench.search import CapacitySearch
from cosmos_cli.commands.fleet_command import some_machines
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.models.inventory.machine import LOOPBACK
from cosmos_cli.models.loading import load_scenario


def tried(search, capacity):
    """Search where *capacity* agents hold; return the numbers tried."""
    found = []
    while (count := search.following()) is not None:
        found.append(count)
        search.tell(count, holds=count <= capacity)
    return found


@pytest.mark.parametrize(
    ("search", "capacity", "numbers", "found"),
    [
        ((8, 5000, 0.0), 20, [8, 16, 32, 24, 20, 22, 21], (20, 21)),
        ((8, 5000, 0.05), 100, [8, 16, 32, 64, 128, 96, 112, 104, 100], (100, 104)),
        ((8, 5000, 0.05), 5, [8, 4, 6, 5], (5, 6)),
        ((8, 5000, 0.05), 0, [8, 4, 2, 1], (0, 1)),
        ((1, 5000, 0.05), 0, [1], (0, 1)),
        ((8, 20, 0.05), 99, [8, 16, 20], (20, None)),
        ((8, 20, 0.05), 18, [8, 16, 20, 18, 19], (18, 19)),
        ((1, 1, 0.05), 9, [1], (1, None)),
        ((8, 5000, 1.0), 20, [8, 16, 32], (16, 32)),
    ],
)
def test_doubles_then_bisects(search, capacity, numbers, found):
    first, largest, resolution = search
    search = CapacitySearch(first=first, largest=largest, resolution=resolution)

    assert tried(search, capacity) == numbers
    assert (search.held, search.broken) == found


@pytest.mark.parametrize("capacity", range(0, 300, 7))
def test_what_is_found_is_within_the_resolution(capacity):
    search = CapacitySearch(first=3, largest=5000)

    assert len(tried(search, capacity)) < 20
    assert search.held <= capacity < search.broken
    assert search.broken - search.held <= max(1, 0.05 * search.held)


def test_number_that_was_not_asked_for_is_refused():
    search = CapacitySearch(first=8, largest=64)
    search.tell(8, holds=True)

    with pytest.raises(ValueError, match="8 < count"):
        search.tell(8, holds=False)


def test_bounds_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="1 <= first <= largest"):
        CapacitySearch(first=9, largest=8)


def settings(**more):
    chosen = {"hz": 100.0, "max_miss_ratio": 1e-3, "seconds": 2.0, "per_process": 3}
    return CapacityTrials(**chosen, **more)


class Runs:
    """Stands for runs: they keep the budget up to a number of agents."""

    def __init__(self, capacity, **special):
        self.capacity = capacity
        self.special = special
        self.agents = []

    def __call__(self, arguments, *, limit_s, is_quiet):
        settings = [word for flag, word in pairwise(arguments) if flag == "--set"]
        scenario = load_scenario(Path(arguments[0]), settings).scenario
        count = scenario.agents.count
        self.agents.append(count)
        assert (scenario.agents.tick_hz, scenario.agents.per_process) == (100.0, min(3, count))
        assert scenario.deadline.max_miss_ratio == 1e-3
        number = f"n{len(self.agents)}"
        if isinstance(special := self.special.get(number), Exception):
            raise special
        if special is not None:
            return special
        holds = count <= self.capacity
        document = {"run": f"00-{count}", "verdict": "PASSED" if holds else "too many missed"}
        return ChildRunOutcome(exit_code=0 if holds else 4, document=document)


def search(runs, **more):
    said = []
    found = find_capacity(settings(**more), SCENARIO, ["--runs", "x"], said.append, runs)
    return found, said


def test_trials_are_runs_and_are_told():
    found, said = search(Runs(20), resolution=0.0)

    assert [(trial.agents, trial.holds) for trial in found.trials][:4] == [
        (8, True),
        (16, True),
        (32, False),
        (24, False),
    ]
    assert found.words == "20 agents keep it, 21 do not"
    assert found.exit_code == ExitCode.OK
    assert "trial 3: 32 agents at 100 Hz for 2 s" in said
    assert "  budget broken: too many missed" in said
    assert found.trials[2].to_mapping()["run"] == "00-32"


def test_budget_that_no_number_keeps_ends_with_4():
    found, _ = search(Runs(0), first=2)

    assert found.exit_code == ExitCode.BUDGET_BROKEN
    assert found.words == "1 agent breaks it, and no smaller number kept it"


@pytest.mark.parametrize(
    ("special", "exit_code", "stopped_by"),
    [
        (ChildRunOutcome(exit_code=130, is_interrupted=True), ExitCode.INTERRUPTED, "interrupted"),
        (
            ChildRunOutcome(exit_code=3, last_words="pi07 is gone"),
            ExitCode.MACHINES,
            "pi07 is gone",
        ),
    ],
)
def test_interruption_and_lost_machines_end_the_search(special, exit_code, stopped_by):
    found, _ = search(Runs(99, n3=special), is_machines_fault=True)

    assert (found.exit_code, found.stopped_by) == (exit_code, stopped_by)
    assert [trial.agents for trial in found.trials] == [8, 16]
    assert found.words == "at least 16 agents keep it"


def test_a_number_that_the_scenario_refuses_ends_the_search_with_what_it_has_found():
    refused = InputError("s.yaml:3: agents.count: 10 satellites for 16 agents")

    found, _ = search(Runs(99, n2=refused))

    assert found.words == "at least 8 agents keep it"
    assert found.exit_code == ExitCode.OK
    assert found.stopped_by == f"with 16 agents {refused}"


def test_a_scenario_that_refuses_its_first_trial_is_bad_input():
    with pytest.raises(InputError):
        search(Runs(99, n1=InputError("s.yaml:3: no")))


def test_a_refusal_before_any_number_held_is_not_green():
    found, _ = search(Runs(0, n2=InputError("at least 8 agents")))

    assert (found.exit_code, found.words) == (
        ExitCode.BUDGET_BROKEN,
        "8 agents break it, and no smaller number kept it",
    )


@pytest.mark.parametrize(
    "special",
    [
        ChildRunOutcome(exit_code=1, last_words="silent for 2.5 s"),
        ChildRunOutcome(exit_code=3, last_words="out of memory"),
        ChildRunOutcome(exit_code=130, is_too_long=True),
    ],
)
def test_run_that_fails_here_breaks_the_budget(special):
    found, _ = search(Runs(99, n2=special))

    assert found.trials[1].holds is False
    assert (found.search.held, found.search.broken) == (15, 16)


def test_number_counts_as_too_large_only_after_so_many_tries():
    once = ChildRunOutcome(exit_code=4)
    found, _ = search(Runs(99, n2=once), tries=2, largest=16)

    assert [(t.agents, t.holds) for t in found.trials] == [(8, True), (16, False), (16, True)]
    assert found.search.held == 16


def test_a_search_of_many_tries_comes_to_its_end():
    found, _ = search(Runs(2600), tries=10, resolution=0.0)

    assert (found.search.held, found.search.broken) == (2600, 2601)
    assert found.stopped_by == ""


def test_no_trial_begins_when_the_time_is_over():
    runs = Runs(99)
    found, _ = search(runs, end_s=0.0)

    assert (runs.agents, found.stopped_by, found.words) == (
        [],
        "the time is over",
        "nothing is known yet",
    )
    assert found.exit_code == ExitCode.BUDGET_BROKEN  # no number was found


def test_search_whose_time_is_over_before_a_number_held_has_found_none(monkeypatch):
    times_s = iter([0.0, 60.0])
    monkeypatch.setattr("cosmos_cli.bench.capacity.time.monotonic", lambda: next(times_s))
    found, _ = search(Runs(0), end_s=60.0)

    assert (found.stopped_by, found.search.held) == ("the time is over", 0)
    assert found.words == "8 agents break it, and no smaller number kept it"
    assert found.exit_code == ExitCode.BUDGET_BROKEN


def test_search_whose_time_is_over_has_found_what_held_until_then(monkeypatch):
    times_s = iter([0.0, 60.0])
    monkeypatch.setattr("cosmos_cli.bench.capacity.time.monotonic", lambda: next(times_s))
    found, _ = search(Runs(99), end_s=60.0)

    assert (found.stopped_by, found.words) == ("the time is over", "at least 8 agents keep it")
    assert found.exit_code == ExitCode.OK


def test_the_prediction_is_of_the_machine_that_runs_the_host_as_cosmos_plan_has_it(tmp_path):
    path = tmp_path / "tower.yaml"
    path.write_text("all: {hosts: {m1: {ansible_host: 10.0.0.1}, m2: {ansible_host: 10.0.0.2}}}\n")
    machines = some_machines([str(path)], None, "m1")
    scenario = load_scenario(
        SCENARIO, ["agents.count=8", "agents.tick_hz=100", "plan.step_s=0.002"]
    )

    elsewhere, on_board = (
        predict(scenario, machines, per_process=1, host=host).agents for host in (None, "m1")
    )

    assert 0 < on_board < elsewhere


@pytest.mark.parametrize("per_process", [1, 8, 50])
@pytest.mark.parametrize("first", [1, 8])
def test_the_prediction_is_of_full_processes_however_few_agents_a_first_trial_has(
    monkeypatch, capsys, first, per_process
):
    nothing = CapacityFound(search=CapacitySearch(first=1, largest=1))
    monkeypatch.setattr("cosmos_cli.commands.bench_capacity.find_capacity", lambda *given: nothing)
    words = ("--hz", "1000", "--first", str(first), "--per-process", str(per_process))
    cosmos(["bench", "capacity", *words, "--json", "--quiet"])
    told = json.loads(capsys.readouterr().out)

    settings = ["agents.count=50", "agents.tick_hz=1000", f"agents.per_process={per_process}"]
    plan = predict(load_scenario(SCENARIO, settings), (LOOPBACK,), per_process=per_process)
    assert told["predicted"] == dataclasses.asdict(plan)
