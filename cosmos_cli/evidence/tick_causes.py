"""
Why ticks were missed or late: totals of a run by cause, the dominant cause, and what can be done about it.

An agent's own summary counts them; where it has none, because it died or was restarted, its records do. A tick that
is late is one that began later than `deadline.lateness_ms` (not given: `deadline.overrun_ms`). Missed ticks and the
late one that follows them have one cause together and count as the missed ones, so that the causes of an agent
add up to its missed ticks and those that were late with none missed just before. Pure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from cosmos_cli.evidence.datagrams import whole_count
from cosmos_cli.ui.plural import counted
from madns_runtime.analysis.sampling import as_array
from madns_runtime.analysis.tables import RecordedTable
from madns_runtime.timing.late_causes import CAUSES, Cause

ABSENT: Final = "absent"
"""The one cause that no agent can tell of itself."""
TOLD_CAUSES: Final = (*(cause.value for cause in CAUSES), ABSENT)


@dataclass(frozen=True, slots=True)
class CauseWords:
    """One cause as people read it."""

    meaning: str
    cure: str


WORDS: Final[Mapping[str, CauseWords]] = {
    Cause.CLOCK: CauseWords(
        "what the agent takes for the host's time leapt ahead: its clock was put wrong, or its estimate was far off",
        "nothing where a timeline's `step_clock` did it; else see the stream `clock`, and what sets clocks there",
    ),
    Cause.START: CauseWords(
        "the order to start came after the first deadlines, or the loop was still setting up",
        "raise timeouts.start_lead_s",
    ),
    Cause.STOLEN: CauseWords(
        "the hypervisor gave the processor to other guests",
        "run on a machine, or a guest, with processors of its own; `cosmos doctor` (`steal`) tells the share",
    ),
    Cause.GARBAGE: CauseWords(
        "Python's garbage collector was at work in the agent's process",
        "let the plug-in make fewer objects that refer to others, or collect where it has time: gc.disable() in"
        " setup, gc.collect(0) in step",
    ),
    Cause.RECORDING: CauseWords(
        "the thread that writes the records had the interpreter",
        "record fewer or shorter records, lower recording.verbosity, or put fewer agents into a process"
        " (agents.per_process)",
    ),
    Cause.WAKE_UP: CauseWords(
        "the kernel woke the loop late, or gave its processor to another program",
        "permit SCHED_FIFO where it is refused (`cosmos doctor` tells; scheduling.policy), end what else runs there,"
        " give a machine fewer agents, or let more of them share a process (agents.per_process)",
    ),
    Cause.STEP: CauseWords(
        "the agent's own step before took longer than its period",
        "nothing where a timeline's `slow` did it; else make the plug-in's step quicker than 1 / agents.tick_hz, or"
        " lower agents.tick_hz",
    ),
    Cause.TICK_BEFORE: CauseWords(
        "the agent's tick before was itself late and still under way",
        "see to the cause of the late ticks before these; a step that takes most of its period cannot catch up",
    ),
    Cause.OTHER_AGENT: CauseWords(
        "ticks of other agents in the same process were under way",
        "lower agents.per_process, or make the steps quicker: those of all agents of a process share one processor",
    ),
    Cause.RECEIVING: CauseWords(
        "messages from the host were taken in, the plug-in's receive among them",
        "keep receive short and compute in step, or let the host send less at once",
    ),
    Cause.HOUSEKEEPING: CauseWords(
        "the session's own work: pings, resends, the account of resources and of late ticks",
        "put fewer agents into a process (agents.per_process); health.period_s spaces the account of resources",
    ),
    Cause.UNEXPLAINED: CauseWords(
        "nothing that is measured filled the time",
        "please report this, with the run's package",
    ),
    ABSENT: CauseWords(
        "the agent did not run: it was lost, started late, or was not back yet",
        "`cosmos logs` tells why; agents.restarts_max lets it come back",
    ),
}
"""Meaning and cure of every cause. docs/real-time.md holds the same words."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentCauses:
    """Ticks of one agent by cause, and how many of them were missed."""

    causes: Mapping[str, int]
    missed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CauseTotals:
    """Missed and late ticks of a run by cause; causes without any are left out."""

    missed: int
    late: int
    """Ticks that began late, with none missed just before."""
    causes: Mapping[str, int]
    agents: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """The same by agent; agents without any are left out."""

    @property
    def dominant(self) -> tuple[str, float] | None:
        """The cause of most ticks and its share of all, 0 to 1; None where no tick was missed or late."""
        total = sum(self.causes.values())
        if not total:
            return None
        cause = max(self.causes, key=lambda name: self.causes[name])
        return cause, self.causes[cause] / total

    @property
    def hint(self) -> str:
        """The dominant cause, its share and its cure, as the verdict tells them; empty without one."""
        if self.dominant is None:
            return ""
        cause, share = self.dominant
        return f"{share:.0%} by {cause}: {WORDS[cause].cure}"

    def remarks(self, limit_s: float | None) -> tuple[str, ...]:
        """Return the remark on them, none if there were none; *limit_s* is from when on a tick is late, s."""
        if self.dominant is None:
            return ()
        cause, share = self.dominant
        by_more = "" if limit_s is None else f" by more than {limit_s * 1e3:g} ms"
        return (
            f"{counted(self.missed, 'tick')} missed, {self.late} late{by_more}: {share:.0%} by {cause}"
            f" ({WORDS[cause].meaning}); {WORDS[cause].cure}",
        )


