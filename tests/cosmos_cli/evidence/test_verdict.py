import dataclasses
import itertools
import math
from pathlib import Path

import pytest

from cosmos_cli.evidence.plugin_checks import plugin_checks
from cosmos_cli.evidence.remarks import malformed_check_remarks
from cosmos_cli.evidence.verdict import (
    CheckLimits,
    CheckResult,
    RunFacts,
    judge,
    why_no_rate,
)

TOP = Path(__file__).parents[3]
ORDER = (
    "interrupted 130, ended by a lost machine 3, failed 1, a machine failed 3, data incomplete 5,"
    " a check broken 4, not clean 3"
)
"""Of several endings that are true the first is told."""

GOOD = RunFacts(
    host_status="complete",
    miss_ratio=0.0,
    overrun_ratio=0.0,
    rtf=1.0,
    reliable_lost=0,
    sync_lost=0,
    sync_deadlines_broken=0,
)
BROKEN_CHECK = CheckResult(name="counter.lost", limit=0, got=1, passed=False)


def judged(**changes):
    return judge(dataclasses.replace(GOOD, **changes), CheckLimits())


def test_nothing_wrong_is_green():
    verdict = judged()

    assert (verdict.exit_code, verdict.status, verdict.broken) == (0, "complete", ())
    assert verdict.text.startswith("PASSED")


def test_verdict_on_a_run_that_went_on_without_agents_tells_why_they_were_lost():
    why = {
        "car-1": "Car.step raised ValueError: 2 faults (car.py:7)\nspeed",
        **{f"car-{number}": "it said nothing for 2.5 s" for number in range(2, 5)},
    }
    lost = tuple(why)

    assert judged(lost_agents=lost[:1], lost_because=why).text == (
        "CHECK BROKEN: agents.lost 1 (limit 0);"
        " lost: car-1: Car.step raised ValueError: 2 faults (car.py:7) ..."
    )
    assert judged(lost_agents=lost, lost_because=why).text.endswith(
        "; car-3: it said nothing for 2.5 s; and 1 more"
    )
    assert judged(lost_agents=lost[:1]).text == "CHECK BROKEN: agents.lost 1 (limit 0); lost: car-1"


@pytest.mark.parametrize(
    ("who", "reason", "text"),
    [
        ("operator", "interrupted by the operator", "INTERRUPTED by operator"),
        (None, None, "INTERRUPTED by the operator"),
        ("host", "ended by SIGTERM", "INTERRUPTED: host: ended by SIGTERM"),
    ],
)
def test_interrupted_run_says_by_whom_or_how(who, reason, text):
    verdict = judged(host_status="interrupted", who=who, reason=reason)

    assert verdict.text == text


@pytest.mark.parametrize(
    ("changes", "code", "status"),
    [
        ({"interrupted": True}, 130, "interrupted"),
        ({"host_status": "interrupted"}, 130, "interrupted"),
        ({"host_status": "failed"}, 1, "failed"),
        ({"host_status": "aborted"}, 1, "aborted"),
        ({"host_status": None}, 1, "failed"),
        ({"host_status": "who knows"}, 1, "failed"),
        ({"machine_problems": ("pi07: unreachable",)}, 3, "complete"),
        ({"missing": ("pi07: no records",)}, 5, "complete"),
        ({"lost_agents": ("a",)}, 4, "complete"),
        ({"miss_ratio": 2e-3}, 4, "complete"),
        ({"miss_ratio": None}, 4, "complete"),
        ({"overrun_ratio": 2e-3}, 4, "complete"),
        ({"rtf": 1.002}, 4, "complete"),
        ({"rtf": 0.998}, 4, "complete"),
        ({"rtf": None}, 4, "complete"),
        ({"rtf": math.nan}, 4, "complete"),
        ({"reliable_lost": 1}, 4, "complete"),
        ({"reliable_lost": None}, 4, "complete"),
        ({"sync_lost": 1}, 4, "complete"),
        ({"sync_deadlines_broken": 1}, 4, "complete"),
        ({"records_dropped": 1}, 4, "complete"),
        ({"records_truncated": 1}, 4, "complete"),
        ({"plugin_checks": (BROKEN_CHECK,)}, 4, "complete"),
        ({"problems": ("process 77 outlived SIGKILL",)}, 3, "complete"),
    ],
)
def test_single_fault_has_its_exit_code(changes, code, status):
    verdict = judged(**changes)

    assert (verdict.exit_code, verdict.status) == (code, status)


