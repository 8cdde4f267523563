"""The tables of a suite count one thing by one word."""

from pathlib import Path

import pytest

from cosmos_cli.bench import suite
from cosmos_cli.bench.child_run import ChildRunOutcome
from cosmos_cli.bench.suite import ROUND_TRIPS, SUMMARY, SuiteRun
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.ui.console import Console

SCENARIO = Path(__file__).parents[3] / "scenarios" / "thesis" / "benchmark_at_once.yaml"


def test_a_run_that_takes_too_long_ends_no_suite_and_was_interrupted_by_nobody():
    scenario = load_scenario(SCENARIO)
    too_long = ChildRunOutcome(exit_code=130, is_too_long=True)
    interrupted = ChildRunOutcome(exit_code=130, is_interrupted=True)

    ends = [each.is_last for each in (too_long, interrupted)]
    codes = [
        suite.suite_exit_code([SuiteRun(scenario=scenario, outcome=each)])
        for each in (too_long, interrupted)
    ]

    assert (ends, codes) == ([False, True], [ExitCode.RUN_FAILED, ExitCode.INTERRUPTED])


def test_ticks_are_those_that_were_done_in_the_table_of_a_run_and_in_that_of_all():
    trips = [{"seen_by": "agent", "agent": name, "count": 398} for name in ("agent-01", "all")]
    counts = {"agent-01": {"sent": 398, "lost": 0, "ticks": 398, "missed": 9}}
    document = {
        "run": "0001-x",
        "status": "complete",
        "timing": {"ticks": 407, "missed": 9},
        "benchmark": {"round_trips_ms": trips, "agents": counts},
    }
    outcome = ChildRunOutcome(exit_code=0, document=document)
    made = SuiteRun(scenario=load_scenario(SCENARIO), outcome=outcome, document=document)

    def told(columns, row):
        cells = dict(zip((column.heading for column in columns), row, strict=True))
        return cells["ticks"], cells["missed"]

    assert [told(ROUND_TRIPS, row) for row in made.rows()] == [("398", "9")] * 2
    assert [told(SUMMARY, row) for row in made.summary_rows()] == [("398", "9")]


def test_a_run_that_refuses_its_input_later_costs_no_figure_of_those_before(monkeypatch, capsys):
    """As one whose inventory was changed meanwhile."""
    made = ChildRunOutcome(exit_code=0, document={"run": "", "verdict": "PASSED"})
    answers = [made, InputError("tower.yaml:3: expected a machine"), made]

    def run_child(words, *, limit_s, is_quiet):
        answer = answers.pop(0)
        if isinstance(answer, InputError):
            raise answer
        return answer

    monkeypatch.setattr(suite, "run_child", run_child)
    console = Console(json=False, quiet=False)
    scenarios = [load_scenario(SCENARIO)] * 3

    done = suite.run_suite(scenarios, [], Path("runs"), console)

    assert [each.outcome.exit_code for each in done] == [0, 2, 0]
    assert suite.suite_exit_code(done) == 2
    assert "tower.yaml:3: expected a machine" in capsys.readouterr().err
    answers = [InputError("tower.yaml:3: expected a machine")]
    with pytest.raises(InputError):
        suite.run_suite(scenarios, [], Path("runs"), console)
