"""
Child processes that never outlive their parent: a pipe whose end is felt, and the kernel's death signal.

The parent holds the only write end of a child's life pipe; when it is closed, by `stop` or by the parent's
death, the child reads the end of file and ends in good order. Processes forked later would inherit that
write end, so a hook closes it in them.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import orjson

from madns_runtime.reactor import libc

REPORT_BYTES_MAX = 32_768
"""A report must fit a pipe, so that writing it never waits for a reader."""
_KILL_WAIT_S = 2.0
WAIT_S_MAX = 86_400.0
"""Longest wait at once: the system takes none of a month."""


class Lifeline:
    """The child's end: tells when it is time to end."""

    def __init__(self, life_fd: int, signal_fd: int) -> None:
        self._poll = select.poll()
        self._poll.register(life_fd, select.POLLIN)
        self._poll.register(signal_fd, select.POLLIN)

    def has_ended(self, wait_s: float = 0.0) -> bool:
        """Wait up to *wait_s*, and return whether the parent is gone or has said stop."""
        left_s = max(0.0, wait_s)
        while left_s > WAIT_S_MAX:
            if self._poll.poll(WAIT_S_MAX * 1e3):
                return True
            left_s -= WAIT_S_MAX
        return bool(self._poll.poll(left_s * 1e3))


ChildMain = Callable[[Lifeline], Mapping[str, Any]]
"""Function that a child runs; returns its report, plain mappings and scalars."""


class ChildProcess:
    """The parent's end of a child process."""

    def __init__(self, pid: int, life_fd: int, report_fd: int) -> None:
        self.pid = pid
        self._life_fd = life_fd
        self._report_fd = report_fd
        self._report: Mapping[str, Any] | None = None
        _children.add(self)

    def stop(self) -> None:
        """Tell the child to end; returns at once."""
        if self._life_fd >= 0:
            os.close(self._life_fd)
            self._life_fd = -1

    def wait(self, timeout_s: float) -> Mapping[str, Any]:
        """
        Wait until the child has ended, and return its report.

        One that takes longer than *timeout_s* is killed, and the report says so under "errors".
        """
        if self._report is None:
            self.stop()
            # The report pipe ends with the child: no period, no signal handler.
            text = _read_to_end(self._report_fd, timeout_s)
            has_ended = text is not None
            if not has_ended:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)
                has_ended = _read_to_end(self._report_fd, _KILL_WAIT_S) is not None
            with contextlib.suppress(ChildProcessError):
                # One that even SIGKILL does not end hangs in the kernel; it is left to whoever reaps us.
                os.waitpid(self.pid, 0 if has_ended else os.WNOHANG)
            os.close(self._report_fd)
            self._report_fd = -1
            self._report = _parse_report(self.pid, text, timeout_s)
        return self._report

    def forget(self) -> None:
        """Let go of the pipes, in a process that was forked later: this child is not its own."""
        for fd in (self._life_fd, self._report_fd):
            if fd >= 0:
                os.close(fd)
        self._life_fd = self._report_fd = -1
        self._report = {}


_children: weakref.WeakSet[ChildProcess] = weakref.WeakSet()


def _forget_children() -> None:
    for child in tuple(_children):
        child.forget()
    _children.clear()


os.register_at_fork(after_in_child=_forget_children)


def fork_child(main: ChildMain, *, nice: int = 0) -> ChildProcess:
    """
    Fork a process that runs *main* and ends with this one.

    Call it before threads are started. The child ignores SIGINT (a terminal sends it to all; the parent
    decides), ends in good order on SIGTERM, leaves SCHED_FIFO, and reads nothing from standard input.

    Args:
        main: What the child does; it must look at its lifeline often.
        nice: Added to the niceness.
    """
    life_read, life_write = os.pipe()
    report_read, report_write = os.pipe()
    parent = os.getpid()
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        os.close(life_read)
        os.close(report_write)
        return ChildProcess(pid, life_write, report_read)
    code = 1
    try:
        os.close(life_write)
        os.close(report_read)
        lifeline = Lifeline(life_read, _prepare(parent, nice))
        report = orjson.dumps(main(lifeline))
        if len(report) > REPORT_BYTES_MAX:
            raise ValueError(
                f"expected a report of at most {REPORT_BYTES_MAX} B, got {len(report)}"
            )
        os.write(report_write, report)
        code = 0
    except Exception as error:  # noqa: BLE001 - the child's only way to say what befell it
        text = f"{type(error).__name__}: {error}"[:1000]
        os.write(report_write, orjson.dumps({"errors": [text]}))
    finally:
        # Nothing of the parent's may run here: no exit handlers, no flushing of its files.
        os._exit(code)


def _prepare(parent: int, nice: int) -> int:
    """Set the forked process up and return the descriptor that becomes readable on SIGTERM."""
    signal.set_wakeup_fd(-1)
    signal_read, signal_write = os.pipe()
    os.set_blocking(signal_write, False)
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.set_wakeup_fd(signal_write, warn_on_full_buffer=False)
    # SIGTERM, not SIGKILL: a sampler closes its records even when nobody is left to ask for it. Where the
    # kernel has no such signal, the life pipe is what remains.
    with contextlib.suppress(OSError, AttributeError):
        libc.prctl(libc.PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(1)
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    if nice:
        os.nice(nice)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    return signal_read


def _read_to_end(fd: int, timeout_s: float) -> bytes | None:
    """Return all that a pipe gives until it ends, or None if it has not ended in time."""
    poll = select.poll()
    poll.register(fd, select.POLLIN)
    pieces: list[bytes] = []
    while poll.poll(timeout_s * 1e3):
        piece = os.read(fd, 65_536)
        if not piece:
            return b"".join(pieces)
        pieces.append(piece)
    return None


def _parse_report(pid: int, text: bytes | None, timeout_s: float) -> Mapping[str, Any]:
    if text is None:
        return {"errors": [f"process {pid} had to be killed: no end in {timeout_s:g} s"]}
    try:
        report = orjson.loads(text)
    except orjson.JSONDecodeError:
        return {"errors": [f"process {pid} died without a report"]}
    return report if isinstance(report, dict) else {}