def recorded_causes(table: RecordedTable | None) -> dict[str, AgentCauses]:
    """Return by agent what the stream late_ticks tells; all incarnations together."""
    if table is None or not table.has("missed", "cause"):
        return {}
    found: dict[str, AgentCauses] = {}
    for name, columns in table.each(("missed", "cause")):
        missed = np.nan_to_num(as_array(columns["missed"])).astype(np.int64)
        ticks = np.maximum(missed, 1)
        counts: Counter[str] = Counter()
        for cause, count in zip(columns["cause"].tolist(), ticks.tolist(), strict=True):
            counts[_known(cause)] += count
        found[name] = AgentCauses(causes=counts, missed=int(missed.sum()))
    return found


def told_causes(ticks: Mapping[str, Any]) -> AgentCauses | None:
    """Return what an agent's own summary of its *ticks* tells; None if it tells nothing of causes."""
    told = ticks.get("causes")
    if not isinstance(told, Mapping):
        return None
    counts: Counter[str] = Counter()
    for cause, count in told.items():
        counts[_known(cause)] += max(whole_count(count), 0)
    return AgentCauses(causes=counts, missed=max(whole_count(ticks.get("missed")), 0))


def cause_totals(agents: Mapping[str, AgentCauses], missed: Mapping[str, int]) -> CauseTotals:
    """
    Return the causes of a run.

    Args:
        agents: What is told of each agent; one that is not in it told nothing.
        missed: Ticks of each agent that were due and did not run. Those that no agent told of are ABSENT.
    """
    by_agent: dict[str, dict[str, int]] = {}
    late = 0
    for name, missed_here in missed.items():
        told = agents.get(name)
        counts = Counter(told.causes if told else {})
        known = min(told.missed if told else 0, missed_here)
        late += max(sum(counts.values()) - known, 0)
        counts[ABSENT] += missed_here - known
        by_agent[name] = _in_order(counts)
    total: Counter[str] = Counter()
    for counts_here in by_agent.values():
        total.update(counts_here)
    return CauseTotals(
        missed=sum(missed.values()),
        late=late,
        causes=_in_order(total),
        agents={name: counts for name, counts in by_agent.items() if counts},
    )


def _known(cause: object) -> str:
    """Return a cause's name; another version may know one that this does not."""
    return cause if isinstance(cause, str) and cause in WORDS else Cause.UNEXPLAINED.value


def _in_order(counts: Mapping[str, int]) -> dict[str, int]:
    return {cause: counts[cause] for cause in _with_any(counts)}


def _with_any(counts: Mapping[str, int]) -> Iterable[str]:
    return (cause for cause in TOLD_CAUSES if counts.get(cause))
