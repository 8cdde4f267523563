"""
The verdict on a run: facts in, checks, status and exit code out. Pure; no file, no clock.

A run is green only when it completed, every machine answered, all data are there and every check
holds: what could not be measured counts as not held.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeGuard

from cosmos_cli.errors import FAILED_RUNS, ExitCode
from cosmos_cli.ui.plural import counted
from madns_runtime.conditions.reports import BROKEN
from madns_runtime.plain_values import first_few, mapping_at

TICK_CHECKS = "deadline."
"""Beginning of the names of the checks that late and missed ticks break."""
UNJUDGED_IN_LOCKSTEP = (
    "time.rtf, deadline.miss_ratio, deadline.overrun_ratio: not judged: in lockstep time waits"
)
TICKS_OF_A_RATE = 2
"""A real-time factor needs so many ticks at least."""
OF_SUMMARIES = "summary."
"""Begins the names of checks that the framework adds to the summary of either half."""
SAME_NAMES_TOLD = 5
WAKE_UP_LATE_S = 0.02
"""A single wake-up may be late by this much on an idle machine; lateness has checks of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """One line of the verdict; got is None when it could not be measured."""

    name: str
    limit: float
    got: float | None
    passed: bool
    worst: str | None = None
    """Source of the worst value, where there are many: an agent, the host, a stream. In the framework's checks `got` is the
    value of all of them together, in others that of this source."""
    agent: str | None = None
    """Agent of this value, or host; an expectation's alone."""
    t_s: float | None = None
    """Simulated time of this value, s."""
    unit: str | None = None
    """Unit of limit and value; None for the framework's own checks and a simulation's."""
    expected: str = ""
    """Words for what is expected; empty for others than expectations."""
    agents_broken: int = 0
    """Agents that break it."""

    def to_mapping(self) -> dict[str, Any]:
        """Return the check as run.json holds it."""
        return {
            "name": self.name,
            "limit": self.limit,
            "got": self.got,
            "passed": self.passed,
            "worst": self.worst,
            **(self._of_expectation() if self.expected else {}),
        }

    def _of_expectation(self) -> dict[str, Any]:
        return {
            "agent": self.agent,
            "t_s": self.t_s,
            "unit": self.unit,
            "expected": self.expected,
            "agents_broken": self.agents_broken,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckLimits:
    """Limits of the scenario."""

    miss_ratio_max: float = 1e-3
    rtf_tolerance: float = 1e-3
    not_finite_max: int = 0
    duration_s: float | None = None
    """Simulated time of the run; None if it is not known."""

    @property
    def rtf_error_max(self) -> float:
        """Largest deviation of the real-time factor: in a short run, one late wake-up must not decide it."""
        if not self.duration_s:
            return self.rtf_tolerance
        return max(self.rtf_tolerance, WAKE_UP_LATE_S / self.duration_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """All that a verdict depends on."""

    host_status: str | None
    """The host's own status; None when it ended without a word."""
    who: str | None = None
    reason: str | None = None
    host_lost: str | None = None
    """Fate of the machine that ran the host, if it was lost."""
    interrupted: bool = False
    lost_agents: tuple[str, ...] = ()
    lost_because: Mapping[str, str | None] = field(default_factory=dict)
    """Why an agent was lost, by its name."""
    machine_problems: tuple[str, ...] = ()
    """One line per machine that could not be reached or failed, each starting with its name."""
    is_ended_by_machine: bool = False
    """Whether the run did not complete because a machine was lost: the host's, or that of the agents it names."""
    problems: tuple[str, ...] = ()
    """Further problems, such as a process that had to be killed."""
    missing: tuple[str, ...] = ()
    """One line per source whose data are missing, cut or dropped, each starting with its name."""
    miss_ratio: float | None = None
    overrun_ratio: float | None = None
    rtf: float | None = None
    no_rate: str = ""
    """Why the run has no real-time factor; empty where it has one, or should."""
    is_lockstep: bool = False
    """Whether simulated time waited for everybody: nothing can be late then, whatever the clock shows."""
    reliable_lost: int | None = None
    sync_lost: int | None = None
    sync_deadlines_broken: int | None = None
    records_dropped: int = 0
    records_truncated: int = 0
    records_not_finite: int = 0
    """Values of all records that were NaN or infinite."""
    worst: Mapping[str, str] = field(default_factory=dict)
    """Source of the worst value, by name of the check."""
    late_hint: str = ""
    """The dominant cause of missed and late ticks, with its cure; empty if none was."""
    plugin_checks: tuple[CheckResult, ...] = ()
    expectations: tuple[CheckResult, ...] = ()
    """Results of the scenario's expectations that were judged."""
    remarks: tuple[str, ...] = ()
    """Remarks that decide nothing, such as on processors that were refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Result of the judgement of a run."""

    status: str
    exit_code: ExitCode
    text: str
    """One line for people: who and why."""
    who: str | None
    reason: str | None
    checks: tuple[CheckResult, ...]
    remarks: tuple[str, ...] = ()
    """Remarks on checks that were not judged, and why; on refusals to agents."""

    @property
    def broken(self) -> tuple[CheckResult, ...]:
        """The checks that do not hold."""
        return tuple(check for check in self.checks if not check.passed)


def judge(facts: RunFacts, limits: CheckLimits) -> Verdict:
    """
    Judge a run; its exit code is 0 only where nothing is wrong.

    Of several faults the first decides: interrupted 130, ended by a lost machine 3, failed 1, a machine
    failed 3, data incomplete 5, a check broken 4, not clean 3.
    """
    checks = run_checks(facts, limits)
    status = run_status(facts)
    who, reason = facts.who, facts.reason
    if facts.host_status is None:
        if status == "interrupted":
            who, reason = who or "operator", reason or "ended at once, without waiting for the host"
        else:
            fate = facts.host_lost or _why_no_result(facts.problems)
            who, reason = who or "host", reason or fate
    code, text = _conclude(facts, status, checks, _blame(who, reason))
    return Verdict(
        status=status,
        exit_code=code,
        text=text,
        who=who,
        reason=reason,
        checks=tuple(checks),
        remarks=(*_unjudged(facts), *_same_names(facts, checks), *facts.remarks),
    )


def _unjudged(facts: RunFacts) -> tuple[str, ...]:
    if facts.is_lockstep:
        return (UNJUDGED_IN_LOCKSTEP,)
    return () if _is_rate_judged(facts) else (f"time.rtf: not judged: {facts.no_rate}",)


def _same_names(facts: RunFacts, checks: Sequence[CheckResult]) -> tuple[str, ...]:
    """Return a remark if a half's check has a name that another check has, too: whoever asks by the name finds both."""
    counts = Counter(check.name for check in checks)
    own = dict.fromkeys(check.name for check in facts.plugin_checks)
    names = [name for name in own if counts[name] > 1 and not name.startswith(OF_SUMMARIES)]
    if not names:
        return ()
    return (
        f"checks: more than one is called {first_few(names, SAME_NAMES_TOLD)}: nobody can tell them apart by it; those"
        " that finish() returns need names that no expectation, no check of the framework and not the other half has",
    )


def _is_rate_judged(facts: RunFacts) -> bool:
    return not facts.no_rate or facts.rtf is not None


def why_no_rate(result: Mapping[str, Any], ticks_due: int | None) -> str:
    """
    Return why a run has no real-time factor, which agents tell at its end; empty if it is to have one.

    Args:
        result: The host's.
        ticks_due: Of each agent; None if that is not known.
    """
    if ticks_due is not None and ticks_due < TICKS_OF_A_RATE:
        return "a single tick has no rate"
    agents, lost = mapping_at(result, "agents"), result.get("lost_on_purpose")
    on_purpose = frozenset(map(str, lost)) if isinstance(lost, list) else frozenset()
    if not agents or not on_purpose.issuperset(agents) or result.get("lost"):
        return ""
    if all(mapping_at(agents, name).get("state") == "lost" for name in agents):
        return "all agents were away on purpose at the end"
    if all(_ticks_run(mapping_at(agents, name)) < TICKS_OF_A_RATE for name in agents):
        return "all agents were ended on purpose, and none was back for two ticks"
    return ""


def _ticks_run(agent: Mapping[str, Any]) -> int:
    """Return how many ticks an agent's last start has run, as it told at its end; 0 of one that told none."""
    count = mapping_at(agent, "ticks").get("run")
    return count if isinstance(count, int) else 0


def run_status(facts: RunFacts) -> str:
    """Return complete, failed, aborted, interrupted, or broken: ended by an expectation."""
    if facts.interrupted or facts.host_status == "interrupted":
        return "interrupted"
    if facts.host_status in ("complete", "failed", "aborted", BROKEN):
        return facts.host_status
    return "failed"


def run_checks(facts: RunFacts, limits: CheckLimits) -> list[CheckResult]:
    """Return every check of the framework, then those of the simulation."""
    checks = [
        at_most("agents.lost", 0, len(facts.lost_agents)),
        *([] if facts.is_lockstep else _real_time_checks(facts, limits)),
        at_most("messages.reliable.lost", 0, facts.reliable_lost),
        at_most("messages.sync.lost", 0, facts.sync_lost),
        at_most("messages.sync.deadlines_broken", 0, facts.sync_deadlines_broken),
        at_most("records.dropped", 0, facts.records_dropped),
        at_most("records.truncated", 0, facts.records_truncated),
        at_most("records.not_finite", limits.not_finite_max, facts.records_not_finite),
    ]
    named = [replace(check, worst=facts.worst.get(check.name)) for check in checks]
    return named + list(facts.plugin_checks) + list(facts.expectations)


def _real_time_checks(facts: RunFacts, limits: CheckLimits) -> list[CheckResult]:
    rtf_error = None if facts.rtf is None else abs(facts.rtf - 1.0)
    return [
        at_most("deadline.miss_ratio", limits.miss_ratio_max, facts.miss_ratio),
        at_most("deadline.overrun_ratio", limits.miss_ratio_max, facts.overrun_ratio),
        *([at_most("time.rtf", limits.rtf_error_max, rtf_error)] if _is_rate_judged(facts) else []),
    ]


def at_most(name: str, limit: float, got: float | None) -> CheckResult:
    """Return the check that *got* was measured and is not above *limit*."""
    # The comparison is written so that a NaN does not pass.
    return CheckResult(name=name, limit=limit, got=got, passed=got is not None and got <= limit)


def is_number(value: object) -> TypeGuard[float]:
    """Tell whether a value from a file is a finite number; JSON knows no other, msgpack does."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _blame(who: str | None, reason: str | None) -> str:
    if who and reason:
        return f"{who}: {first_line(reason)}"
    return who or first_line(reason or "") or "no reason was given"


def first_line(text: str) -> str:
    """Return the first line of a text that may have several: a verdict is one line, all of it is in the log."""
    first, *rest = text.strip().splitlines() or [""]
    return f"{first.rstrip()} ..." if rest else first


def _why_no_result(problems: Sequence[str]) -> str:
    """Return what the operator saw of the host, as in: host (pid 7) was killed by SIGKILL; host cannot be started."""
    for problem in problems:
        name, _, what = problem.partition(") ")
        if name.startswith("host (pid ") and what:
            return what
        if problem.startswith("host cannot "):
            return problem.removeprefix("host ")
    return "it ended without a result; was it killed?"


def _conclude(
    facts: RunFacts, status: str, checks: Sequence[CheckResult], blame: str
) -> tuple[ExitCode, str]:
    if status == "interrupted":
        if facts.host_status in ("failed", "aborted"):  # it was ending already, and had a cause
            return ExitCode.INTERRUPTED, f"INTERRUPTED by the operator, after {blame}"
        if facts.who not in (None, "operator"):
            # As by `cosmos down`, when there was no operator to ask.
            return ExitCode.INTERRUPTED, f"INTERRUPTED: {blame}"
        return ExitCode.INTERRUPTED, f"INTERRUPTED by {facts.who or 'the operator'}"
    if status not in ("complete", BROKEN):
        code = ExitCode.MACHINES if facts.is_ended_by_machine else ExitCode.RUN_FAILED
        return code, f"{status.upper()}: {blame}"
    if facts.machine_problems:
        return ExitCode.MACHINES, f"MACHINES FAILED: {_listed(facts.machine_problems)}"
    if facts.missing:
        return ExitCode.DATA_INCOMPLETE, f"DATA INCOMPLETE: {_listed(facts.missing)}"
    broken = [check for check in checks if not check.passed]
    if status == BROKEN:
        # What a run that ended early could not measure is told in its place, and is not the cause.
        told = [_told(check) for check in broken if check.expected]
        return ExitCode.BUDGET_BROKEN, f"CHECK BROKEN: {_listed([blame, *told])}"
    if broken:
        text = f"CHECK BROKEN: {_listed([_told(c) for c in broken])}"
        if facts.lost_agents:
            text += f"; lost: {_listed([_lost(facts, name) for name in facts.lost_agents])}"
        is_of_ticks = any(check.name.startswith(TICK_CHECKS) for check in broken)
        hint = (
            f"; ticks late or missed: {facts.late_hint}" if is_of_ticks and facts.late_hint else ""
        )
        return ExitCode.BUDGET_BROKEN, text + hint
    if facts.problems:
        return ExitCode.MACHINES, f"NOT CLEAN: {_listed(facts.problems)}"
    return ExitCode.OK, f"PASSED: {_all_hold(len(checks))}"


def _lost(facts: RunFacts, agent: str) -> str:
    return _blame(agent, facts.lost_because.get(agent))


def _all_hold(count: int) -> str:
    return f"{counted(count, 'check')} hold{'s' if count == 1 else ''}"


def conclusion_of_expectations(
    results: Sequence[CheckResult], missing: Sequence[str], document: Mapping[str, Any]
) -> tuple[ExitCode, str]:
    """
    Return exit code and verdict of a finished run that is judged by expectations: no run that failed passes by them.

    Args:
        results: Of those that were judged.
        missing: Data that are missing, one line each.
        document: run.json, whose `exit_code` and `verdict` tell how the run itself ended.
    """
    code, text = ExitCode.OK, _all_hold(len(results))
    broken = [result for result in results if not result.passed]
    if missing:
        code, text = ExitCode.DATA_INCOMPLETE, f"DATA INCOMPLETE: {_listed(missing)}"
    elif broken:
        told = _listed([_told(each) for each in broken])
        code, text = ExitCode.BUDGET_BROKEN, f"CHECK BROKEN: {told}"
    if document.get("exit_code") in FAILED_RUNS:
        how = first_line(str(document.get("verdict") or "the run failed"))
        return ExitCode(document["exit_code"]), f"{how}; judged by what it recorded: {text}"
    return code, text if code else f"PASSED: {text}"


def _told(check: CheckResult) -> str:
    got = "not measured" if check.got is None else f"{check.got:g}"
    if got == f"{check.limit:g}" and check.got != check.limit:  # broken by its later digits
        got = f"{check.got}"
    if check.expected:
        whose = f" of {first_line(check.worst)}" if check.worst else ""
        unit = f" {check.unit}" if check.unit and check.got is not None else ""
        when = "" if check.t_s is None else f" at {check.t_s:.10g} s"
        more = f" and {check.agents_broken - 1} more" if check.agents_broken > 1 else ""
        return (
            f"{check.name} {got}{unit}{whose}{more}{when} (expected {first_line(check.expected)})"
        )
    # A sum or ratio over all is nobody's own: whose share of it is the largest stands apart.
    worst = f", worst: {first_line(check.worst)}" if check.worst else ""
    return f"{check.name} {got} (limit {check.limit:g}{worst})"


def _listed(items: Sequence[str], shown_max: int = 3) -> str:
    return first_few([first_line(item) for item in items], shown_max, "; ")