FAULTS = (
    (130, {"interrupted": True}),
    (3, {"host_status": "aborted", "is_ended_by_machine": True}),
    (1, {"host_status": "aborted"}),
    (3, {"machine_problems": ("pi07: unreachable",)}),
    (5, {"missing": ("pi07: no records",)}),
    (4, {"miss_ratio": 0.5}),
    (3, {"problems": ("process 77 outlived SIGKILL",)}),
)


@pytest.mark.parametrize(
    "faults", [c for n in (2, 3, 7) for c in itertools.combinations(FAULTS, n)]
)
def test_of_several_faults_the_first_in_order_decides(faults):
    changes = {key: value for _, fault in faults for key, value in fault.items()}

    assert judged(**changes).exit_code == faults[0][0]


def test_documents_and_code_tell_one_order():
    codes = [int(word) for word in ORDER.replace(",", "").split() if word.isdecimal()]
    texts = [(TOP / name).read_text(encoding="utf-8") for name in ("README.md", "docs/fleet.md")]

    assert codes == [code for code, _ in FAULTS]
    for text in (*texts, judge.__doc__ or ""):
        assert ORDER in " ".join(text.split())


def test_a_machine_that_is_lost_ends_a_complete_run_no_differently():
    assert judged(is_ended_by_machine=True).exit_code == 0


def test_limits_themselves_still_hold():
    facts = dataclasses.replace(GOOD, miss_ratio=0.25, overrun_ratio=0.25, rtf=1.5)

    assert judge(facts, CheckLimits(miss_ratio_max=0.25, rtf_tolerance=0.5)).exit_code == 0


def test_text_names_who_and_why():
    verdict = judged(host_status="aborted", who="agent-03", reason="killed by SIGKILL")

    assert verdict.text == "ABORTED: agent-03: killed by SIGKILL"


def test_host_that_said_nothing_is_named():
    verdict = judged(host_status=None)

    assert verdict.who == "host"
    assert "without a result" in verdict.text


def test_host_that_could_not_be_started_is_told_as_that():
    problems = ("host cannot be started: Too many open files",)

    verdict = judged(host_status=None, problems=problems)

    assert verdict.text == "FAILED: host: cannot be started: Too many open files"
    assert verdict.reason == "cannot be started: Too many open files"


def test_every_broken_check_is_told_with_its_limit():
    verdict = judged(miss_ratio=0.01, rtf=1.5)

    assert "deadline.miss_ratio 0.01 (limit 0.001)" in verdict.text
    assert "time.rtf 0.5 (limit 0.001)" in verdict.text


def test_many_faults_are_cut_short_in_the_text():
    verdict = judged(missing=tuple(f"pi{i:02d}: no records" for i in range(24)))

    assert verdict.text.endswith("pi02: no records; and 21 more")


def test_worst_of_all_agents_counts_for_each_name():
    summaries = {
        f"a{got}": {"checks": [{"name": "x", "limit": 5, "got": got, "passed": got <= 5}]}
        for got in (1, 9, 7, 4)
    }

    assert plugin_checks(summaries) == [
        CheckResult(name="x", limit=5, got=9, passed=False, worst="a9")
    ]


def test_worst_of_passing_checks_is_the_one_nearest_its_limit():
    summaries = {
        f"a{got}": {"checks": [{"name": "x", "limit": 5, "got": got, "passed": True}]}
        for got in (1, 4, 2)
    }

    (check,) = plugin_checks(summaries)

    assert (check.got, check.worst) == (4, "a4")


@pytest.mark.parametrize(("passed", "worst"), [(True, None), (False, "a1")])
def test_nobody_is_the_worst_of_checks_that_hold_alike(passed, worst):
    checks = {"checks": [{"name": "x", "limit": 5, "got": 3, "passed": passed}]}

    (check,) = plugin_checks({"a1": checks, "a2": checks, "a3": checks})

    assert check.worst == worst


def test_check_names_itself_whose_its_value_is():
    check = {"name": "x", "limit": 5, "got": 9, "passed": False, "worst": "a7"}

    assert plugin_checks({"host": {"checks": [check]}})[0].worst == "a7"


@pytest.mark.parametrize("got", [None, math.nan, math.inf])
def test_value_that_is_not_finite_was_not_measured_whatever_the_plugin_says(got):
    item = {"name": "x", "limit": 1, "got": got, "passed": True}

    (check,) = plugin_checks({"agent-07": {"checks": [item]}})

    assert check == CheckResult(name="x", limit=1, got=None, passed=False, worst="agent-07")
    assert "x not measured (limit 1, worst: agent-07)" in judged(plugin_checks=(check,)).text


