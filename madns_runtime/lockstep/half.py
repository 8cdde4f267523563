"""
The simulation's host half in a lockstep run: its calls are watched, and its jobs take no simulated time.

Jobs run on the executor, beside each other, while simulated time stands; their values are handed in
by the order in which they were submitted, whichever is done first.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from madns_runtime.config import Timeouts
from madns_runtime.executor import JobRunner
from madns_runtime.half import HalfFailed, HostHalf
from madns_runtime.lockstep.crew import WorkerProcess
from madns_runtime.lockstep.meeting import STACK_HINT, Meeting
from madns_runtime.lockstep.result import Ending
from madns_runtime.lockstep.watch import CallWatch
from madns_runtime.plugin.api import HOST

REPEATS_MAX = 100_000
"""Calls of the timer, or jobs, at one simulated time; more means that the half never lets time go on."""


class LockstepHalf:
    """
    Calls the host half.

    Args:
        half: The plug-in's.
        timeouts: How long its calls and jobs may take.
        meeting: Where jobs are waited for and faults end the run.
        executor: Who does the jobs.
        on_hang: Called, in another thread, with the reason when a call does not return; must not return.
    """

    def __init__(
        self,
        half: HostHalf,
        timeouts: Timeouts,
        *,
        meeting: Meeting,
        executor: Executor,
        on_hang: Callable[[str], None],
    ) -> None:
        self._half = half
        self._timeouts = timeouts
        self._meeting = meeting
        self._on_hang = on_hang
        self._jobs = JobRunner(meeting.reactor, executor, self._job_done)
        self._outstanding: deque[int] = deque()
        self._finished: dict[int, Future[Any]] = {}
        self._watch = CallWatch(self._hangs)
        self._timer_repeats = 0

    @property
    def next_s(self) -> float | None:
        """Simulated time at which the timer is to be called; None if it wants none."""
        return self._half.next_s

    def wake(self, t_s: float) -> None:
        """Note that the timer is wanted at *t_s*; see `plugin.api.HostContext.wake`."""
        self._half.wake(t_s)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """Start a job; see `plugin.api.HostContext.submit`."""
        job = self._jobs.submit(function, *arguments)
        self._outstanding.append(job)
        return job

    def call(self, name: str, *arguments: Any, limit_s: float | None = None) -> Any:
        """
        Call a method, and have done what it submits.

        Args:
            name: The method's.
            arguments: Its.
            limit_s: Wall time it may take; timeouts.tick_s if None.

        Raises:
            RunEnds: It raised, returned something else, or its job failed.
        """
        value = self._guard(name, partial(self._half.call, name, *arguments), limit_s)
        self._settle()
        return value

    def call_timer(self, t_s: float) -> None:
        """
        Call the timer at simulated time *t_s*, and have done what it submits.

        Raises:
            RunEnds: As `call`, or it never lets simulated time go on.
        """
        self._guard("timer", partial(self._half.call_timer, t_s))
        self._settle()
        next_s = self._half.next_s
        is_again = next_s is not None and next_s <= t_s
        self._timer_repeats = self._timer_repeats + 1 if is_again else 0
        if self._timer_repeats > REPEATS_MAX:
            self._refuse(f"timer asked {REPEATS_MAX} times in a row for t = {t_s:g} s")

    def finish(self) -> Any:
        """
        Return the half's summary; what it submits meanwhile comes too late.

        Raises:
            RunEnds: As `call`.
        """
        return self._guard("finish", partial(self._half.call, "finish"))

    def close(self) -> None:
        """End the executor, whatever it is doing."""
        self._jobs.close()

    def _guard(self, name: str, call: Callable[[], Any], limit_s: float | None = None) -> Any:
        self._watch.began(f"{self._half.name}.{name}", limit_s or self._timeouts.tick_s)
        try:
            return call()
        except HalfFailed as failure:
            self._meeting.fail(HOST, str(failure))
        finally:
            self._watch.ended()

    def _settle(self) -> None:
        """Hand in the values of all jobs, also of those that their values lead to."""
        settled = 0
        while self._outstanding:
            job = self._outstanding[0]
            limit_s = self._timeouts.host_setup_s
            self._meeting.wait(partial(self._finished.__contains__, job), limit_s, self._late)
            self._outstanding.popleft()
            future = self._finished.pop(job)
            self._guard("result", partial(self._half.take_job, job, future))
            settled += 1
            if settled > REPEATS_MAX:
                self._refuse(f"result submitted {REPEATS_MAX} jobs in a row")

    def _refuse(self, text: str) -> None:
        self._meeting.fail(HOST, f"{self._half.name}.{text}: simulated time stands")

    def _late(self, worker: WorkerProcess | None, limit_s: float) -> Ending:
        del worker  # none is awaited
        job = self._outstanding[0]
        reason = f"{self._half.name}: job {job} has not ended within {limit_s:g} s"
        return Ending(who=HOST, reason=f"{reason}{self._meeting.when()}")

    def _job_done(self, job: int, future: Future[Any]) -> None:
        self._finished[job] = future
        self._meeting.reactor.stop()

    def _hangs(self, call: str, limit_s: float) -> None:
        when = self._meeting.when()
        self._on_hang(f"{call} has not returned within {limit_s:g} s{when}; {STACK_HINT}")
        os._exit(1)
