"""
The simulation's host half in a lockstep run: its calls are watched, and its jobs take no simulated time.

Jobs run on the executor, beside each other, while simulated time stands; their values are handed in
by the order in which they were submitted, whichever is done first.
"""

from __future__ import annotations

import os
import traceback
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.context import clean_text, describe_exception
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.executor import JobFailed, JobRunner
from madns_runtime.lockstep.crew import WorkerProcess
from madns_runtime.lockstep.meeting import STACK_HINT, Meeting
from madns_runtime.lockstep.recorder import LockstepRecorder
from madns_runtime.lockstep.result import Ending
from madns_runtime.lockstep.watch import CallWatch
from madns_runtime.plugin.api import HOST, HostSimulation

Check = Callable[[Any], Any]


class HostHalf:
    """
    Calls the host half.

    Args:
        simulation: The plug-in's.
        config: The run.
        meeting: Where jobs are waited for and faults end the run.
        executor: Who does the jobs.
        recorder: Where tracebacks are logged.
        on_hang: Called, in another thread, with the reason when a call does not return; must not return.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, all but one keyword-only
        self,
        simulation: HostSimulation,
        *,
        config: RunConfig,
        meeting: Meeting,
        executor: Executor,
        recorder: LockstepRecorder,
        on_hang: Callable[[str], None],
    ) -> None:
        self.simulation = simulation
        self._name = type(simulation).__name__
        self._timeouts = config.timeouts
        self._meeting = meeting
        self._recorder = recorder
        self._on_hang = on_hang
        self._jobs = JobRunner(meeting.reactor, executor, self._job_done)
        self._outstanding: deque[int] = deque()
        self._finished: dict[int, Future[Any]] = {}
        self._watch = CallWatch(self._hangs)

    def call(
        self, name: str, *arguments: Any, check: Check | None = None, limit_s: float | None = None
    ) -> Any:
        """
        Call a method, and have done what it submits.

        Args:
            name: The method's.
            arguments: Its.
            check: Returns what it returned, or refuses it.
            limit_s: Wall time it may take; timeouts.tick_s if None.

        Raises:
            RunEnds: It raised, returned something else, or its job failed.
        """
        value = self._call(name, *arguments, check=check, limit_s=limit_s)
        if self._outstanding:
            self._settle()
        return value

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """Start a job; see `plugin.api.HostContext.submit`."""
        job = self._jobs.submit(function, *arguments)
        self._outstanding.append(job)
        return job

    def refuse(self, text: str) -> None:
        """
        End the run for what the half does against its contract.

        Raises:
            RunEnds: Always.
        """
        self._meeting.fail(HOST, f"{self._name}.{text}")

    def close(self) -> None:
        """End the executor, whatever it is doing."""
        self._jobs.close()

    def _call(
        self, name: str, *arguments: Any, check: Check | None = None, limit_s: float | None = None
    ) -> Any:
        doing = f"{self._name}.{name}"
        self._watch.began(doing, limit_s or self._timeouts.tick_s)
        try:
            value = getattr(self.simulation, name)(*arguments)
        except MachineError as error:  # a full disk: no fault of the plug-in's
            self._meeting.fail(HOST, str(error))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
            self._log(error)
            self._meeting.fail(HOST, describe_exception(error, doing))
        finally:
            self._watch.ended()
        try:
            return value if check is None else check(value)
        except PluginError as error:
            self._meeting.fail(HOST, f"{doing} returned {clean_text(str(error))}")

    def _settle(self) -> None:
        """Hand in the values of all jobs, also of those that their values lead to."""
        while self._outstanding:
            job = self._outstanding[0]
            limit_s = self._timeouts.host_setup_s
            self._meeting.wait(partial(self._finished.__contains__, job), limit_s, self._late)
            self._outstanding.popleft()
            future = self._finished.pop(job)
            error = future.exception()
            if error is not None:
                doing = f"{self._name}: job {job}"
                text = f"{doing}: {error}" if isinstance(error, JobFailed) else ""
                self._log(error)
                self._meeting.fail(HOST, text or describe_exception(error, doing))
            self._call("result", job, future.result())

    def _late(self, worker: WorkerProcess | None, limit_s: float) -> Ending:
        del worker  # none is awaited
        job = self._outstanding[0]
        reason = f"{self._name}: job {job} has not ended within {limit_s:g} s"
        return Ending(who=HOST, reason=f"{reason}{self._meeting.when()}")

    def _job_done(self, job: int, future: Future[Any]) -> None:
        self._finished[job] = future
        self._meeting.reactor.stop()

    def _hangs(self, call: str, limit_s: float) -> None:
        when = self._meeting.when()
        self._on_hang(f"{call} has not returned within {limit_s:g} s{when}; {STACK_HINT}")
        os._exit(1)

    def _log(self, error: BaseException) -> None:
        text = "".join(traceback.format_exception(error))
        self._recorder.log("critical", text, self._recorder.t_s)
