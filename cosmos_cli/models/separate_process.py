"""
Work in a process of its own: code that the operator was given may hang there, or end it, and is told for it.

The process is a fork of this one, so that nothing is imported twice; it answers in JSON. Whatever it does to
itself, the caller gets an answer or a `SeparateFailure` that says during what. What it prints is passed on to
standard error: line by line, cleaned, and within bounds.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, NoReturn

from cosmos_cli.system.bounded_process import describe_exit
from cosmos_cli.ui.console import Console
from madns_runtime.plugin import time_limit

ANSWER_BYTES_MAX: Final = 64 * 1024 * 1024
READ_BYTES: Final = 65_536
SHOWN_BYTES_MAX: Final = 65_536
"""Bytes that are shown; more is read, so that nobody waits for a reader, and left out."""
LINE_BYTES_MAX: Final = 4096
"""A longer one is shown in pieces."""
DRAINED_BYTES_MAX: Final = 2 * 1024 * 1024
"""More than a pipe holds: whoever goes on printing into it is not waited for."""
LOOK_INTERVAL_S: Final = 0.25
GRACE_S: Final = 10.0
"""Beyond the limit: who is stopped in time from within tells the line."""
REAP_S: Final = 5.0
STAGE: Final = b"S"
ANSWER: Final = b"A"
DEFECT: Final = b"D"
NO_MEMORY: Final = b"M"

Work = Callable[[Callable[[str], None]], Mapping[str, Any]]
"""Takes whom to tell what it is about to do, and returns plain values."""


class SeparateFailure(Exception):
    """The process ended without an answer, or was ended because none came; the text says during what."""


class SeparateDefect(Exception):
    """The work raised something that nobody foresaw; the text is its traceback."""


def work_separately(
    work: Work, *, limit_s: float, hear: Callable[[str], None] | None = None
) -> Mapping[str, Any]:
    """
    Do *work* in a forked process and return what it returns.

    Args:
        work: What to do. What it prints goes to standard error, cleaned and within bounds; it has no standard input.
        limit_s: For each of its stages; time in which it waits for a processor does not count.
        hear: Takes the name of each stage as it begins.

    Raises:
        SeparateFailure: There is no answer.
        SeparateDefect: It raised.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    read_fd, write_fd = os.pipe()
    heard_fd, said_fd = os.pipe()
    with warnings.catch_warnings():
        # Of threads: the child uses none of them.
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        os.close(read_fd)
        os.close(heard_fd)
        _be_child(work, write_fd, said_fd, limit_s)
    os.close(write_fd)
    os.close(said_fd)
    try:
        return _Listener(pid, read_fd, Overheard(heard_fd), limit_s, hear).answer()
    finally:
        os.close(read_fd)
        os.close(heard_fd)


class _Listener:
    """Bytes that came from the process until now."""

    def __init__(
        self,
        pid: int,
        fd: int,
        overheard: Overheard,
        limit_s: float,
        hear: Callable[[str], None] | None,
    ) -> None:
        self._pid, self._fd, self._limit_s, self._hear = pid, fd, limit_s, hear
        self._overheard = overheard
        self._stage = "it started"
        self._is_reaped = False
        self._restart()

    def _restart(self) -> None:
        self._since_s, self._waited_s = time.monotonic(), _waited_s(self._pid)

    def answer(self) -> Mapping[str, Any]:
        try:
            return self._listen()
        finally:
            self._end()
            self._overheard.finish()

    def _listen(self) -> Mapping[str, Any]:
        for kind, content in self._frames():
            if kind == STAGE:
                self._stage = content.decode(errors="replace")
                if self._hear is not None:
                    self._hear(self._stage)
                self._restart()
            elif kind == NO_MEMORY:
                raise MemoryError(self._stage)
            elif kind == DEFECT:
                raise SeparateDefect(content.decode(errors="replace"))
            else:
                value: Mapping[str, Any] = json.loads(content)
                return value
        raise SeparateFailure(f"{self._stage}: its process {self._how_it_ended()} without a word")

    def _frames(self) -> Iterator[tuple[bytes, bytes]]:
        data = bytearray()
        while True:
            while len(data) >= 9 and len(data) >= 9 + (size := int.from_bytes(data[1:9])):
                yield bytes(data[:1]), bytes(data[9 : 9 + size])
                del data[: 9 + size]
            if len(data) > ANSWER_BYTES_MAX:
                raise SeparateFailure(f"{self._stage}: it told more than {ANSWER_BYTES_MAX} bytes")
            piece = self._read()
            if not piece:
                return
            data += piece

    def _read(self) -> bytes:
        """Return what comes next; nothing when the process has ended, whoever else may hold the other end."""
        while True:
            is_over = self._has_ended()
            fds = [self._fd, *self._overheard.fds]
            ready = select.select(fds, [], [], 0 if is_over else LOOK_INTERVAL_S)[0]
            if self._fd in ready:
                return os.read(self._fd, READ_BYTES)
            if ready:
                self._overheard.read()
            if is_over:
                return b""
            passed_s = time.monotonic() - self._since_s - (_waited_s(self._pid) - self._waited_s)
            if passed_s > self._limit_s + GRACE_S:
                raise SeparateFailure(f"{self._stage}: it was not done within {self._limit_s:g} s")

    def _has_ended(self) -> bool:
        if not self._is_reaped:
            pid, self._status = os.waitpid(self._pid, os.WNOHANG)
            self._is_reaped = pid != 0
        return self._is_reaped

    def _how_it_ended(self) -> str:
        self._await_end()
        if not self._is_reaped:
            return "closed its line"
        return describe_exit(os.waitstatus_to_exitcode(self._status))

    def _end(self) -> None:
        """Leave nothing of it behind: it leads a session of its own."""
        with contextlib.suppress(OSError):
            os.killpg(self._pid, signal.SIGKILL)
        self._await_end()

    def _await_end(self) -> None:
        until_s = time.monotonic() + REAP_S
        while not self._has_ended() and time.monotonic() < until_s:
            time.sleep(0.01)


