"""
Dask as the host's executor, for truth that one machine is too small for. The one place that imports dask.

With an address the workers are a cluster's, which somebody else started and which stays; without one
they are a cluster of our own on this machine, whose processes end with this one.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, TypeVar

import madns_runtime
from madns_runtime.config import ExecutorSettings
from madns_runtime.errors import ConfigurationError, MachineError, MissingExtraError
from madns_runtime.plugin.code_places import MODULE_PREFIX
from madns_runtime.plugin.jobs import (
    JobFailed,
    describe_unsent_job,
    describe_unsent_value,
    run_job,
)
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.timing.granted_clock import repeat_until_granted

try:
    from distributed import Client, LocalCluster
    from distributed.protocol.pickle import dumps, loads
except ImportError as error:
    raise MissingExtraError("dask", "dask") from error

T = TypeVar("T")

CONNECT_S = 20.0
"""Time for the scheduler to answer, and again for the workers: all within timeouts.host_start_s."""
CONNECT_CHECK_S = 0.5
CONNECT_ATTEMPTS = 8
"""Attempts to connect; one fails where the scheduler tells all its clients something just as it greets this one."""
CLOSE_S = 3.0
"""Time to close in good order; after that connections are dropped, and processes of our own killed."""


class ClosingClient(Client):  # type: ignore[misc]  # distributed has no types
    """A client that leaves nothing behind if it does not come to be connected."""

    def start(self, **more: Any) -> None:
        """Connect, or close: left to the collector of garbage, closing would hold whatever thread that runs in."""
        try:
            super().start(**more)
        except BaseException:  # Ctrl-C too; it is raised again
            with contextlib.suppress(Exception):  # the first failure is the one to tell
                self.close(timeout=CLOSE_S)
            raise


class DaskExecutor(Executor):
    """
    `Client.get_executor()`, made to the contract that the host's loop relies on.

    A job whose scheduler is gone fails, where Dask's own executor cancels it, which nobody would be
    told of. Arguments travel packed: Dask looks for tasks of its own in lists and mappings.

    Args:
        client: Connected.
        address: The scheduler's.
        cluster: Our own one, or None.
    """

    packs_at_once = True
    """Arguments of a job are packed while `submit` runs; Dask itself would do it later."""

    def __init__(
        self,
        client: Client,
        address: str,
        cluster: LocalCluster | None = None,
    ) -> None:
        self.client = client
        self.address = address
        self._cluster = cluster
        # Not pure: two jobs with equal arguments are two jobs.
        self._executor = client.get_executor(pure=False)
        self._is_closing = False

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """
        Start a job.

        Raises:
            ConfigurationError: It comes from a file that workers elsewhere cannot import.
            RuntimeError: The executor is shut down.
        """
        for thing in (fn, *args):
            if str(getattr(thing, "__module__", "")).startswith(MODULE_PREFIX):
                name = getattr(thing, "__qualname__", type(thing).__qualname__)
                raise ConfigurationError(
                    f"executor.kind dask: expected a job that workers can import, got {name} from a file"
                    " beside the scenario; install the simulation as a package there, or use kind process"
                )
        outer: Future[T] = Future()
        if self.client.status in ("closing", "closed") and not self._is_closing:
            # Dask takes jobs also when it has given up its scheduler, and never answers.
            outer.set_exception(self._lost())
            return outer
        try:
            packed = dumps(functools.partial(fn, *args, **kwargs))
        except Exception as error:  # noqa: BLE001 - classes of a plug-in may raise anything
            function = args[0] if fn is run_job else fn
            outer.set_exception(JobFailed(describe_unsent_job(function, error)))
            return outer
        inner = self._executor.submit(_do, packed)
        inner.add_done_callback(lambda done: self._pass_on(done, outer))
        return outer

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, and end one of our own; what is not done by then is dropped unless *wait*."""
        if self._is_closing:
            return
        self._is_closing = True
        # What a lost scheduler or a worker deep in its work makes fail here no longer matters.
        with contextlib.suppress(Exception):
            self._executor.shutdown(wait=wait and not cancel_futures)
        with contextlib.suppress(Exception):
            self.client.close(timeout=CLOSE_S)
        if self._cluster is not None:
            _close(self._cluster)

    def _pass_on(self, inner: Future[T], outer: Future[T]) -> None:
        if not outer.set_running_or_notify_cancel():
            return
        if inner.cancelled():
            outer.set_exception(self._lost())
        elif (failure := inner.exception()) is not None:
            outer.set_exception(failure)
        else:
            outer.set_result(inner.result())

    def _lost(self) -> MachineError:
        return MachineError(
            f"executor: Dask's scheduler at {self.address} is gone, and its jobs with it"
        )


