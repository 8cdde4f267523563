"""Waiting for descriptors and one deadline: epoll with a timerfd on Linux, `selectors` elsewhere."""

from __future__ import annotations

import contextlib
import math
import os
import select
import selectors
import sys
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
REPEAT_LATER_S = 3e-6
"""A timer that repeats is set to fire so much after the first deadline ..."""
REPEAT_LATER_S_MAX = 8e-6
"""... and is set anew for one that it would miss by more, or that it would come before."""
COUNT_BYTES = 8
"""Form of what a timerfd gives to read: how often it has fired."""


class Poller(Protocol):
    """Waits for descriptors to be readable, until a deadline."""

    timer_settings: int
    """How often the kernel's timer was set; 0 without one."""
    period_s: float
    """The time from most deadlines to the next, s; 0 for none. Right or wrong, it changes nothing but what waiting costs."""

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

    def set(self, when_s: float, period_s: float = 0.0) -> None:
        """
        Let the descriptor become readable at *when_s*; beyond FAR_S for never.

        Args:
            when_s: Time of the monotonic clock, s.
            period_s: It fires again after so long, s, once what it has counted is read; 0 for once only.
        """
        # Zero would disarm the timer, so a time before the clock's beginning is its first moment.
        when_ns = 0 if when_s > FAR_S else max(1, math.ceil(when_s * NANOSECONDS))
        period_ns = round(period_s * NANOSECONDS)
        if self._settime_ns is not None:
            flags = libc.TFD_TIMER_ABSTIME
            self._settime_ns(self.fd, flags=flags, initial=when_ns, interval=period_ns)
            return
        value, interval = self._when.it_value, self._when.it_interval
        value.tv_sec, value.tv_nsec = divmod(when_ns, NANOSECONDS)
        interval.tv_sec, interval.tv_nsec = divmod(period_ns, NANOSECONDS)
        libc.timerfd_settime(self.fd, self._when)

    def count(self) -> int:
        """Return how often it has fired since it was set or asked last, and let one that repeats go on."""
        try:
            return int.from_bytes(os.read(self.fd, COUNT_BYTES), sys.byteorder)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Close the descriptor."""
        os.close(self.fd)


class EpollPoller:
    """
    The poller of Linux.

    epoll's own timeout is in milliseconds; a timerfd among its descriptors wakes within tens of
    microseconds. It is set only when the deadline changes, and registered edge-triggered, so that it
    need not be read after it fired. Where deadlines follow each other at a period, it repeats by itself: to read it
    then takes less than to set it.
    """

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._timer = TimerFd()
        self._timer_fd = self._timer.fd
        self._fires_s = math.inf
        """When the timer fires next; not a number while it is to be set first."""
        self._repeats_s = 0.0
        """The period that it was set with, s; 0 for once only."""
        self.period_s = 0.0
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
        if until_s != self._fires_s and not (
            self._repeats_s and 0.0 <= self._fires_s - until_s <= REPEAT_LATER_S_MAX
        ):
            if until_s <= monotonic():
                timeout_s = 0.0
            else:
                self._set(until_s)
        ready = []
        for fd, _ in self._epoll.poll(timeout_s, EVENTS_MAX):
            if fd == self._timer_fd:
                self._fired()
            else:
                ready.append(fd)
        return ready

    def _set(self, until_s: float) -> None:
        # In whole nanoseconds, as the kernel counts it: what is added up here for hours is what fires there.
        self._repeats_s = period_s = round(self.period_s, 9) if until_s <= FAR_S else 0.0
        self._fires_s = until_s + REPEAT_LATER_S if period_s else until_s
        self._timer.set(self._fires_s, period_s)
        self.timer_settings += 1

    def _fired(self) -> None:
        # One that fires once has to be set again even for the same deadline, should that come again.
        fired = self._timer.count() if self._repeats_s else 0
        self._fires_s = self._fires_s + fired * self._repeats_s if fired else math.nan

    def close(self) -> None:
        """Close epoll and timer."""
        self._epoll.close()
        self._timer.close()


class SelectorPoller:
    """The portable poller: `selectors`, with its timeouts as exact as the platform has them."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self.timer_settings = 0
        self.period_s = 0.0

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