def test_ratio_over_all_agents_is_not_told_as_that_of_the_worst():
    verdict = judged(miss_ratio=0.0276, worst={"deadline.miss_ratio": "agent-23"})

    assert verdict.text.startswith(
        "CHECK BROKEN: deadline.miss_ratio 0.0276 (limit 0.001, worst: agent-23)"
    )


def test_values_that_are_not_finite_break_a_check_of_their_own():
    verdict = judged(records_not_finite=60, worst={"records.not_finite": "agent-02/drive"})

    assert (verdict.exit_code, verdict.broken[0].worst) == (4, "agent-02/drive")
    assert "records.not_finite 60 (limit 0, worst: agent-02/drive)" in verdict.text
    assert judge(
        dataclasses.replace(GOOD, records_not_finite=60), CheckLimits(not_finite_max=60)
    ).text.startswith("PASSED")


@pytest.mark.parametrize(
    "item",
    [
        {"name": "x", "limit": math.nan, "got": 0, "passed": True},
        {"name": "x", "limit": 1, "got": "0", "passed": True},
        {"name": "x", "limit": 1, "got": 0, "passed": "yes"},
        {"name": "x", "got": 0, "passed": True},
        {"name": "x\x1b[31m\n", "limit": 1, "got": 0, "passed": True},
        {"name": "x" * 201, "limit": 1, "got": 0, "passed": True},
        "x",
        None,
    ],
)
def test_malformed_check_is_a_broken_one_named_after_who_made_it(item):
    good = {"name": "y", "limit": 1, "got": 0, "passed": True}

    broken, held = plugin_checks({"agent-07": {"checks": [item, good]}})

    name = "agent-07"
    assert broken == CheckResult(name=f"{name}.checks", limit=0, got=None, passed=False, worst=name)
    assert (held.name, held.passed) == ("y", True)


@pytest.mark.parametrize(
    "listed", [None, 3, "x", {"name": "x", "limit": 1, "got": 0, "passed": True}]
)
def test_checks_that_are_no_list_are_a_broken_check(listed):
    (check,) = plugin_checks({"host": {"checks": listed}})

    assert (check.name, check.passed, check.got) == ("host.checks", False, None)


def test_what_is_wrong_with_a_malformed_check_is_a_remark_with_who_returned_it():
    check = {"name": "gap_m", "limit": 1.0, "got": 0.5, "passed": 1}
    summaries = {
        "host": {"checks": {**check, "passed": True}},
        "agent-01": {"checks": [check, {**check, "passed": True}]},
        "agent-02": {"checks": [check]},
        "agent-03": {"checks": [{**check, "passed": True, "limit": None}]},
        "agent-04": {"checks": [{**check, "passed": True, "name": "gap\x1b\n"}, "gap\x1b"]},
    }

    assert malformed_check_remarks(summaries) == (
        "host: checks of finish(): expected a list of mappings, got {'name': 'gap_m', 'limit': 1.0, 'got': 0.5,"
        " 'passed': True}",
        "agent-01, agent-02: checks of finish(): passed of 'gap_m': expected true or false, got 1",
        "agent-03: checks of finish(): limit of 'gap_m': expected a finite number, got None",
        r"agent-04: checks of finish(): name of 'gap\x1b\n': expected a name of at most 200 printable characters, got"
        r" 'gap\x1b\n'",
        r"agent-04: checks of finish(): expected a list of mappings, got gap\x1b",
    )


def test_the_worst_of_a_check_is_a_name_that_can_be_shown():
    check = {"name": "gap_m", "limit": 1.0, "got": 0.5, "passed": True, "worst": "a\x1b[31m"}

    assert plugin_checks({"host": {"checks": [check]}})[0].worst == "host"


def test_a_halfs_check_with_the_name_of_another_is_a_remark():
    def check(name):
        return CheckResult(name=name, limit=1, got=0, passed=True)

    twice = judged(
        plugin_checks=(check("agents.lost"), check("gap_m"), check("own_m")),
        expectations=(check("gap_m"),),
    )
    once = judged(plugin_checks=(check("own_m"),), expectations=(check("gap_m"),))

    (remark,) = twice.remarks
    assert "more than one is called agents.lost, gap_m: " in remark
    assert once.remarks == ()


@pytest.mark.parametrize("summary", [{}, {"checks": []}, {"checks": ()}])
def test_summary_without_checks_has_none(summary):
    assert plugin_checks({"host": summary}) == []


