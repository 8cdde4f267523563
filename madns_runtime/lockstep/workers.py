"""The workers as the host sees them: forked, spoken to, listened to, and never left behind."""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.config import HostLaunch
from madns_runtime.errors import PeerError
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.assignment import Assignment
from madns_runtime.lockstep.frames import METHODS, POSITIONS, FrameReader, encode_frame
from madns_runtime.lockstep.worker import STACK_SIGNAL, run_worker
from madns_runtime.lockstep.worker_line import READ_BYTES
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.signal_names import signal_name
from madns_runtime.timing.granted_clock import GrantedClock, GrantedLimit

STACK_WAIT_S = 0.3
"""Time for a worker that hangs to write where it is, without its waits for a processor."""
STACK_WAIT_S_MAX = 10.0
"""The same with its waits for a processor."""
EXIT_WAIT_S = 2.0
"""Time from the end of a worker's line to the end of its process, without its waits for a processor."""
CHECK_S = 0.01
SEND_CHECK_S = 0.25
"""While a worker takes nothing, whether its time is over is looked at this often."""
SOCKET_BUFFER_BYTES = 4 * 1024 * 1024


@dataclass(slots=True)
class WorkerProcess:
    """One worker."""

    agents: list[int]
    """Indices of the agents that it runs, and of lost ones that would return to it, in order."""
    pid: int
    line: socket.socket
    position: memoryview
    reader: FrameReader = field(default_factory=FrameReader)
    answer: list[Any] | None = None
    """Last answer; None while it is awaited."""
    has_ended: bool = False

    @property
    def at(self) -> tuple[int, str]:
        """Agent under work, by index, and method of the plug-in, if in any."""
        index, doing = divmod(self.position[0], POSITIONS)
        is_busy = doing != frames.IDLE and index in self.agents
        return (index, METHODS[doing]) if is_busy else (self.agents[0], "")