def connect(settings: ExecutorSettings) -> DaskExecutor:
    """
    Return an executor on the cluster at settings.address, or on one of our own with settings.workers.

    Raises:
        ConfigurationError: Nobody answers there, no worker is there, or a worker has another
            cosmos-madns than this host.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # our errors say it in one line
    if settings.address:
        client = _client(settings.address, settings.address)
        return _checked(DaskExecutor(client, settings.address), 1)
    cluster = LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        preload=[__name__],
        silence_logs=logging.CRITICAL,
    )
    address = cluster.scheduler_address
    executor = DaskExecutor(_client(cluster, address), address, cluster)
    cluster.scale(settings.workers)
    return _checked(executor, settings.workers)


def dask_setup(worker: Any) -> None:
    """Prepare a worker of our own cluster; Dask calls it, since `connect` names this module as a preload."""
    die_with_parent()
    with contextlib.suppress(ValueError):  # not the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _do(packed: bytes) -> Any:
    """Do a job in a worker; a value that cannot travel is its failure, where Dask would try for ever."""
    value = loads(packed)()
    try:
        dumps(value, buffer_callback=lambda _: None)  # arrays are not copied
    except Exception as error:  # classes of a plug-in may raise anything
        raise JobFailed(describe_unsent_value(error)) from error
    return value


def version_here() -> str:
    """Return the version of cosmos-madns and Python; runs in workers."""
    return f"{madns_runtime.__version__} on Python {sys.version_info[0]}.{sys.version_info[1]}"


def _client(where: Any, address: str) -> Client:
    try:
        for _ in range(CONNECT_ATTEMPTS - 1):
            with contextlib.suppress(AssertionError):  # of Dask, by which it knows the greeting
                return ClosingClient(where, timeout=CONNECT_S, set_as_default=False)
        return ClosingClient(where, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:  # a timeout is an OSError
        raise ConfigurationError(
            f"executor.address: expected a Dask scheduler at {address}, none answered in"
            f" {CONNECT_S:g} s ({_first_line(error)}); is it started (`dask scheduler`), its port open?"
        ) from error
    except Exception as error:  # of words of another protocol, read as a length: MemoryError, ...
        raise ConfigurationError(
            f"executor.address: expected a Dask scheduler at {address}, and what answers there is none"
            f" ({_first_line(error)}); is it the port that `dask scheduler` tells, not that of its dashboard?"
        ) from error


def _checked(executor: DaskExecutor, workers: int) -> DaskExecutor:
    """Return the executor once its workers are there and can do our jobs, or close it and raise."""
    try:
        _check_workers(executor, workers)
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    return executor


def _check_workers(executor: DaskExecutor, workers: int) -> None:
    client, where = executor.client, executor.address
    wait = functools.partial(client.wait_for_workers, workers, min(CONNECT_CHECK_S, CONNECT_S))
    try:
        repeat_until_granted(wait, CONNECT_S)
    except TimeoutError as error:
        raise ConfigurationError(
            f"executor: expected {workers} worker(s) at {where}, not there in {CONNECT_S:g} s;"
            f" start them: dask worker {where}"
        ) from error
    asked = {
        worker: client.submit(version_here, workers=[worker], pure=False)
        for worker in client.nthreads()
    }
    faults = []
    for worker, answer in asked.items():
        try:
            found = answer.result(timeout=CONNECT_S)
        except Exception as error:  # noqa: BLE001 - unpickling may raise anything there
            found = f"{type(error).__name__}: {_first_line(error)}"
        if found != version_here():
            faults.append(
                f"executor: {worker}: expected cosmos-madns {version_here()}, got {found}"
            )
    if faults:
        raise ConfigurationError("\n".join(faults))


def _close(cluster: LocalCluster) -> None:
    pids = [nanny.pid for nanny in cluster.workers.values() if getattr(nanny, "pid", None)]
    with contextlib.suppress(Exception):  # a cluster that does not end in time is killed
        cluster.close(timeout=CLOSE_S)
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
