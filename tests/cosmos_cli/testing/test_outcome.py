"""The judgement of a test: what its run came to beside what is expected."""

import pytest
from suite_cases import broken, make_case, make_result

from cosmos_cli.models.scenario_test import ExpectedOutcome
from cosmos_cli.testing.check_lines import check_line
from cosmos_cli.testing.figures import ComparedFigure
from cosmos_cli.testing.outcome import judge_case, with_figures
from cosmos_cli.testing.terminal import details


def judged(expect=None, result=None, *, is_interrupted=False):
    case = make_case(expect=expect or ExpectedOutcome())
    return judge_case(case, result or make_result(), is_interrupted=is_interrupted)


@pytest.mark.parametrize(
    ("expect", "result", "outcome"),
    [
        ({}, make_result(0), "passed"),
        ({}, make_result(4, broken("a")), "failed"),
        ({"exit_code": 4}, make_result(4, broken("a")), "passed"),
        ({"exit_code": 4}, make_result(0), "failed"),
        ({"exit_code": 4, "broken": ("a",)}, make_result(4, broken("a")), "passed"),
        ({"exit_code": 4, "broken": ("a*",)}, make_result(4, broken("a1"), broken("a2")), "passed"),
        ({"exit_code": 4, "broken": ("a",)}, make_result(4, broken("a"), broken("b")), "failed"),
        ({"exit_code": 4, "broken": ("a", "b")}, make_result(4, broken("a")), "failed"),
        ({"verdict": "hold"}, make_result(0), "passed"),
        ({"verdict": "agent-07"}, make_result(0), "failed"),
        ({}, make_result(-9, document={}), "failed"),
        ({}, make_result(0, document={}), "failed"),
        ({"exit_code": 1}, make_result(1, document={}), "failed"),  # as any program that crashed
        ({}, make_result(0, is_too_long=True), "failed"),
        ({"exit_code": 130}, make_result(130, is_too_long=True), "failed"),
    ],
)
def test_passes_with_what_is_expected_and_with_nothing_else(expect, result, outcome):
    assert judged(ExpectedOutcome(**expect), result).outcome == outcome


def test_a_failure_names_checks_worst_agent_run_and_the_command_that_repeats_it():
    check = broken("drift", worst="agent-07", unit="m", t_s=12.5)
    case = make_case("ring", overrides=("time.duration_s=20", "seed=3"), seed=3)
    outcome = judge_case(
        case,
        make_result(4, check, directory="/my runs/tests/0001-ring"),
        is_interrupted=False,
    )

    told = details(outcome)
    assert "  drift: got 2.5 m, limit 1 m, worst: agent-07 at 12.5 s" in told
    assert "repeat it: cosmos run ring.yaml --set time.duration_s=20 --set seed=3" in told
    assert "its run: /my runs/tests/0001-ring" in told
    assert "its figures: cosmos report '/my runs/tests/0001-ring'" in told


def test_a_check_that_is_broken_by_its_later_digits_is_told_with_them():
    lines = [check_line(broken("a", limit=200, got=got)) for got in (200 + 2**-40, 200.0)]

    assert lines == ["a: got 200.0000000000009, limit 200", "a: got 200, limit 200"]


def test_the_scenarios_own_seed_is_in_the_command_that_repeats_it():
    assert make_case(seed=11).repeat_command == "cosmos run s.yaml --set seed=11"


def test_what_repeats_a_run_does_so_on_this_computer_as_the_test_did(monkeypatch):
    monkeypatch.setenv("COSMOS_INVENTORY", "tower.yaml")
    monkeypatch.delenv("COSMOS_LIMIT", raising=False)

    told = make_case(seed=11).repeat_command

    assert told == "env -u COSMOS_INVENTORY cosmos run s.yaml --set seed=11"


def test_a_run_that_was_cut_by_ctrl_c_did_not_fail():
    cut = make_result(130)
    assert judged(result=cut, is_interrupted=True).outcome == "interrupted"
    assert judged(result=cut).outcome == "failed"  # somebody ended that run alone
    assert judged(result=make_result(0), is_interrupted=True).outcome == "passed"
    assert judged(result=make_result(-9, document={}), is_interrupted=True).outcome == "interrupted"


def test_a_run_that_ctrl_c_met_as_python_began_did_not_fail():
    words = 'Traceback (most recent call last):\n  File "<frozen site>"\nKeyboardInterrupt'
    cut = make_result(1, document={}, words=words)

    assert judged(result=cut, is_interrupted=True).outcome == "interrupted"
    assert judged(result=cut).outcome == "failed"
    crashed = make_result(1, document={}, words="ValueError: x")
    assert judged(result=crashed, is_interrupted=True).outcome == "failed"


def test_a_run_beyond_its_deadline_failed_though_ctrl_c_came_while_it_ended():
    for exit_code in (130, -9):
        outcome = judged(result=make_result(exit_code, is_too_long=True), is_interrupted=True)

        assert outcome.outcome == "failed"
        assert outcome.reasons == ("not done after 60 s (its deadline), and ended",)


def test_a_figure_out_of_tolerance_fails_and_says_what_was_expected():
    good = ComparedFigure(name="a", expected=1.0, got=1.05, allowed=0.1)
    bad = ComparedFigure(name="b", expected=1.0, got=1.2, allowed=0.1)

    assert with_figures(judged(), [good]).outcome == "passed"
    outcome = with_figures(judged(), [good, bad])
    assert outcome.outcome == "failed"
    assert outcome.reasons == ("baseline: b: expected 1 within 0.1, got 1.2",)


def test_a_figure_without_a_value_is_told_and_not_those_that_could_be_written():
    none = ComparedFigure(name="a", expected=None, got=None, why_none="no stream x")
    new = ComparedFigure(name="b", expected=None, got=1.0)

    assert with_figures(judged(), [none, new]).reasons == (
        "baseline: a: no stream x",
        "baseline: b: has no expected value: write it with cosmos test --update-baselines",
    )
    assert with_figures(judged(), [none, new], why_not_written="nothing is written").reasons == (
        "baseline: a: no stream x",
        "baseline: nothing is written",
    )


def test_a_baseline_that_cannot_be_written_fails_its_test_alone():
    outcome = with_figures(judged(), [], why_not_written="b.yaml: cannot be written")

    assert outcome.outcome == "failed"
    assert outcome.reasons == ("baseline: b.yaml: cannot be written",)