class Overheard:
    """
    The reading end of a pipe that stands for the standard output and error of a process.

    Args:
        fd: The pipe; its owner closes it.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._line = bytearray()
        self._shown_bytes = 0
        self._left_out_bytes = 0
        self._is_over = False

    @property
    def fds(self) -> list[int]:
        """Descriptors to wait for: none once all writers are gone."""
        return [] if self._is_over else [self._fd]

    def read(self) -> int:
        """Pass on what has come, and return how many bytes that were; it blocks where nothing has."""
        data = os.read(self._fd, READ_BYTES)
        self._is_over = not data
        kept = data[: SHOWN_BYTES_MAX - self._shown_bytes]
        self._shown_bytes += len(kept)
        self._left_out_bytes += len(data) - len(kept)
        *lines, rest = (bytes(self._line) + kept).split(b"\n")
        for line in lines:
            _tell(line)
        while len(rest) > LINE_BYTES_MAX:
            _tell(rest[:LINE_BYTES_MAX])
            rest = rest[LINE_BYTES_MAX:]
        self._line = bytearray(rest)
        return len(data)

    def finish(self) -> None:
        """Pass on what is left in the pipe, without waiting for more, and the last line."""
        drained_bytes = 0
        while drained_bytes < DRAINED_BYTES_MAX and select.select(self.fds, [], [], 0)[0]:
            drained_bytes += self.read()
        if self._line:
            _tell(bytes(self._line))
            self._line.clear()
        if self._left_out_bytes:
            _tell(b"... (%d more bytes were printed)" % self._left_out_bytes)


def _tell(line: bytes) -> None:
    with contextlib.suppress(OSError):  # nobody hears it: no reason to fail
        Console().say(line.decode(errors="replace").removesuffix("\r"))


def _be_child(work: Work, fd: int, said_fd: int, limit_s: float) -> NoReturn:
    code = 1
    try:
        os.setsid()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        null = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null, 0)
        os.dup2(said_fd, 1)
        os.dup2(said_fd, 2)
        os.close(said_fd)
        time_limit.set_limit(limit_s)
        answer = work(lambda stage: _send(fd, STAGE, stage.encode()))
        _flush()  # whoever has the answer waits for nothing else
        _send(fd, ANSWER, json.dumps(answer).encode())
        code = 0
    except MemoryError:
        with contextlib.suppress(OSError):
            _send(fd, NO_MEMORY, b"")
    except BaseException:  # noqa: BLE001 - the last frame of a process
        with contextlib.suppress(OSError):
            _send(fd, DEFECT, traceback.format_exc().encode(errors="replace"))
    finally:
        _flush()
        time_limit.os_exit(code)
    raise AssertionError("unreachable")


def _flush() -> None:
    """Write what is buffered; a plug-in may have put anything in the streams' places."""
    with contextlib.suppress(Exception):
        sys.stdout.flush()
    with contextlib.suppress(Exception):
        sys.stderr.flush()


def _send(fd: int, kind: bytes, content: bytes) -> None:
    data = memoryview(kind + len(content).to_bytes(8) + content)
    while data:
        data = data[os.write(fd, data) :]


def _waited_s(pid: int) -> float:
    """Return how long a process was ready to run and had no processor, s; 0 where the kernel does not say."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_bytes().split()[1]) * 1e-9
    except (OSError, ValueError, IndexError):
        return 0.0
