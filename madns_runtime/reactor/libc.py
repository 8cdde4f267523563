"""The few calls of libc that Linux offers and Python 3.11 does not, through ctypes."""

from __future__ import annotations

import ctypes
import functools
import os
import sys

IS_LINUX = sys.platform.startswith("linux")

CLOCK_MONOTONIC = 1
TFD_TIMER_ABSTIME = 1
TFD_NONBLOCK = os.O_NONBLOCK
TFD_CLOEXEC = getattr(os, "O_CLOEXEC", 0)
PR_SET_PDEATHSIG = 1
PR_SET_TIMERSLACK = 29
PR_GET_TIMERSLACK = 30
MCL_CURRENT = 1
MCL_FUTURE = 2
MCL_ONFAULT = 4


class Timespec(ctypes.Structure):
    """Struct timespec."""

    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class Itimerspec(ctypes.Structure):
    """Struct itimerspec."""

    _fields_ = (("it_interval", Timespec), ("it_value", Timespec))


@functools.cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _checked(result: int, call: str) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, f"{call}: {os.strerror(number)}")
    return result


def timerfd_create() -> int:
    """Return a new non-blocking timer descriptor on CLOCK_MONOTONIC."""
    flags = TFD_NONBLOCK | TFD_CLOEXEC
    return _checked(_libc().timerfd_create(CLOCK_MONOTONIC, flags), "timerfd_create")


def timerfd_settime(fd: int, when: Itimerspec) -> None:
    """Set a timer to an absolute time."""
    _checked(_libc().timerfd_settime(fd, TFD_TIMER_ABSTIME, ctypes.byref(when), None), "settime")


def prctl(option: int, value: int = 0) -> int:
    """
    Do an operation on the calling thread or process.

    Raises:
        OSError: The kernel refused.
    """
    # The kernel reads unsigned longs; ctypes would pass ints and leave the upper halves to chance.
    arguments = [ctypes.c_ulong(number) for number in (value, 0, 0, 0)]
    return _checked(_libc().prctl(ctypes.c_int(option), *arguments), "prctl")


def mlockall(flags: int) -> None:
    """
    Keep the process's memory from being paged out.

    Raises:
        OSError: The kernel refused.
    """
    _checked(_libc().mlockall(flags), "mlockall")