class WorkerPool:
    """
    All workers of a run. It forks: make it before any thread is started.

    Args:
        launch: The run.
        directory: The run directory.
        shares: Whom each worker runs.
    """

    def __init__(self, launch: HostLaunch, directory: Path, shares: Sequence[range]) -> None:
        self.workers: list[WorkerProcess] = []
        self._by_agent: list[WorkerProcess] = []
        self._reactor: Reactor | None = None
        for share in shares:
            worker = _fork(launch, directory, share)
            self.workers.append(worker)
            self._by_agent += [worker] * len(share)

    def listen(
        self,
        reactor: Reactor,
        *,
        on_frame: Callable[[WorkerProcess, list[Any]], None],
        on_lost: Callable[[WorkerProcess, str], None],
    ) -> None:
        """
        Have the loop read what workers say.

        Args:
            reactor: The loop.
            on_frame: Called with each frame.
            on_lost: Called once with a worker whose line has ended, and how it ended.
        """
        self._reactor = reactor
        for worker in self.workers:
            worker.line.setblocking(False)
            read = partial(self._read, worker, on_frame, on_lost)
            reactor.add_reader(worker.line.fileno(), read)

    def _read(
        self,
        worker: WorkerProcess,
        on_frame: Callable[[WorkerProcess, list[Any]], None],
        on_lost: Callable[[WorkerProcess, str], None],
    ) -> None:
        try:
            data = worker.line.recv(READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        try:
            for frame in worker.reader.feed(data) if data else ():
                on_frame(worker, frame)
        except PeerError as error:
            self.let_go(worker)  # its line is closed, so it ends
            on_lost(worker, f"sent what is no answer: {error}")
            return
        if not data:
            on_lost(worker, self.let_go(worker))

    @property
    def have_all_ended(self) -> bool:
        """Whether no worker is left."""
        return all(worker.has_ended for worker in self.workers)

    def worker_for(self, agent: int) -> WorkerProcess | None:
        """Return the worker for an agent that returns: its own, another where that has ended; None where all have."""
        before = self._by_agent[agent]
        living = [worker for worker in self.workers if not worker.has_ended]
        if before in living or not living:
            return before if living else None
        after = min(living, key=lambda worker: len(worker.agents))
        before.agents.remove(agent)
        after.agents = sorted((*after.agents, agent))
        self._by_agent[agent] = after
        return after

    def number_of(self, worker: WorkerProcess) -> int:
        """Return a worker's place among all."""
        return self.workers.index(worker)

    @property
    def awaited(self) -> WorkerProcess | None:
        """The first of those whose answer has not come; None when nobody is awaited."""
        return next((w for w in self.workers if w.answer is None and not w.has_ended), None)

    def answers(self) -> Iterator[list[Any]]:
        """Yield what each worker said, in the order of their agents."""
        for worker in self.workers:
            if worker.answer is not None:
                yield worker.answer

    def order(self, worker: WorkerProcess, data: bytes, timeout_s: float) -> None:
        """
        Send a frame and await an answer.

        Raises:
            TimeoutError: The worker did not take it in time.
        """
        worker.answer = None
        limit = GrantedLimit(timeout_s)
        rest = memoryview(data)
        try:
            worker.line.settimeout(SEND_CHECK_S)
            while rest:
                try:
                    rest = rest[worker.line.send(rest) :]
                except TimeoutError:
                    if limit.is_over():
                        raise
        except TimeoutError:
            raise
        except OSError:
            return  # its end is read from the line
        finally:
            with contextlib.suppress(OSError):
                worker.line.setblocking(False)

    def stop(self, reason: str | None, timeout_s: float) -> None:
        """Have all close their records and end; one that does not listen is left to `end_left`."""
        for worker in self.workers:
            if not worker.has_ended:
                with contextlib.suppress(TimeoutError):
                    self.order(worker, encode_frame(frames.STOP, reason), timeout_s)

    def tell_stack(self, worker: WorkerProcess) -> None:
        """Have a worker that hangs write where it is, and end it."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(worker.pid, STACK_SIGNAL)
            own, until_s = GrantedClock(lambda: (worker.pid,)), monotonic() + STACK_WAIT_S_MAX
            while own.now_s() < STACK_WAIT_S and monotonic() < until_s:
                time.sleep(CHECK_S)
            os.kill(worker.pid, signal.SIGKILL)

    def end_left(self) -> list[WorkerProcess]:
        """Kill the workers that still live, and return them."""
        left = [worker for worker in self.workers if not worker.has_ended]
        for worker in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL)
            self.let_go(worker)
        return left

    def let_go(self, worker: WorkerProcess) -> str:
        """Close a worker's line and return how its process ended."""
        worker.has_ended = True
        if self._reactor is not None:
            self._reactor.remove_reader(worker.line.fileno())
        worker.line.close()
        code = _await_exit(worker.pid)
        if code is not None:
            return _how(code)
        # Nobody speaks to it any more: it must not live on.
        os.kill(worker.pid, signal.SIGKILL)
        _await_exit(worker.pid)
        return "has closed its line to the host and not ended"


def _fork(launch: HostLaunch, directory: Path, share: range) -> WorkerProcess:
    here, there = socket.socketpair()
    for end in (here, there):
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            end.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER_BYTES)
    position = memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("q")
    pid = os.fork()
    if pid == 0:
        assignment = Assignment(
            config=launch.config,
            devices=launch.devices,
            directory=directory,
            agents=share,
            position=position,
        )
        run_worker(assignment, there)
    there.close()
    return WorkerProcess(agents=list(share), pid=pid, line=here, position=position)


def _await_exit(pid: int) -> int | None:
    """Wait for a child's end and return its exit code, 0 if nobody knows it; None if it lives on after EXIT_WAIT_S."""
    limit = GrantedLimit(EXIT_WAIT_S, lambda: (pid,))
    while True:
        try:
            ended, status = os.waitpid(pid, os.WNOHANG)
        except ChildProcessError:
            return 0  # a plug-in has SIGCHLD ignored: the kernel kept no exit code
        if ended:
            return os.waitstatus_to_exitcode(status)
        if limit.is_over():
            return None
        time.sleep(CHECK_S)


def _how(code: int) -> str:
    return f"was killed by {signal_name(-code)}" if code < 0 else f"ended, exit code {code}"
