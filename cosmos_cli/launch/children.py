"""The programs that a run starts: what the operator asks of each, and those on this computer."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from cosmos_cli.fleet.onboard.processes import MARK
from cosmos_cli.launch.channel import Channel
from cosmos_cli.launch.groups import describe_exit, living_members, signal_group

HOST_PROGRAM: tuple[str, ...] = (sys.executable, "-m", "madns_runtime.host")
AGENT_PROGRAM: tuple[str, ...] = (sys.executable, "-m", "madns_runtime.agent")
STDERR_LINES = 10
STDERR_BYTES = 8192
KILL_WAIT_S = 5.0
"""For the kernel to carry out a SIGKILL; a process that hangs in a device outlives it."""
GROUP_CHECK_S = 0.1

ENVIRONMENT: Mapping[str, str] = {
    # One thread a process: numpy's own pools would contend with the loops for the processors.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONUNBUFFERED": "1",
    "PYTHONFAULTHANDLER": "1",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What to start, and where its standard error goes."""

    name: str
    arguments: Sequence[str]
    stderr: Path
    run_directory: str
    environment: Mapping[str, str] = field(default_factory=dict)
    """Beyond that of every program."""


class Child(Protocol):
    """One started program, here or on another machine; none of its methods waits."""

    @property
    def name(self) -> str:
        """host, or whose agents: agents@pi07."""

    @property
    def pid(self) -> int | None:
        """The process, which is also its group's number; None while that is not known."""

    @property
    def stderr(self) -> str:
        """Where its standard error goes, for people."""

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object; a child that is gone is none of the sender's business."""

    def push(self) -> bool:
        """Hand over what could not be sent at once; True if some of it still waits."""

    def close_writing(self) -> None:
        """Close its standard input, its life line."""

    def drain(self) -> None:
        """Read all that has come until now, and listen no more; called when it has ended."""

    def release(self) -> None:
        """Let go of it without ending it: it is detached."""

    def close(self) -> None:
        """Let go of what it was spoken to by; harmless when repeated."""

    def has_exited(self) -> bool:
        """Tell whether its leader has ended."""

    def loss(self) -> str | None:
        """Return why nobody knows how it ended, if its machine was lost."""

    def returncode(self) -> int | None:
        """Return how its leader ended, negative for a signal; None while it lives, or when nobody knows."""

    def describe_exit(self) -> str:
        """Return how its leader ended, in words."""

    def members(self) -> list[int]:
        """Return who of its group lives, as far as is known."""

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole group."""

    def end_by_force(self) -> list[int]:
        """Kill its group and wait: the last resort, in a thread; returns who outlived it."""

    def tell_last_words(self, tell: Callable[[list[str]], None]) -> None:
        """Call *tell* with the last lines of its standard error, now or later."""


class LocalChild:
    """
    A program on this computer: leader of its own session, so that a terminal's Ctrl-C reaches the operator alone.

    Its first line of input is *launch*, which holds the run key and therefore never touches argv,
    environment or disk. Its standard input stays open as its life line.
    """

    def __init__(
        self,
        program: Program,
        selector: selectors.BaseSelector,
        *,
        launch: Mapping[str, Any],
        on_line: Callable[[bytes], None],
    ) -> None:
        self.name = program.name
        self._stderr = program.stderr
        program.stderr.parent.mkdir(parents=True, exist_ok=True)
        with program.stderr.open("ab") as stderr:
            self._process = subprocess.Popen(
                list(program.arguments),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env={
                    **os.environ,
                    **ENVIRONMENT,
                    **program.environment,
                    MARK: program.run_directory,
                },
                start_new_session=True,
                close_fds=True,
                bufsize=0,
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        # The channel owns duplicates, so that Popen's own file objects can be closed at once.
        fds = os.dup(self._process.stdout.fileno()), os.dup(self._process.stdin.fileno())
        self._process.stdin.close()
        self._process.stdout.close()
        self._channel = Channel(selector, fds, on_line=on_line, on_end=lambda: None)
        self._channel.send(launch)

    @property
    def pid(self) -> int:
        """The process, which is also its group's number."""
        return self._process.pid

    @property
    def stderr(self) -> str:
        """Where its standard error goes."""
        return str(self._stderr)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object."""
        self._channel.send(command)

    def push(self) -> bool:
        """Do nothing: the selector tells when there is room."""
        return False

    def close_writing(self) -> None:
        """Close its standard input."""
        self._channel.close_writing()

    def drain(self) -> None:
        """Read all that has come until now, and listen no more."""
        self._channel.drain()
        self._channel.close()

    def release(self) -> None:
        """Let go of it; its output from now on has no reader."""
        self._channel.close()
        self._process.returncode = 0  # it is not waited for: the kernel gives it another parent

    def close(self) -> None:
        """Close both directions, and reap it if it has ended."""
        self._process.poll()
        self._channel.close()

    def has_exited(self) -> bool:
        """Tell whether its leader has ended."""
        return self._process.poll() is not None

    def loss(self) -> str | None:
        """Return None: this computer is not lost."""
        return None

    def returncode(self) -> int | None:
        """Return how its leader ended."""
        return self._process.poll()

    def describe_exit(self) -> str:
        """Return how its leader ended, in words."""
        code = self.returncode()
        return "is still running" if code is None else describe_exit(code)

    def members(self) -> list[int]:
        """Return who of its group lives."""
        return living_members(self.pid)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole group."""
        signal_group(self.pid, number)

    def end_by_force(self) -> list[int]:
        """Kill its group and wait."""
        until_s = time.monotonic() + KILL_WAIT_S
        if self.members():
            self.signal(signal.SIGKILL)
        while (left := self.members()) and time.monotonic() < until_s:
            self._process.poll()  # reaps
            time.sleep(GROUP_CHECK_S)
        return left

    def tell_last_words(self, tell: Callable[[list[str]], None]) -> None:
        """Tell the last lines of its standard error."""
        try:
            with self._stderr.open("rb") as file:
                file.seek(max(0, self._stderr.stat().st_size - STDERR_BYTES))
                text = file.read(STDERR_BYTES).decode(errors="replace")
        except OSError:
            return
        lines = (line for line in text.splitlines() if line.strip())
        tell(list(deque(lines, STDERR_LINES)))
