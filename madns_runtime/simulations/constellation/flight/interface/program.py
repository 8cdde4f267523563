"""
A program of flight software: started, watched and ended without ever blocking a tick.

The kernel kills it when the agent's own process dies; what it starts itself ends with it. What it writes to its
standard error is kept, and to its standard output as well where that is not its way to the vehicle.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import monotonic
from typing import IO

from madns_runtime.errors import BlamedError
from madns_runtime.plugin.context import clean_text
from madns_runtime.reactor import libc
from madns_runtime.reactor.scheduling import die_with_parent
from madns_runtime.signal_names import signal_name
from madns_runtime.simulations.constellation.flight.programs import find_program
from madns_runtime.timing.granted_clock import GrantedClock

LAST_LINE_CHARACTERS_MAX = 200
"""Of the last line of its standard error, in the words about its end."""
READ_BYTES = 65_536
NOTHING: Mapping[str, str] = {}
END_S = 1.0
"""For a program to end by itself after its input has; and again after it was asked to by a signal."""
PATIENCE_S = 6.0
"""For all programs of this process together, whose agents end one after the other; then PATIENCE_S_MIN for each."""
PATIENCE_S_MIN = 0.1


class FlightProgram:
    """
    A running program.

    Args:
        command: Program and arguments.
        base_directory: Folder of the scenario, and the program's working directory.
        environment: Variables beside this process's own.
        has_pipes: Whether its standard input and output are the way to it.
        is_patient: Whether time in which the program waits for a processor does not count at its end.

    Raises:
        BlamedError: It cannot be started.
    """

    patience_s = PATIENCE_S
    """Rest of the wait, s."""

    def __init__(
        self,
        command: Sequence[str],
        base_directory: Path,
        *,
        environment: Mapping[str, str] = NOTHING,
        has_pipes: bool = True,
        is_patient: bool = False,
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
        reader, writer = os.pipe()
        try:
            self._process = subprocess.Popen(
                found,
                cwd=base_directory,
                env={**os.environ, **environment} if environment else None,
                stdin=subprocess.PIPE if has_pipes else subprocess.DEVNULL,
                stdout=subprocess.PIPE if has_pipes else writer,
                stderr=writer,
                bufsize=0,
                start_new_session=True,  # a terminal's Ctrl-C is the operator's
                preexec_fn=die_with_parent if libc.IS_LINUX else None,
            )
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            os.close(reader)
            raise BlamedError(f"{self.name}: cannot be started: {error}") from error
        finally:
            os.close(writer)
        self._err = _Talk(reader)
        self.pipes: tuple[int, int] | None = None
        """Descriptors of its standard output and input, if those are the way to it."""
        if self._process.stdin is not None and self._process.stdout is not None:
            self.pipes = (self._process.stdout.fileno(), self._process.stdin.fileno())

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

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

    @property
    def talk_fds(self) -> tuple[int, ...]:
        """Descriptors on which it may have talked."""
        return () if self._err.is_closed else (self._err.fd,)

    @property
    def has_exited(self) -> bool:
        """Whether it is gone."""
        return self._process.poll() is not None

    def how_it_ended(self) -> str:
        """Return how it ended, in words; waits a moment for the kernel to know."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        code = self._process.returncode
        if code is None:
            return f"closed {'its standard output' if self.pipes else 'the way to the vehicle'}"
        return f"was killed by {signal_name(-code)}" if code < 0 else f"ended with exit code {code}"

    def end(
        self,
        close_input: Callable[[], None],
        read: Callable[[], object],
        *,
        is_patient: bool = True,
    ) -> int | None:
        """
        End it: its input ends, then it is asked by SIGTERM, then killed; returns its exit code.

        Waits for at most three times END_S, and less if others have used up this process's patience; what it
        still writes meanwhile is read and kept.

        Args:
            close_input: Closes the way to it, but for its standard input, which is closed here.
            read: Reads what it says on the way to the vehicle: it may not be able to end before its words are read.
            is_patient: False kills it at once.
        """
        process = self._process

        def end_input() -> None:
            close_input()
            _close(process.stdin)

        gentle = (end_input, process.terminate) if is_patient else ()
        if not any(self._goes_by_itself(stop, read) for stop in gentle):
            self._kill_all()
            self._has_gone_within(END_S, read)
        self._kill_all()  # what it started and left behind
        self._err.read()
        _close(process.stdin)
        _close(process.stdout)
        self._err.close()
        return process.returncode

    def _goes_by_itself(self, stop: Callable[[], object], read: Callable[[], object]) -> bool:
        stop()
        limit_s = max(PATIENCE_S_MIN, min(END_S, FlightProgram.patience_s))
        return self._has_gone_within(limit_s, read)

    def _has_gone_within(self, limit_s: float, read: Callable[[], object]) -> bool:
        clock = self.stopwatch()
        deadline_s = clock() + limit_s
        try:
            while self._process.poll() is None:
                left_s = deadline_s - clock()
                if left_s <= 0.0:
                    return False
                wait_for(self.talk_fds, min(left_s, 0.02))
                read()
                self._err.read()
            self._err.read()
            return True
        finally:
            FlightProgram.patience_s -= clock()

    def stopwatch(self) -> Callable[[], float]:
        """Return what tells the time since now, s: of a patient one, but the program's waits for a processor."""
        if self._is_patient:
            return GrantedClock(lambda: (self.pid,)).now_s
        began_s = monotonic()
        return lambda: monotonic() - began_s

    def _kill_all(self) -> None:
        """Kill it and what it started: they are a group of their own."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)


def _close(stream: IO[bytes] | None) -> None:
    """Close a pipe; once more is nothing, however its descriptor's number is used by then."""
    if stream is not None:
        with contextlib.suppress(OSError):
            stream.close()


def wait_for(fds: Sequence[int], timeout_s: float) -> None:
    """Wait until one of these is readable; or until the time is over."""
    poller = select.poll()
    for fd in fds:
        poller.register(fd, select.POLLIN)
    poller.poll(max(0.0, timeout_s) * 1e3)


class _Talk:
    """A standard error: counted, its last line known, and reading never stops."""

    def __init__(self, fd: int) -> None:
        os.set_blocking(fd, False)
        self.fd = fd
        self.is_closed = False
        self._rest = b""
        """Of a line under way."""
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

    def close(self) -> None:
        """Read no more."""
        self.is_closed = True
        os.close(self.fd)

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
