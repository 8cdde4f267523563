"""The ticks of one agent that began late or never: each counted, and recorded, under one cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from madns_runtime.realtime.loop_account import LateTick, LoopAccount
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import LATE_TICKS
from madns_runtime.timing.late_causes import CAUSES, Cause
from madns_runtime.timing.rate import Pacer, TickTiming


class LateTicks:
    """
    The account of one agent.

    Args:
        number: Its number among the agents of its process.
        period_s: Of its ticks.
        recorder: Where they are recorded.
        account: What its loop did.
    """

    def __init__(
        self, number: int, period_s: float, *, recorder: Recorder, account: LoopAccount
    ) -> None:
        self.started_s = 0.0
        """When the agent began to run, s of the local clock."""
        self._number = number
        self._period_s = period_s
        self._recorder = recorder
        self._account = account
        self._counts: Counter[Cause] = Counter()
        self._missed = 0

    def explain(self, timing: TickTiming, began_s: float, leapt_s: float) -> None:
        """
        Count and record a tick that began late, and those missed before it, under one cause.

        Args:
            timing: Of the tick.
            began_s: When it began, s of the local clock.
            leapt_s: By how much simulated time has leapt ahead of that clock since the tick before, s.
        """
        index, _, _, lateness_s, missed = timing
        late = LateTick(
            self._number,
            began_s - lateness_s - missed * self._period_s,
            began_s,
            self.started_s,
            self._period_s,
            leapt_s,
        )
        cause = self._account.explain(late)
        self._counts[cause] += missed or 1
        self._missed += missed
        self._recorder.record(LATE_TICKS.name, (index, int(lateness_s * 1e6), missed, cause.value))

    def never_run(self, pacer: Pacer, t_s: float, now_s: float, leapt_s: float) -> None:
        """
        Count and record the ticks missed that no other followed, at the end of the run, as before the tick that is next.

        Args:
            pacer: Of the agent.
            t_s: The simulated time, s.
            now_s: Now, s of the local clock.
            leapt_s: As of `explain`.
        """
        new = pacer.missed - self._missed
        if new <= 0:
            return
        index = pacer.next_index
        due_s = now_s - (t_s - pacer.deadline_of(index - new))
        late = LateTick(self._number, due_s, now_s, self.started_s, self._period_s, leapt_s)
        cause = self._account.explain(late)
        self._counts[cause] += new
        self._missed = pacer.missed
        self._recorder.record(LATE_TICKS.name, (index, 0, new, cause.value))

    def counts(self) -> Mapping[str, int]:
        """Return how many ticks were missed, or began late, by cause; those of which there are none left out."""
        return {cause.value: self._counts[cause] for cause in CAUSES if self._counts[cause]}
