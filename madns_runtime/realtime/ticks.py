"""The ticks of one agent: its step called when one is due, paced, timed and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.faults.step_faults import StepFaults
from madns_runtime.plugin.api import Tick
from madns_runtime.protocol.messages import AgentFault
from madns_runtime.realtime.agent_calls import AGENT, IDLE, METHOD, STEP, T_S, LoopSeat
from madns_runtime.realtime.agent_link import AgentPort
from madns_runtime.realtime.late_ticks import LateTicks
from madns_runtime.realtime.loop_account import Span
from madns_runtime.recording.recorder import Recorder
from madns_runtime.timing.late_causes import Cause
from madns_runtime.timing.rate import Pacer, RealTimeFactor

SLOWED_S_MAX = 1.0
"""The most that a fault makes a step longer, s: the loop has its process's other work to do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TickCalls:
    """Calls of an agent in its ticks, and when something comes between."""

    prepare: Callable[[float], bool] | None
    """Hands in what comes with the tick at a simulated time, s; False if the agent has ended over it. None: nothing ever does."""
    step: Callable[[Tick], None]
    end_if_forked: Callable[[], None]
    """Called when the step has returned: ends a process that it forked, before that does more of its parent's work."""
    failed: Callable[[BaseException], None]
    """Told what the step raised."""
    ended: Callable[[], None]
    """Told that no tick is left."""
    is_running: Callable[[], bool]
    report_if_due: Callable[[float], None]
    """Pings the host, and records what the process uses, where that is due by a local time, s."""


class PacedTicks:
    """
    The ticks of one agent.

    Args:
        seat: The agent, and where its calls are noted.
        config: The run.
        phase_s: Offset of its deadlines within the period, s.
        port: Knows simulated time.
        recorder: Where each tick is recorded.
        calls: What the agent does in them.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        seat: LoopSeat,
        config: RunConfig,
        phase_s: float,
        *,
        port: AgentPort,
        recorder: Recorder,
        calls: TickCalls,
    ) -> None:
        self.period_s = 1.0 / config.agents.tick_hz
        self.duration_s = config.time.duration_s
        """Simulated time of the run, s."""
        self.pacer = Pacer(
            tick_hz=config.agents.tick_hz,
            phase_s=phase_s,
            duration_s=config.time.duration_s,
            overrun_s=config.deadline.overrun_ms * 1e-3,
        )
        self.factor = RealTimeFactor()
        account = port.process.account
        self.late = LateTicks(seat.number, self.period_s, recorder=recorder, account=account)
        self._late_s = config.deadline.lateness_limit_s
        self._page, self._number = seat.calls.page, seat.number
        self._port = port
        self._add_span = account.add
        self._record = recorder.record
        self._calls = calls
        # Called every tick: without a layer between.
        self._prepare, self._step, self._is_running = calls.prepare, calls.step, calls.is_running
        self._end_if_forked = calls.end_if_forked
        self._faults = StepFaults()
        self.report_if_due = calls.report_if_due
        self._look = port.conditions.look if port.conditions.must_look else None
        self._ahead_s = 0.0
        """Simulated time minus the local clock, as the newest tick began, s."""

    def begin(self, now_s: float) -> None:
        """Take note that the agent runs from simulated time *now_s* on, s: what was over when it rejoined was never its own."""
        if now_s > 0 and self._port.has_rejoined:
            self.pacer.skip_to(now_s)
        self.late.started_s = local_s = monotonic()
        self._ahead_s = now_s - local_s
        if self.pacer.is_over:
            self._calls.ended()

    def end_at(self, t_s: float) -> None:
        """Let the run end at simulated time *t_s*, s, where that is before its present end."""
        if t_s < self.duration_s:
            self.duration_s = t_s
            self.pacer.end_by(t_s)
            if self.pacer.is_over and self._is_running():
                self._calls.ended()

    def over_s(self) -> float:
        """Return the later of the run's end and the last tick's deadline, which its phase may put behind the end, s."""
        return max(self.duration_s, self.pacer.deadline_of(self.pacer.tick_count - 1))

    def finish(self, now_s: float) -> None:
        """Close the account at simulated time *now_s*, s."""
        self.pacer.finish(now_s)
        local_s = monotonic()
        self.late.never_run(self.pacer, now_s, local_s, now_s - local_s - self._ahead_s)

    def hinder(self, order: AgentFault) -> StepFaults | None:
        """
        Begin or end a fault of the steps.

        Returns:
            Those in force: without any, steps cost what they did. None if one is to end that this start of the agent
            never had.
        """
        faults, calls = self._faults, self._calls
        if order.begins:
            faults.begin(order.number, order.word, order.value)
        elif not faults.end(order.number):
            return None
        self._step = self._hindered if faults.are_in_force else calls.step
        # What comes between agents is heard with a step, in the next that is taken.
        self._prepare = None if faults.is_hung else calls.prepare
        return faults

    def _hindered(self, tick: Tick) -> None:
        """Take a step that faults let be taken, as slowly as they say: the loop is held up by it."""
        faults = self._faults
        if faults.is_hung:
            faults.withheld += 1
            self._port.mailbox.begin(tick.t_s)  # what it sends meanwhile is of this tick
            return
        began_s = monotonic()
        self._calls.step(tick)
        sleep(min((monotonic() - began_s) * (faults.factor - 1.0), SLOWED_S_MAX))

    def next_deadline_s(self) -> float:
        """Return the simulated time at which the next tick is due, s; infinite while there is none."""
        deadline_s = self.pacer.next_deadline_s() if self._is_running() else None
        return math.inf if deadline_s is None else deadline_s

    def local_s(self, t_s: float) -> float:
        """Return when simulated time *t_s* is on this machine's monotonic clock, s."""
        return self._port.local_s(t_s)

    def tick(self) -> None:
        """Run the tick that is due, if one is."""
        if not self._is_running():
            return
        pacer, port = self.pacer, self._port
        local_s = monotonic()
        began_s = port.at(local_s)
        ahead_s, self._ahead_s = self._ahead_s, began_s - local_s
        timing = pacer.begin(began_s)
        if timing is None:
            self.late.never_run(pacer, began_s, local_s, self._ahead_s - ahead_s)
        else:
            index, t_s, deadline_s, lateness_s, missed = timing
            self.factor.add(t_s, began_s)
            page = self._page
            page[T_S] = t_s
            if self._prepare is not None and not self._prepare(t_s):
                return
            page[AGENT], page[METHOD] = self._number, STEP
            try:
                self._step(Tick(index, t_s, self.period_s, lateness_s, missed, deadline_s))
            except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
                self._end_if_forked()
                page[METHOD] = IDLE
                self._calls.failed(error)
                return
            self._end_if_forked()
            page[METHOD] = IDLE
            if self._look is not None:
                self._look(t_s)
            if port.must_flush:
                # What the step sent leaves before anything else is done.
                port.flush()
            ended_s = monotonic()
            margin_s = pacer.end(port.at(ended_s))
            values: tuple[Any, ...] = (index, int(lateness_s * 1e6), int(margin_s * 1e6), missed)
            self._record("ticks", values)
            # Before the account of a late tick, which is a span of its own: spans end one after the other.
            self._add_span(Span(Cause.STEP, self._number, local_s, ended_s))
            if missed or lateness_s > self._late_s:
                self.late.explain(timing, local_s, began_s - local_s - ahead_s)
        if pacer.is_over:
            self._calls.ended()
