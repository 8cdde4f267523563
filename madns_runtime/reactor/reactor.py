"""
The loop: one thread that waits for sockets, pipes, timers and signals, and calls back.

Nothing in it polls on a period, and no callback may block.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable
from time import monotonic
from types import FrameType
from typing import Any

from madns_runtime.errors import MachineError
from madns_runtime.reactor.forking import CAME_BACK, end_child, generation
from madns_runtime.reactor.libc import IS_LINUX
from madns_runtime.reactor.poller import EpollPoller, Poller, SelectorPoller
from madns_runtime.reactor.timers import Timer, TimerQueue

Callback = Callable[[], None]

TIMERS_BATCH_MAX = 64
"""Due timers run in a row before descriptors get their turn."""
CALLS_BATCH_MAX = 64
"""Calls from other threads run in a row."""
CALLS_MAX = 100_000
"""Calls from other threads that may wait; more means that the loop hangs."""
SLEEPS_KEPT = 32
"""Last waits that are kept one by one."""
WAKE_BYTES = (1).to_bytes(8, sys.byteorder)
"""Bytes that an eventfd takes; a pipe does not mind."""


class SignalPipe:
    """
    Turns signals into readable bytes, so that their callbacks run in the loop alone; only for the main thread.

    Closing gives back the handlers and the wake-up descriptor found at first. A forked process
    shares the pipe until it closes its copy of the reactor, and must do so before anything else.
    """

    def __init__(self) -> None:
        self.fd, self._write_fd = os.pipe()  # readable when signals came
        os.set_blocking(self.fd, False)
        os.set_blocking(self._write_fd, False)
        self._callbacks: dict[int, Callable[[], None]] = {}
        self._handlers_before: dict[int, Any] = {}
        self._wakeup_before = signal.set_wakeup_fd(self._write_fd, warn_on_full_buffer=False)

    def on_signal(self, signum: int, callback: Callable[[], None]) -> None:
        """Call *callback* from `dispatch` when the signal comes; the last one set counts."""
        if signum not in self._handlers_before:
            self._handlers_before[signum] = signal.signal(signum, _take_note)
        self._callbacks[signum] = callback

    def dispatch(self) -> None:
        """Call the callbacks of all signals that came."""
        try:
            data = os.read(self.fd, 256)
        except BlockingIOError:
            return
        # Once a kind: the kernel, too, merges signals that come faster than they are handled.
        left = list(dict.fromkeys(data))
        try:
            while left:
                callback = self._callbacks.get(left.pop(0))
                if callback is not None:
                    callback()
        finally:
            # A callback that raises does not swallow the signals behind it.
            if left:
                os.write(self._write_fd, bytes(left))

    def close(self) -> None:
        """Give back the handlers as they were."""
        for signum, handler in self._handlers_before.items():
            # A handler that was not set from Python reads as None and cannot be given back.
            signal.signal(signum, signal.SIG_DFL if handler is None else handler)
        self._handlers_before.clear()
        with contextlib.suppress(ValueError):
            signal.set_wakeup_fd(self._wakeup_before)
        os.close(self.fd)
        os.close(self._write_fd)


def _take_note(signum: int, frame: FrameType | None) -> None:
    """Do nothing here: the byte on the wake-up descriptor is the message."""


class Reactor:
    """
    One epoll loop per process, with all timers behind one timerfd.

    Exceptions of callbacks leave `run`; what was due besides is still due, and `run` may be called
    again. After a fork the child must `close` its copy first; that leaves the parent's untouched.

    Args:
        portable: Use the `selectors` module even where epoll and timerfd exist; wake-ups are then
            half a millisecond late.
    """

    def __init__(self, *, portable: bool = False) -> None:
        self._pid = os.getpid()
        self._generation = generation()
        self.is_portable = portable or not IS_LINUX
        self._poller: Poller = SelectorPoller() if self.is_portable else EpollPoller()
        self._readers: dict[int, Callback] = {}
        self._always_readable: list[int] = []
        self._added: set[int] = set()
        self._timers = TimerQueue()
        self._signals: SignalPipe | None = None
        self._calls: deque[Callback] = deque()
        self._wake_read_fd, self._wake_write_fd = _wake_descriptors()
        self._wake_lock = threading.Lock()
        self._is_woken = False
        self._is_stopping = False
        self._is_closed = False
        self.waits = 0
        """How often it has waited for something to do."""
        self.slept_s = 0.0
        """Time that it has waited for something to do, s."""
        self.sleeps = deque([(-math.inf, -math.inf)], maxlen=SLEEPS_KEPT)
        """When it waited, the newest last: from, to, on its clock, s."""
        self.add_reader(self._wake_read_fd, self._run_calls)

    def now_s(self) -> float:
        """Return the time of the clock that timers are set on, s."""
        return monotonic()

    @property
    def timer_settings(self) -> int:
        """How often the kernel's timer was set."""
        return self._poller.timer_settings

    def expect_period(self, period_s: float) -> None:
        """Take note that most of its timers' deadlines will follow each other after so long, s: waiting costs less then."""
        self._poller.period_s = period_s

    def add_reader(self, fd: int, callback: Callback) -> None:
        """
        Call *callback* whenever *fd* is readable or its peer is gone; replaces an earlier callback.

        Regular files and /dev/null count as always readable.
        """
        if fd in self._readers:
            self.remove_reader(fd)
        try:
            self._poller.register(fd)
        except PermissionError:
            self._always_readable.append(fd)
        self._readers[fd] = callback
        # An event of this round may still name an earlier owner of the same number.
        self._added.add(fd)

    def remove_reader(self, fd: int) -> bool:
        """Listen to *fd* no more; False if nobody did. Call it before closing the descriptor."""
        if self._readers.pop(fd, None) is None:
            return False
        if fd in self._always_readable:
            self._always_readable.remove(fd)
        else:
            self._poller.unregister(fd)
        return True

    def call_at(self, when_s: float, callback: Callback) -> Timer:
        """Call *callback* once when the clock shows *when_s*; a time that has passed means soon."""
        return self._timers.add(when_s, callback)

    def call_soon_threadsafe(self, callback: Callback) -> None:
        """
        Call *callback* in the loop; the one method that other threads may call.

        Calls keep their order. After `close` nothing happens.

        Raises:
            MachineError: CALLS_MAX calls are waiting already.
        """
        # Locked against `close`: the descriptor's number may soon belong to another file.
        with self._wake_lock:
            if self._is_closed:
                return
            if len(self._calls) >= CALLS_MAX:
                raise MachineError(f"the loop does not run: {CALLS_MAX} calls wait for it")
            self._calls.append(callback)
            self._wake()

    def on_signal(self, signum: int, callback: Callback) -> None:
        """Call *callback* in the loop when the signal comes; main thread only, undone by `close`."""
        if self._signals is None:
            self._signals = SignalPipe()
            self.add_reader(self._signals.fd, self._signals.dispatch)
        self._signals.on_signal(signum, callback)

    def stop(self) -> None:
        """Let `run` return after the present callback; before `run`, let it return at once."""
        self._is_stopping = True

    def run(self) -> None:
        """
        Run until `stop`.

        Raises:
            Exception: Whatever a callback raised.
        """
        try:
            while not self._is_stopping:
                self._turn()
        finally:
            self._is_stopping = False

    def close(self) -> None:
        """Free everything held and restore the signals; descriptors of readers stay open."""
        if self._is_closed:
            return
        with self._wake_lock:
            self._is_closed = True
            self._calls.clear()
        if self._signals is not None:
            self._signals.close()
        self._timers.clear()
        self._readers.clear()
        self._poller.close()
        for fd in {self._wake_read_fd, self._wake_write_fd}:
            os.close(fd)

    def end_if_forked(self) -> None:
        """Do as `end_if_stray`, often and without a system call; a fork that Python did not do is found by that alone."""
        if generation() != self._generation:
            self.end_if_stray()

    def end_if_stray(self) -> None:
        """End this process if it was forked in a callback and came back from it: two would run one loop."""
        if os.getpid() == self._pid:
            return
        with contextlib.suppress(BaseException):
            sys.stderr.write(f"a plug-in's method {CAME_BACK}; it was ended\n")
        end_child(1)

    def _turn(self) -> None:
        until_s = self._timers.earliest_s()
        now_s = monotonic()
        if until_s <= now_s:
            self._run_timers()
            if self._is_stopping:
                return
            until_s = self._timers.earliest_s()
            now_s = monotonic()
        if self._always_readable:
            until_s = 0.0
        self._added.clear()
        self.end_if_stray()  # before it takes a wake-up, which is its parent's
        ready = self._poller.wait(until_s)
        woken_s = monotonic()
        self.waits += 1
        self.slept_s += woken_s - now_s
        self.sleeps.append((now_s, woken_s))
        self._run_readers(ready)

    def _run_timers(self) -> None:
        """Run timers that are due by now, a bounded number."""
        now_s = monotonic()
        for _ in range(TIMERS_BATCH_MAX):
            timer = self._timers.pop_due(now_s)
            if timer is None:
                return
            timer.callback()
            if self._is_stopping:
                return

    def _run_readers(self, ready: list[int]) -> None:
        """Call the readers of *ready*, and between them the timers that became due meanwhile."""
        if self._always_readable:
            ready = ready + self._always_readable
        is_first = True
        for fd in ready:
            if not is_first and self._timers.earliest_s() <= monotonic():
                self._run_timers()
            if self._is_stopping:
                return
            callback = self._readers.get(fd)
            if callback is not None and fd not in self._added:
                callback()
                is_first = False

    def _run_calls(self) -> None:
        with self._wake_lock:
            with contextlib.suppress(BlockingIOError):
                os.read(self._wake_read_fd, 4096)
            self._is_woken = False
        try:
            for _ in range(CALLS_BATCH_MAX):
                if self._is_stopping or not self._calls:
                    return
                self._calls.popleft()()
        finally:
            with self._wake_lock:
                if self._calls and not self._is_closed:
                    self._wake()

    def _wake(self) -> None:
        if not self._is_woken:
            self._is_woken = True
            os.write(self._wake_write_fd, WAKE_BYTES)


def _wake_descriptors() -> tuple[int, int]:
    """Return a non-blocking descriptor to read and one to write: one eventfd, or the ends of a pipe."""
    if hasattr(os, "eventfd"):
        fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        return fd, fd
    read_fd, write_fd = os.pipe()
    os.set_blocking(read_fd, False)
    os.set_blocking(write_fd, False)
    return read_fd, write_fd
