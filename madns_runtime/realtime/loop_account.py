"""Account of how the loop of an agent process spent its time, so that each late tick has a cause that was measured."""

from __future__ import annotations

import gc
import math
from collections import deque
from collections.abc import Mapping
from itertools import islice
from time import monotonic, thread_time
from typing import Any, NamedTuple

from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.writer_thread import WriterThread
from madns_runtime.timing.kernel_times import KernelCount, KernelFile
from madns_runtime.timing.late_causes import Cause, name_cause, overlap_s

SPANS_MIN = 256
SPANS_PER_AGENT = 8
STOLEN_INTERVAL_S = 0.02
"""The kernel counts what was stolen in steps of 10 ms, and is not asked more often, however many ticks are late."""
WAITED_INTERVAL_S = 0.001
"""Time that the loop waited for a processor is counted in nanoseconds and read more quickly."""
WAITED_EVERY_S = 0.02
STOLEN_EVERY_S = 0.1
"""How often they are read at least, where something is ever stolen: what they grew by long before is no late tick's."""
MARKS_KEPT = 64
"""Begins of ticks before a late one: other packs' come between its deadline and it, once what held all of them up is over."""
TOGETHER_S = 1e-6
"""Deadlines of one pack differ by roundings."""
NOBODY = -1
"""The agent of a span that is of none in particular."""


class Span(NamedTuple):
    """Something that the loop did, in its own time, s."""

    cause: Cause
    agent: int
    begin_s: float
    end_s: float


class LateTick(NamedTuple):
    """A tick that began late."""

    agent: int
    due_s: float
    """Deadline, of the first tick missed before it or else its own, s of the local clock."""
    began_s: float
    started_s: float
    """When the agent began to run, s of the local clock."""
    period_s: float
    leapt_s: float = 0.0
    """By how much simulated time has leapt ahead of the local clock since the agent's tick before, s."""


class _Steps(NamedTuple):
    """An agent's steps within a window."""

    within_s: float
    """Of all together, what lies within it, s."""
    longest_s: float
    """The longest of them, whole, s."""

    def cause_within(self, period_s: float) -> Cause:
        """Return what an agent's own steps are as a cause: too long for its period, or late themselves."""
        return Cause.TICK_BEFORE if self.longest_s < period_s else Cause.STEP


NO_STEPS = _Steps(0.0, 0.0)


class _Looked(NamedTuple):
    """Causes at work between a deadline, of one agent or of some that are due together, and a begin."""

    due_s: float
    began_s: float
    filled_s: Mapping[Cause, float]
    """How much of the window each cause filled, but for steps, s."""
    steps: Mapping[int, _Steps]
    """Steps by agent."""
    together_s: float
    """How much of the window all of them filled: a collection within a step counts once, s."""

    def steps_of(self, agent: int) -> tuple[_Steps, float]:
        """Return an agent's own steps, and for how long those of others took, s."""
        own = self.steps.get(agent, NO_STEPS)
        return own, sum(each.within_s for each in self.steps.values()) - own.within_s


class _Mark(NamedTuple):
    """Uses of the loop's time until a moment, s."""

    at_s: float
    computed_s: float
    slept_s: float

    @classmethod
    def now(cls, reactor: Reactor) -> _Mark:
        """Return it of this moment; the calling thread is the loop's."""
        return cls(monotonic(), thread_time(), reactor.slept_s)

    def kept_off_since_s(self, before: _Mark) -> float:
        """Return the time since *before* in which the loop neither slept nor computed, s."""
        passed_s = self.at_s - before.at_s
        busy_s = self.computed_s - before.computed_s + self.slept_s - before.slept_s
        return max(0.0, passed_s - busy_s)


