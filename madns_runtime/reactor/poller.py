"""Waiting for descriptors and one deadline: epoll with a timerfd on Linux, `selectors` elsewhere."""

from __future__ import annotations

import contextlib
import math
import os
import select
import selectors
import time
from time import monotonic
from typing import Protocol

from madns_runtime.reactor import libc

EVENTS_MAX = 64
"""Descriptors reported by one wait; the others come with the next."""
NANOSECONDS = 1_000_000_000
FAR_S = 1e9
"""A time of the monotonic clock beyond this, thirty years after the start of the machine, is never."""
WAIT_S_MAX = 86_400.0
"""The portable poller looks up at least this often: its platform may not take longer timeouts."""


class Poller(Protocol):
    """Waits for descriptors to be readable, until a deadline."""

    timer_settings: int
    """How often the kernel's timer was set; 0 without one."""

    def register(self, fd: int) -> None:
        """
        Watch *fd*.

        Raises:
            PermissionError: It is a kind of file that is always readable and cannot be watched.
        """

    def unregister(self, fd: int) -> None:
        """Watch *fd* no more; it may be closed already."""

    def wait(self, until_s: float) -> list[int]:
        """
        Wait, and return readable descriptors, at most EVENTS_MAX.

        Args:
            until_s: Time of the monotonic clock to return at; infinite for never, in the past to
                look only.
        """

    def close(self) -> None:
        """Free the descriptors held; touches nothing that a forked process shares."""


class TimerFd:
    """One kernel timer on CLOCK_MONOTONIC with a descriptor: os.timerfd_* where Python has them, else libc."""

    def __init__(self) -> None:
        # Through getattr: these came with Python 3.13, and not on every platform.
        create = getattr(os, "timerfd_create", None)
        self._settime_ns = getattr(os, "timerfd_settime_ns", None)
        if create is not None and self._settime_ns is not None:
            self.fd = int(create(time.CLOCK_MONOTONIC, flags=libc.TFD_NONBLOCK | libc.TFD_CLOEXEC))
        else:
            self._settime_ns = None
            self.fd = libc.timerfd_create()
        self._when = libc.Itimerspec()

    def set(self, when_s: float) -> None:
        """Let the descriptor become readable at *when_s*; beyond FAR_S for never."""
        # Zero would disarm the timer, so a time before the clock's beginning is its first moment.
        when_ns = 0 if when_s > FAR_S else max(1, math.ceil(when_s * NANOSECONDS))
        if self._settime_ns is not None:
            self._settime_ns(self.fd, flags=libc.TFD_TIMER_ABSTIME, initial=when_ns)
            return
        value = self._when.it_value
        value.tv_sec, value.tv_nsec = divmod(when_ns, NANOSECONDS)
        libc.timerfd_settime(self.fd, self._when)

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.fd)


class EpollPoller:
    """
    The poller of Linux.

    epoll's own timeout is in milliseconds; a timerfd among its descriptors wakes within tens of
    microseconds. It is set only when the deadline changes, and registered edge-triggered, so that it
    need not be read after it fired.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._timer = TimerFd()
        self._timer_fd = self._timer.fd
        self._armed_s = math.inf
        self.timer_settings = 0
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)

    def register(self, fd: int) -> None:
        """Watch *fd*; see `Poller`."""
        self._epoll.register(fd, select.EPOLLIN)

    def unregister(self, fd: int) -> None:
        """Watch *fd* no more; one that was closed has left by itself."""
        with contextlib.suppress(OSError):
            self._epoll.unregister(fd)

    def wait(self, until_s: float) -> list[int]:
        """Wait for descriptors until *until_s*; see `Poller`."""
        timeout_s = -1.0
        if until_s != self._armed_s:
            if until_s <= monotonic():
                timeout_s = 0.0
            else:
                self._timer.set(until_s)
                self.timer_settings += 1
                self._armed_s = until_s
        ready = []
        for fd, _ in self._epoll.poll(timeout_s, EVENTS_MAX):
            if fd == self._timer_fd:
                # It fired: the same deadline, should it come again, has to be set again.
                self._armed_s = math.nan
            else:
                ready.append(fd)
        return ready

    def close(self) -> None:
        """Close epoll and timer."""
        self._epoll.close()
        self._timer.close()


class SelectorPoller:
    """The portable poller: `selectors`, with its timeouts as exact as the platform has them."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self.timer_settings = 0

    def register(self, fd: int) -> None:
        """Watch *fd*; see `Poller`."""
        self._selector.register(fd, selectors.EVENT_READ)

    def unregister(self, fd: int) -> None:
        """Watch *fd* no more."""
        with contextlib.suppress(KeyError, ValueError, OSError):
            self._selector.unregister(fd)

    def wait(self, until_s: float) -> list[int]:
        """Wait for descriptors until *until_s*; see `Poller`."""
        timeout_s = min(max(0.0, until_s - monotonic()), WAIT_S_MAX)
        return [key.fd for key, _ in self._selector.select(timeout_s)[:EVENTS_MAX]]

    def close(self) -> None:
        """Close the selector."""
        self._selector.close()
