"""The host's long work: a `concurrent.futures.Executor`, and its results as events of the loop."""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from functools import partial
from pathlib import Path
from typing import Any, cast

from madns_runtime.config import ExecutorSettings
from madns_runtime.errors import ConfigurationError, MachineError, PluginError
from madns_runtime.plugin.isolation import call_plugin
from madns_runtime.plugin.jobs import WORKER_DIED, JobFailed, pack_job, run_job, run_packed_job
from madns_runtime.plugin.registry import load_function
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.timing.granted_clock import repeat_until_granted

JOBS_MAX = 10_000
"""Jobs submitted and not yet taken back."""
START_TIMEOUT_S = 30.0
"""Time for the workers of a pool of our own to be there; waits for a processor do not count."""
START_CHECK_S = 0.5


def make_executor(settings: ExecutorSettings) -> Executor:
    """
    Return the executor that *settings* name, its workers already running.

    Call it before any thread is started: the workers of the process pool are forked.

    Raises:
        ConfigurationError: The kind is unknown, what it names is no executor, or a cluster does not answer.
        MissingExtraError: dask is wanted and not installed.
    """
    if settings.kind == "process":
        return _process_pool(settings.workers)
    if settings.kind == "thread":
        return ThreadPoolExecutor(settings.workers, thread_name_prefix="executor")
    if settings.kind == "dask":
        from madns_runtime.plugin.dask_executor import connect  # a second of imports that few need

        return connect(settings)
    return _made_elsewhere(settings.kind)


def _made_elsewhere(kind: str) -> Executor:
    """Return what the callable makes that *kind* names as module:callable."""
    try:
        executor = call_plugin(kind.partition(":")[2], load_function(kind, Path()))
    except PluginError as error:
        raise ConfigurationError(f"executor.kind: {error}") from error
    if not (hasattr(executor, "submit") and hasattr(executor, "shutdown")):
        raise ConfigurationError(
            f"executor.kind: {kind} returned {type(executor).__name__}, which is no"
            " concurrent.futures.Executor"
        )
    return cast("Executor", executor)


def _process_pool(workers: int) -> ProcessPoolExecutor:
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("fork"),
        initializer=_start_worker,
        initargs=(os.getpid(),),
    )
    try:
        # The first job makes the pool fork every worker: now, while no thread runs.
        started = pool.submit(os.getpid)
        repeat_until_granted(partial(started.result, START_CHECK_S), START_TIMEOUT_S)
    except (OSError, BrokenExecutor) as error:  # a timeout is an OSError
        raise MachineError(
            f"executor: {workers} worker(s) cannot be started: {str(error) or type(error).__name__}"
        ) from error
    return pool


def _start_worker(parent: int) -> None:
    # A pool's worker holds both ends of its pipe, so its parent's death would leave it waiting for ever.
    die_with_parent()
    if os.getppid() != parent:
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.set_wakeup_fd(-1)


class JobRunner:
    """
    Hands functions to an executor and their results to the loop.

    Args:
        reactor: The loop in which *on_done* is called.
        executor: Who works.
        on_done: Called with the job's number and its future, which is finished, or was cancelled by the executor.
    """

    def __init__(
        self,
        reactor: Reactor,
        executor: Executor,
        on_done: Callable[[int, Future[Any]], None],
    ) -> None:
        self._reactor = reactor
        self._executor = executor
        self._on_done = on_done
        self._pending: dict[int, Future[Any]] = {}
        self._submitted_count = 0

    @property
    def pending_count(self) -> int:
        """Jobs whose result has not been taken."""
        return len(self._pending)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        """
        Start a job and return its number; its arguments are copied.

        Raises:
            ConfigurationError: More than JOBS_MAX are waiting.
            MachineError: A worker has died, and the executor with it.
        """
        if len(self._pending) >= JOBS_MAX:
            raise ConfigurationError(f"more than {JOBS_MAX} jobs are waiting in the executor")
        self._submitted_count += 1
        job = self._submitted_count
        try:
            future = self._start(function, arguments)
        except BrokenExecutor as error:
            raise MachineError(WORKER_DIED) from error
        self._pending[job] = future
        future.add_done_callback(
            lambda _: self._reactor.call_soon_threadsafe(lambda: self._done(job))
        )
        return job

    def _start(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Future[Any]:
        if getattr(self._executor, "packs_at_once", False):
            return self._executor.submit(run_job, function, *arguments)
        try:
            packed = pack_job(function, arguments)
        except JobFailed as error:
            if type(self._executor) is not ProcessPoolExecutor:  # threads share it
                return self._executor.submit(run_job, function, *arguments)
            unsent: Future[Any] = Future()
            unsent.set_exception(error)
            return unsent
        return self._executor.submit(run_packed_job, packed)

    def tell_dropped(self, log: Callable[[str, str], None]) -> None:
        """Say how many jobs are not done now that simulated time is over: their values come too late."""
        if count := len(self._pending):
            log("warning", f"{count} of the executor's jobs not done when simulated time was over")

    def close(self) -> None:
        """Let go of every job and end the workers, also one that is deep in its work."""
        self._pending.clear()
        workers = list((getattr(self._executor, "_processes", None) or {}).values())
        try:
            self._executor.shutdown(wait=False, cancel_futures=True)
        except Exception:  # noqa: BLE001 - somebody's executor; the run is over, and its result counts
            traceback.print_exc()
        for worker in workers:
            worker.kill()

    def _done(self, job: int) -> None:
        future = self._pending.pop(job, None)
        if future is not None:  # after `close` nobody awaits it
            self._on_done(job, future)