class LoopAccount:
    """
    The newest spans of one loop's time.

    Args:
        reactor: The loop; tells when it slept.
        writer: The thread that writes the records.
        agents: How many agents share the loop.
    """

    def __init__(self, reactor: Reactor, writer: WriterThread, agents: int) -> None:
        self._reactor = reactor
        self._writer = writer
        self._spans: deque[Span] = deque(maxlen=max(SPANS_MIN, SPANS_PER_AGENT * agents))
        self.add = self._spans.append
        self._collection_began_s = math.nan
        self._marks = deque([_Mark.now(reactor)], maxlen=MARKS_KEPT)
        self._looked: _Looked | None = None
        """Causes that the newest late tick of those begun together has met."""
        self._files = KernelFile.of_stolen_time(), KernelFile.of_waiting()
        self._stolen = KernelCount(self._files[0], STOLEN_INTERVAL_S)
        self._waited = KernelCount(self._files[1], WAITED_INTERVAL_S)
        self._read_waited_at_s = self._read_stolen_at_s = -math.inf
        gc.callbacks.append(self._collecting)

    def close(self) -> None:
        """Watch the collector and the kernel's counts no more."""
        gc.callbacks.remove(self._collecting)
        for file in self._files:
            file.close()

    def begin_ticks(self, now_s: float) -> None:
        """Note how much of its time the loop has slept and computed until now, as ticks are begun."""
        if now_s >= self._read_waited_at_s:
            self._read_at(now_s)
        self._marks.append(_Mark(now_s, thread_time(), self._reactor.slept_s))
        self._looked = None

    def _read_at(self, now_s: float) -> None:
        """Read the kernel's counts as ticks are begun, so that a late tick is charged with what it met alone."""
        self._read_waited_at_s = now_s + WAITED_EVERY_S
        self._waited.read(now_s)
        if self._stolen.newest_s > 0.0 and now_s >= self._read_stolen_at_s:
            self._read_stolen_at_s = now_s + STOLEN_EVERY_S
            self._stolen.read(now_s)

    def look(self) -> None:
        """Read the kernel's counts: of a late tick, and now and then."""
        self._stolen.read()
        self._waited.read()

    def explain(self, late: LateTick) -> Cause:
        """
        Return the cause of a late tick, right after its step.

        Agents that tick together and were due together are late by the same: what the first of them met is
        looked at once, and of each other only what came since. Looking is work of the loop too, and done for
        each of them it would make the next ticks late.
        """
        looked = self._looked
        if looked is None or abs(looked.due_s - late.due_s) > TOGETHER_S:
            looked = self._looked = self._look_at(late)
        filled_s = dict(looked.filled_s)
        own, others = looked.steps_of(late.agent)
        filled_s[own.cause_within(late.period_s)] = own.within_s
        since_s = max(0.0, late.began_s - looked.began_s)
        filled_s[Cause.OTHER_AGENT] = others + since_s
        start_s = overlap_s(late.due_s, late.started_s, (late.due_s, late.began_s))
        filled_s[Cause.START] = start_s
        filled_s[Cause.CLOCK] = leapt_s = max(0.0, late.leapt_s)
        together_s = looked.together_s + since_s + start_s + leapt_s
        return name_cause(late.began_s - late.due_s, filled_s, together_s=together_s)

    def _look_at(self, late: LateTick) -> _Looked:
        """Return what was at work between a late tick's deadline and its begin."""
        looking_s = monotonic()
        window = late.due_s, late.began_s
        filled_s: dict[Cause, float] = {}
        steps: dict[int, _Steps] = {}
        timed_s, timed_from_s = 0.0, late.began_s
        # A copy: Python's collector may begin meanwhile, and its span is added then and there. tuple() would make an
        # object as it goes through the spans, at which the collector of Python 3.11 begins.
        for cause, agent, begin_s, end_s in reversed(self._spans.copy()):
            if end_s < late.due_s:
                break  # they end one after the other
            if begin_s >= late.began_s:
                continue  # its own step, which has just ended, and what came in it
            within_s = overlap_s(begin_s, end_s, window)
            timed_s += overlap_s(begin_s, min(end_s, timed_from_s), window)
            timed_from_s = min(timed_from_s, begin_s)
            if cause is Cause.STEP:
                before = steps.get(agent, NO_STEPS)
                steps[agent] = _Steps(
                    before.within_s + within_s, max(before.longest_s, end_s - begin_s)
                )
            else:
                filled_s[cause] = filled_s.get(cause, 0.0) + within_s
        overslept_s = sum(overlap_s(*sleep, window) for sleep in self._reactor.sleeps)
        awake_s = late.began_s - late.due_s - overslept_s
        mark = self._mark_before(late.due_s)
        kept_off_s = min(self._kept_off_s(mark, looking_s - late.began_s), awake_s)
        self.look()
        stolen_since_s = self._stolen.grown_since(mark.at_s)
        waited_since_s = self._waited.grown_since(mark.at_s)
        absent_s = overslept_s + kept_off_s
        filled_s[Cause.WAKE_UP] = overslept_s + min(kept_off_s, waited_since_s)
        recorded_s = min(absent_s, self._writer.computed_within_s(window))
        filled_s[Cause.RECORDING] = recorded_s
        # What was stolen may have been so from any processor and up to STOLEN_EVERY_S before the mark: it is charged
        # with no more than nothing else explains. The kernel counts no waiting of a thread while its processor is stolen.
        waited_s = waited_since_s if math.isfinite(waited_since_s) else 0.0
        filled_s[Cause.STOLEN] = min(stolen_since_s, max(0.0, absent_s - recorded_s - waited_s))
        kept_s = max(filled_s[each] for each in (Cause.WAKE_UP, Cause.RECORDING, Cause.STOLEN))
        self.add(Span(Cause.HOUSEKEEPING, NOBODY, looking_s, monotonic()))
        return _Looked(late.due_s, late.began_s, filled_s, steps, timed_s + kept_s)

    def _mark_before(self, due_s: float) -> _Mark:
        """Return the mark of the ticks begun last by a deadline, s, or the oldest there is; the newest is of late ones themselves."""
        earlier = islice(reversed(self._marks), 1, None)
        return next((mark for mark in earlier if mark.at_s <= due_s), self._marks[0])

    def _kept_off_s(self, before: _Mark, own_step_s: float) -> float:
        """
        Return for how long the loop was neither asleep nor on a processor before a step that has just ended, s.

        Counted since *before*. What the step itself may have met is left out.
        """
        now, begun = _Mark.now(self._reactor), self._marks[-1]
        return begun.kept_off_since_s(before) + max(0.0, now.kept_off_since_s(begun) - own_step_s)

    def _collecting(self, phase: str, info: Mapping[str, Any]) -> None:
        now_s = monotonic()
        if phase == "start":
            self._collection_began_s = now_s
        elif not math.isnan(self._collection_began_s):
            self.add(Span(Cause.GARBAGE, NOBODY, self._collection_began_s, now_s))
