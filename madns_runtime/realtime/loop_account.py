"""What the loop of an agent process did with its time, so that each late tick has a cause that was measured."""

from __future__ import annotations

import gc
import math
from collections import deque
from collections.abc import Mapping
from time import monotonic, thread_time
from typing import Any, NamedTuple

from madns_runtime.health.kernel_times import stolen_s, waited_s
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.writer_thread import WriterThread
from madns_runtime.timing.late_causes import Cause, name_cause, overlap_s

SPANS_MIN = 256
SPANS_PER_AGENT = 8
LOOK_INTERVAL_S = 0.02
"""The kernel is not asked more often, however many ticks are late."""
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
        self._mark = (monotonic(), thread_time(), reactor.slept_s)
        self._kept_off_s = 0.0
        self._kernel_s = stolen_s(), waited_s()
        self._newly_stolen_s = self._newly_waited_s = 0.0
        self._look_due_s = -math.inf
        gc.callbacks.append(self._collecting)

    def close(self) -> None:
        """Watch the collector no more."""
        gc.callbacks.remove(self._collecting)

    def begin_ticks(self, now_s: float) -> None:
        """Note for how long the loop was neither asleep nor on a processor since ticks were begun last."""
        before_s, computed_before_s, slept_before_s = self._mark
        computed_s, slept_s = thread_time(), self._reactor.slept_s
        self._mark = (now_s, computed_s, slept_s)
        self._kept_off_s = (
            now_s - before_s - (computed_s - computed_before_s) - (slept_s - slept_before_s)
        )

    def look(self) -> None:
        """Read the kernel's counts, so that a late tick is charged with what it met alone: called now and then."""
        now_s = monotonic()
        if now_s < self._look_due_s:
            return
        self._look_due_s = now_s + LOOK_INTERVAL_S
        before = self._kernel_s
        self._kernel_s = stolen_s(), waited_s()
        stolen_before_s, waited_before_s = before
        stolen_now_s, waited_now_s = self._kernel_s
        self._newly_stolen_s = stolen_now_s - stolen_before_s
        self._newly_waited_s = (
            waited_now_s - waited_before_s if math.isfinite(waited_now_s) else math.inf
        )

    def explain(self, late: LateTick) -> Cause:
        """Return the cause of a late tick, right after its step."""
        began_s = monotonic()
        window = late.due_s, late.began_s
        filled_s = dict.fromkeys(Cause, 0.0)
        filled_s[Cause.START] = overlap_s(late.due_s, late.started_s, window)
        for cause, agent, begin_s, end_s in reversed(self._spans):
            if end_s < late.due_s:
                break  # they end one after the other
            what = cause
            if cause is Cause.STEP and agent != late.agent:
                what = Cause.OTHER_AGENT
            elif cause is Cause.STEP and end_s - begin_s < late.period_s:
                what = Cause.TICK_BEFORE
            filled_s[what] += overlap_s(begin_s, end_s, window)
        self.look()
        overslept_s = overlap_s(*self._reactor.last_sleep, window)
        kept_s = max(overslept_s, min(self._kept_off_s, self._newly_waited_s))
        filled_s[Cause.WAKE_UP] = kept_s
        filled_s[Cause.STOLEN] = min(kept_s, self._newly_stolen_s)
        filled_s[Cause.RECORDING] = min(overslept_s, self._writing_s(window))
        cause = name_cause(late.began_s - late.due_s, filled_s)
        self.add(Span(Cause.HOUSEKEEPING, late.agent, began_s, monotonic()))
        return cause

    def _writing_s(self, window: tuple[float, float]) -> float:
        """Return for how long the writer of records computed, of the pass that fell into a window, s."""
        began_s, ended_s, computed_s = self._writer.newest_pass
        return min(computed_s, overlap_s(began_s, ended_s, window))

    def _collecting(self, phase: str, info: Mapping[str, Any]) -> None:
        now_s = monotonic()
        if phase == "start":
            self._collection_began_s = now_s
        elif not math.isnan(self._collection_began_s):
            self.add(Span(Cause.GARBAGE, NOBODY, self._collection_began_s, now_s))
