"""Outcomes of an expectation for each agent, and of these the one that is told. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cosmos_cli.evidence.expectations.accumulators import Occurrences
from cosmos_cli.evidence.verdict import CheckResult
from cosmos_cli.models.check_rules import OF_NUMBERS
from cosmos_cli.models.expectation import Expectation, owner_of
from madns_runtime.conditions.condition import HOST
from madns_runtime.written_times import later_s


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectationOutcome:
    """Outcome of an expectation at one agent."""

    got: float | None
    """None where there is none: it never came, or is not finite."""
    t_s: float | None
    """Simulated time of it, s."""
    passed: bool
    place: int | None = None
    """Place of its record, where others may come after it."""
    why: str = ""
    """Why there is none, if that is known."""
    latest_s: float | None = None
    """Until when an event had to come, s, of this agent; None for any time of the run."""


def why_not_flown(expectation: Expectation, duration_s: float) -> str:
    """Return why nothing can be said of an expectation whose times lie behind the end of a run; empty if they do not."""
    is_behind = expectation.from_s is not None and expectation.from_s >= duration_s
    return f"the run ended at {duration_s:g} s, before its from_s" if is_behind else ""


def remark_on_end(expectation: Expectation, duration_s: float) -> str:
    """Return a remark on one that no record answers, too, and whose times a run had in part; empty for all others."""
    is_answered = expectation.must == "not_occur" or expectation.statistic in OF_NUMBERS
    end_s = expectation.to_s
    if not is_answered or end_s is None or end_s <= duration_s:
        return ""
    return f"{expectation.name}: judged until {duration_s:g} s, when the run ended, and not until {end_s:g} s"


def outcome_of_event(
    expectation: Expectation,
    agent: str,
    found: Occurrences,
    after: Mapping[str, ExpectationOutcome] | None,
    *,
    is_same_stream: bool,
) -> ExpectationOutcome:
    """
    Return whether an event occurred, or did not, as it must.

    Args:
        expectation: What must be.
        agent: Whose event.
        found: Times of it, from `from_s` on.
        after: By agent: the times that it is to come after; None for none.
        is_same_stream: Whether these are of the same stream: then of one time the later record comes after.
    """
    must_not = expectation.must == "not_occur"
    begin_s, latest_s = -math.inf, expectation.to_s
    behind = -1
    if after is not None:
        other = after.get(agent) or _of_owner(after, agent) or after.get(HOST) or _only(after)
        if other is None or other.t_s is None:
            got = 0.0 if must_not else None
            return ExpectationOutcome(got=got, t_s=None, passed=must_not, latest_s=latest_s)
        begin_s = other.t_s
        if is_same_stream and agent in after and other.place is not None:
            behind = other.place
        if expectation.within_s is not None:
            end_s = later_s(begin_s, expectation.within_s)
            latest_s = end_s if latest_s is None else min(latest_s, end_s)
    later = [each for each in found.found if each > (begin_s, behind)]
    wrong = [t_s for t_s, _ in later if latest_s is None or t_s <= latest_s]
    if not wrong and found.is_open_at(latest_s):
        why = f"it occurs {found.count} times, and the first {len(found.found)} are looked at"
        return ExpectationOutcome(got=None, t_s=None, passed=False, why=why, latest_s=latest_s)
    if must_not:
        return ExpectationOutcome(got=len(wrong), t_s=min(wrong, default=None), passed=not wrong)
    if not later:
        return ExpectationOutcome(got=None, t_s=None, passed=False, latest_s=latest_s)
    first_s, place = min(later)
    is_in_time = latest_s is None or first_s <= latest_s
    return ExpectationOutcome(
        got=first_s, t_s=first_s, passed=is_in_time, place=place, latest_s=latest_s
    )


def _of_owner(outcomes: Mapping[str, ExpectationOutcome], name: str) -> ExpectationOutcome | None:
    """Return what an agent came to, or its one device, for a device or for an agent."""
    own = [each for other, each in outcomes.items() if owner_of(other) == owner_of(name)]
    return own[0] if len(own) == 1 else None


def _only(outcomes: Mapping[str, ExpectationOutcome]) -> ExpectationOutcome | None:
    """Return what the one agent came to that there is: all others may come after it."""
    return next(iter(outcomes.values())) if len(outcomes) == 1 else None


def worst_result(
    expectation: Expectation,
    outcomes: Mapping[str, ExpectationOutcome],
    unit: str,
    *,
    duration_s: float,
) -> CheckResult:
    """Return the result of an expectation: that of the agent that breaks it most, or is nearest to it."""
    agent = max(outcomes, key=lambda name: _badness(expectation, outcomes[name]))
    worst = outcomes[agent]
    broken = sum(not each.passed for each in outcomes.values())
    return CheckResult(
        name=expectation.name,
        limit=_nearest_limit(expectation, worst, duration_s),
        got=worst.got,
        passed=worst.passed,
        worst=agent,
        agent=agent,
        t_s=worst.t_s,
        unit=unit,
        expected=expectation.words + (f" ({worst.why})" if worst.why else ""),
        agents_broken=broken,
    )


def _badness(expectation: Expectation, outcome: ExpectationOutcome) -> tuple[bool, float]:
    if outcome.got is None:
        return not outcome.passed, math.inf
    if expectation.event:
        if expectation.must == "occur":
            return not outcome.passed, outcome.got - (outcome.latest_s or 0.0)
        sign = -1.0 if outcome.passed else 1.0
        return not outcome.passed, sign * outcome.got
    bounds = expectation.bounds
    if bounds.text is not None:
        return not outcome.passed, outcome.got
    low = -math.inf if bounds.low is None else bounds.low - outcome.got
    high = -math.inf if bounds.high is None else outcome.got - bounds.high
    return not outcome.passed, max(low, high)


def _nearest_limit(
    expectation: Expectation, outcome: ExpectationOutcome, duration_s: float
) -> float:
    """
    Return the bound that is broken or nearest; of an event its latest time, or no occurrence, of a text none unlike it.

    An event without a latest time may also come in the last moments of a run, past the end of its ticks.
    """
    bounds, got = expectation.bounds, outcome.got
    if expectation.event and expectation.must == "occur":
        at_end_s = duration_s if got is None else max(duration_s, got)
        return at_end_s if outcome.latest_s is None else outcome.latest_s
    if expectation.event or bounds.text is not None:
        return 0.0
    if bounds.low is None or bounds.high is None or got is None:
        return next((each for each in (bounds.high, bounds.low) if each is not None), 0.0)
    return bounds.low if got < (bounds.low + bounds.high) / 2 else bounds.high
