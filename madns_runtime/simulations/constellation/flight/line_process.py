"""
A program that speaks lines: started, written to and read from without ever blocking.

The pipes end when either side does, so that neither outlives the other for long; the kernel kills the
program when the agent's own process dies. What it starts itself ends with it.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.context import clean_text
from madns_runtime.reactor import libc
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.simulations.constellation.flight.programs import find_program
from madns_runtime.timing.granted_clock import GrantedClock

LINE_BYTES_MAX = 262_144
"""Of one line; a longer one is no answer."""
LAST_LINE_CHARACTERS_MAX = 200
"""Of the last line of its standard error, in the words about its end."""
WAITING_BYTES_MAX = 1_048_576
"""Written, but not taken by the program yet."""
READ_BYTES = 65_536
END_S = 1.0
"""For a program to end by itself after its input has; and again after it was asked to by a signal."""
PATIENCE_S = 6.0
"""For all programs of this process together, whose agents end one after the other; then PATIENCE_S_MIN for each."""
PATIENCE_S_MIN = 0.1


class LineProcess:
    """
    A running program.

    Args:
        command: Program and arguments.
        base_directory: Folder of the scenario, and the program's working directory.
        is_patient: Whether time in which the program waits for a processor does not count at its end.

    Raises:
        BlamedError: It cannot be started.
    """

    patience_s = PATIENCE_S
    """Rest of the wait, s."""

    def __init__(
        self, command: Sequence[str], base_directory: Path, *, is_patient: bool = False
    ) -> None:
        self.name = command[0]
        self._is_patient = is_patient
        found = find_program(command, base_directory)
        if found is None:
            raise BlamedError(
                f"{self.name}: expected an executable program in {base_directory} or on PATH"
            )
        if libc.IS_LINUX:
            with contextlib.suppress(OSError):
                libc.prctl(libc.PR_GET_TIMERSLACK)  # loads libc now, not between fork and exec
        try:
            self._process = subprocess.Popen(
                found,
                cwd=base_directory,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,  # a terminal's Ctrl-C is the operator's
                preexec_fn=die_with_parent if libc.IS_LINUX else None,
            )
        except (OSError, subprocess.SubprocessError) as error:
            raise BlamedError(f"{self.name}: cannot be started: {error}") from error
        assert self._process.stdin and self._process.stdout and self._process.stderr
        self._in = self._process.stdin.fileno()
        self._out = _Lines(self._process.stdout.fileno())
        self._err = _Talk(self._process.stderr.fileno())
        os.set_blocking(self._in, False)
        self._waiting = bytearray()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def write(self, line: bytes) -> bool:
        """Send a line, as soon as the program takes it; False if too much waits already."""
        if len(self._waiting) + len(line) > WAITING_BYTES_MAX:
            return False
        self._waiting += line
        self._waiting += b"\n"
        self._push()
        return True

    def lines(self) -> list[bytes]:
        """
        Return the lines that it has written by now; never waits.

        Raises:
            BlamedError: A line has no end.
        """
        self._push()
        self._out.read()
        if self._out.is_overlong:
            raise BlamedError(f"{self.name}: expected lines of at most {LINE_BYTES_MAX} bytes")
        return self._out.take()

    def talk(self) -> bytes:
        """Return what is new of its standard error; never waits."""
        self._err.read()
        return self._err.take()

    @property
    def talk_counts(self) -> tuple[int, int]:
        """Lines and bytes of its standard error."""
        return self._err.lines, self._err.bytes

    @property
    def last_line(self) -> str:
        """The last line of its standard error that is not empty, cut; an empty text if there was none."""
        return clean_text(self._err.last_line.decode("utf-8", "replace"))

    def wait(self, timeout_s: float) -> None:
        """Wait until it writes, ends, or talks; or until the time is over."""
        poller = select.poll()
        for stream in (self._out, self._err):
            if not stream.is_closed:
                poller.register(stream.fd, select.POLLIN)
        if self._waiting:
            poller.register(self._in, select.POLLOUT)
        poller.poll(max(0.0, timeout_s) * 1e3)

    @property
    def has_ended(self) -> bool:
        """Whether it writes no more."""
        return self._out.is_closed

    def how_it_ended(self) -> str:
        """Return how it ended, in words; waits a moment for the kernel to know."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        code = self._process.returncode
        if code is None:
            return "closed its standard output"
        return f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"

    def end(self, *, is_patient: bool = True) -> int | None:
        """
        End it: its input ends, then it is asked by SIGTERM, then killed; returns its exit code.

        Waits for at most three times END_S, and less if others have used up this process's patience; what it
        still writes meanwhile is read and kept.

        Args:
            is_patient: False kills it at once.
        """
        process = self._process
        gentle = (self._close_input, process.terminate) if is_patient else ()
        if not any(self._goes_by_itself(stop) for stop in gentle):
            self._kill_all()
            self._has_gone_within(END_S)
        self._kill_all()  # what it started and left behind
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()
        return process.returncode

    def _goes_by_itself(self, stop: Callable[[], object]) -> bool:
        stop()
        return self._has_gone_within(max(PATIENCE_S_MIN, min(END_S, LineProcess.patience_s)))

    def _has_gone_within(self, limit_s: float) -> bool:
        clock = self.stopwatch()
        try:
            return self._is_gone_by(clock, clock() + limit_s)
        finally:
            LineProcess.patience_s -= clock()

    def stopwatch(self) -> Callable[[], float]:
        """Return what tells the time since now, s: of a patient one, but the program's waits for a processor."""
        if self._is_patient:
            return GrantedClock(lambda: (self.pid,)).now_s
        began_s = monotonic()
        return lambda: monotonic() - began_s

    def _is_gone_by(self, clock: Callable[[], float], deadline_s: float) -> bool:
        while self._process.poll() is None:
            left_s = deadline_s - clock()
            if left_s <= 0.0:
                return False
            # It may not be able to end before its words are read.
            self.wait(min(left_s, 0.02))
            self._out.read()
            self._err.read()
        self._err.read()
        return True

    def _close_input(self) -> None:
        self._waiting.clear()
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def _kill_all(self) -> None:
        """Kill it and what it started: they are a group of their own."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def _push(self) -> None:
        while self._waiting:
            try:
                written = os.write(self._in, memoryview(self._waiting)[:READ_BYTES])
            except BlockingIOError:
                return
            except OSError:  # it is gone, which `has_ended` tells
                self._waiting.clear()
                return
            del self._waiting[:written]


class _Pipe:
    """One end of a pipe that is read without waiting."""

    def __init__(self, fd: int) -> None:
        os.set_blocking(fd, False)
        self.fd = fd
        self.is_closed = False
        self._rest = b""
        """Of a line under way."""


class _Lines(_Pipe):
    """Lines from a pipe, bounded: more than LINES_MAX that nobody takes are read later."""

    LINES_MAX = 4096

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        self._found: list[bytes] = []

    @property
    def is_overlong(self) -> bool:
        """Whether the line under way is too long to be one."""
        return len(self._rest) > LINE_BYTES_MAX

    def read(self) -> None:
        """Read what is there, a bounded amount of it."""
        if self.is_closed or self.is_overlong or len(self._found) > self.LINES_MAX:
            return
        data = _read(self.fd)
        if data is None:
            return
        if not data:
            self.is_closed = True
            data = b"\n" if self._rest else b""
        *lines, self._rest = (self._rest + data).split(b"\n")
        self._found += lines

    def take(self) -> list[bytes]:
        """Return the lines found and forget them."""
        lines, self._found = self._found, []
        return lines


class _Talk(_Pipe):
    """A standard error: counted, its last line known, and reading never stops."""

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        self.lines = self.bytes = 0
        self.last_line = b""
        self._found = bytearray()

    def read(self) -> None:
        """Read what is there, a bounded amount of it."""
        if self.is_closed:
            return
        data = _read(self.fd)
        if data is None:
            return
        self._found += data
        self.bytes += len(data)
        if not data:
            self.is_closed = True
            data = b"\n" if self._rest else b""
        self.lines += data.count(b"\n")
        *lines, rest = (self._rest + data).split(b"\n")
        told = next((line for line in reversed(lines) if line.strip()), None)
        if told is not None:
            self.last_line = told[:LAST_LINE_CHARACTERS_MAX]
        self._rest = rest[:LAST_LINE_CHARACTERS_MAX]

    def take(self) -> bytes:
        """Return what has come since the last call."""
        data, self._found = bytes(self._found), bytearray()
        return data


def _read(fd: int) -> bytes | None:
    """Return what is there; None for nothing yet, nothing for no more."""
    try:
        return os.read(fd, READ_BYTES)
    except BlockingIOError:
        return None
    except OSError:
        return b""
