"""The programs that a run starts on this machine: their command lines, environment, pipes and process groups."""

from __future__ import annotations

import os
import selectors
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.launch.channel import Channel
from cosmos_cli.launch.groups import describe_exit, living_members, signal_group

HOST_PROGRAM: tuple[str, ...] = (sys.executable, "-m", "madns_runtime.host")
AGENT_PROGRAM: tuple[str, ...] = (sys.executable, "-m", "madns_runtime.agent")
STDERR_LINES = 10
STDERR_BYTES = 8192

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


class Child:
    """
    One started program: leader of its own session, so that a terminal's Ctrl-C reaches the operator alone.

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
        self.stderr = program.stderr
        program.stderr.parent.mkdir(parents=True, exist_ok=True)
        with program.stderr.open("ab") as stderr:
            self._process = subprocess.Popen(
                list(program.arguments),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env={**os.environ, **ENVIRONMENT},
                start_new_session=True,
                close_fds=True,
                bufsize=0,
            )
        assert self._process.stdin is not None and self._process.stdout is not None
        # The channel owns duplicates, so that Popen's own file objects can be closed at once.
        fds = os.dup(self._process.stdout.fileno()), os.dup(self._process.stdin.fileno())
        self._process.stdin.close()
        self._process.stdout.close()
        self.channel = Channel(selector, fds, on_line=on_line, on_end=lambda: None)
        self.channel.send(launch)

    @property
    def pid(self) -> int:
        """The process, which is also its group's number."""
        return self._process.pid

    def returncode(self) -> int | None:
        """Return how the leader ended, negative for a signal; None while it lives."""
        return self._process.poll()

    def describe_exit(self) -> str:
        """Return how the leader ended, in words."""
        code = self.returncode()
        return "is still running" if code is None else describe_exit(code)

    def members(self) -> list[int]:
        """Return who of its group lives."""
        return living_members(self.pid)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole group."""
        signal_group(self.pid, number)

    def last_words(self) -> list[str]:
        """Return the last lines of its standard error."""
        try:
            with self.stderr.open("rb") as file:
                file.seek(max(0, self.stderr.stat().st_size - STDERR_BYTES))
                text = file.read(STDERR_BYTES).decode(errors="replace")
        except OSError:
            return []
        lines = (line for line in text.splitlines() if line.strip())
        return list(deque(lines, STDERR_LINES))