def test_one_late_wake_up_does_not_decide_the_real_time_factor_of_a_short_run():
    facts = dataclasses.replace(GOOD, rtf=1.009)

    assert judge(facts, CheckLimits(duration_s=2.0)).exit_code == 0
    assert judge(facts, CheckLimits(duration_s=2.3)).exit_code == 4
    assert CheckLimits(duration_s=60.0).rtf_error_max == 1e-3


def test_real_time_factor_of_a_single_tick_is_not_judged_and_that_is_said():
    verdict = judged(rtf=None, no_rate=why_no_rate({}, 1))

    assert verdict.exit_code == 0
    assert "time.rtf" not in [check.name for check in verdict.checks]
    assert verdict.remarks == ("time.rtf: not judged: a single tick has no rate",)


@pytest.mark.parametrize(
    ("states", "on_purpose", "lost", "is_judged"),
    [
        (("lost", "lost"), ["a", "b"], [], False),
        (("lost", "complete"), ["a", "b"], [], True),
        (("lost", "lost"), ["a"], ["b"], True),
        (("lost", "lost"), ["a", "b"], ["b"], True),
        ((), [], [], True),
    ],
)
def test_real_time_factor_of_agents_that_are_all_away_on_purpose_is_not_judged(
    states, on_purpose, lost, is_judged
):
    agents = {
        name: {"state": state, "ticks": {"run": 40}}
        for name, state in zip("ab", states, strict=False)
    }
    result = {"agents": agents, "lost_on_purpose": on_purpose, "lost": lost}

    verdict = judged(rtf=None, no_rate=why_no_rate(result, 40))

    assert ("time.rtf" in [check.name for check in verdict.checks]) is is_judged
    told = "time.rtf: not judged: all agents were away on purpose at the end"
    assert (told in verdict.remarks) is not is_judged


@pytest.mark.parametrize(
    ("ticks", "on_purpose", "is_judged"),
    [
        ({"run": 1}, ["a", "b"], False),
        (None, ["a", "b"], False),
        ({"run": 2}, ["a", "b"], True),
        ({"run": 1}, ["b"], True),
    ],
)
def test_real_time_factor_of_agents_that_came_back_for_no_two_ticks_is_not_judged(
    ticks, on_purpose, is_judged
):
    agents = {"a": {"state": "stopped", "ticks": ticks}, "b": {"state": "lost"}}
    result = {"agents": agents, "lost_on_purpose": on_purpose, "lost": []}

    verdict = judged(rtf=None, no_rate=why_no_rate(result, 40))

    assert ("time.rtf" in [check.name for check in verdict.checks]) is is_judged
    told = "time.rtf: not judged: all agents were ended on purpose, and none was back for two ticks"
    assert (told in verdict.remarks) is not is_judged


def test_reason_of_several_lines_is_one_in_the_verdict():
    verdict = judged(host_status="aborted", who="agent-03", reason="ValueError: a\n  b\nc")

    assert verdict.text == "ABORTED: agent-03: ValueError: a ..."
    assert verdict.reason == "ValueError: a\n  b\nc"


def test_in_lockstep_nothing_is_late():
    changes = {"rtf": 500.0, "miss_ratio": None, "overrun_ratio": None}
    verdict = judged(is_lockstep=True, **changes)

    assert (verdict.exit_code, verdict.broken) == (0, ())
    assert not any(check.name.startswith(("deadline.", "time.")) for check in verdict.checks)
    assert verdict.remarks == (
        "time.rtf, deadline.miss_ratio, deadline.overrun_ratio: not judged: in lockstep time waits",
    )
    assert judged(**changes).exit_code == 4


@pytest.mark.parametrize(
    ("got", "limit"), [(100000.4, 100000.0), (1000001, 1000000), (0.5000001, 0.5)]
)
def test_what_breaks_a_limit_by_its_later_digits_is_told_apart_from_it(got, limit):
    check = CheckResult(name="a", limit=limit, got=got, passed=False)

    assert judged(plugin_checks=(check,)).text == f"CHECK BROKEN: a {got} (limit {limit:g})"


def test_the_time_of_a_broken_check_is_told_to_the_tick():
    check = CheckResult(
        name="a", limit=1.0, got=2.0, passed=False, t_s=86399.99, expected="each below 1"
    )

    assert judged(expectations=(check,)).text.endswith("a 2 at 86399.99 s (expected each below 1)")
