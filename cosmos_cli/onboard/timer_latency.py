"""Lateness of a loop's wake-ups on a machine, measured for two seconds in a process of its own."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import math
import os
import select
import signal
import time

from cosmos_cli.onboard.request_loop import PlainValue

PATIENCE_S = 10.0
ANSWER_BYTES_MAX = 65_536
PR_SET_TIMERSLACK = 29


def wake_ups(*, count: int, rate_hz: float, policy: str, priority: int) -> dict[str, PlainValue]:
    """
    Wake up *count* times at absolute deadlines, scheduled as an agent's loop would be, and tell how late.

    The process is another one: what is asked of the kernel must not stay with this.

    Args:
        count: Of wake-ups.
        rate_hz: At which they follow each other.
        policy: normal, or auto and fifo for SCHED_FIFO where it is permitted.
        priority: Of SCHED_FIFO.

    Returns:
        "policy" granted, why FIFO was refused ("refusal"), and "p50_ms", "p99_ms", "max_ms"; these are
        null when nothing was measured.
    """
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            told = _measure(count, 1 / rate_hz, policy, priority)
            os.write(writing, json.dumps(told).encode())
        finally:
            os._exit(0)
    os.close(writing)
    try:
        is_told = select.select([reading], [], [], count / rate_hz + PATIENCE_S)[0]
        told = json.loads(os.read(reading, ANSWER_BYTES_MAX) or b"{}") if is_told else {}
    finally:
        os.close(reading)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    return {"count": count, "rate_hz": rate_hz, **(told or {"p99_ms": None})}


def _measure(count: int, period_s: float, policy: str, priority: int) -> dict[str, PlainValue]:
    refusal = "not asked for" if policy == "normal" else _ask_fifo(priority)
    _ask_timer_slack()
    gc.disable()
    lateness_s = []
    start_s = time.monotonic() + period_s
    for index in range(count):
        deadline_s = start_s + index * period_s
        delay_s = deadline_s - time.monotonic()
        if delay_s > 0:
            time.sleep(delay_s)
        lateness_s.append(time.monotonic() - deadline_s)
    lateness_s.sort()
    return {
        "policy": "fifo" if refusal is None else "normal",
        "refusal": refusal,
        "p50_ms": _rank(lateness_s, 0.5) * 1e3,
        "p99_ms": _rank(lateness_s, 0.99) * 1e3,
        "max_ms": lateness_s[-1] * 1e3,
    }


def _rank(values: list[float], share: float) -> float:
    """Return the value that *share* of the sorted values do not exceed."""
    return values[max(0, math.ceil(share * len(values)) - 1)]


def _ask_fifo(priority: int) -> str | None:
    """Return why SCHED_FIFO was refused, or None."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except (OSError, AttributeError) as error:
        return getattr(error, "strerror", None) or "not known to this system"
    return None


def _ask_timer_slack() -> None:
    """Ask for wake-ups as exact as an agent's; a small Python may lack what it takes."""
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
