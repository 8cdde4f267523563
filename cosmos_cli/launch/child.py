"""
The programs that a run starts: those on this computer, and the shell commands for those on others.

Whatever is asked of a program here is asked of one there, too (`remote_child`).
"""

from __future__ import annotations

import os
import selectors
import shlex
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from cosmos_cli.fleet.shell import NO_PYTHON_HOME, SYSTEM_PATH, for_login_shell
from cosmos_cli.launch.channel import PipeChannel
from cosmos_cli.launch.children import GROUP_CHECK_S, KILL_WAIT_S
from cosmos_cli.launch.machines import MachinePaths
from cosmos_cli.onboard.processes import MARK
from cosmos_cli.system.bounded_process import describe_exit
from cosmos_cli.system.process_groups import living_members, signal_group
from madns_runtime.config import OPERATOR_SOCKET
from madns_runtime.plugin.host_calls import take_page
from madns_runtime.recording.access import Access, umask_of
from madns_runtime.timing.granted_clock import GrantedClock

RELAY_MODULE = "madns_runtime.reactor.relay"
HOST_PROGRAM: tuple[str, ...] = (sys.executable, "-P", "-m", "madns_runtime.host")
AGENT_PROGRAM: tuple[str, ...] = (sys.executable, "-P", "-m", "madns_runtime.agent")
STDERR_LINES = 10
STDERR_BYTES = 8192

ENVIRONMENT: Mapping[str, str] = {
    # One thread per process: numpy's own pools would contend with the loops for the processors.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "PYTHONUNBUFFERED": "1",
    "PYTHONFAULTHANDLER": "1",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ChildProgram:
    """Program to start, and the place of its standard error."""

    name: str
    arguments: Sequence[str]
    stderr: Path
    run_directory: str
    environment: Mapping[str, str] = field(default_factory=dict)
    """Variables beside those of every program."""


class LocalChild:
    """
    A program on this computer: leader of its own session, so that a terminal's Ctrl-C reaches the operator alone.

    Its first line of input is *launch*, which holds the run key and therefore never touches argv,
    environment or disk. Its standard input stays open as its life line.
    """

    def __init__(
        self,
        program: ChildProgram,
        selector: selectors.BaseSelector,
        *,
        launch: Mapping[str, Any],
        on_line: Callable[[bytes], None],
    ) -> None:
        self.name = program.name
        self.loss: str | None = None
        """Why nobody knows how it ended: never, for this computer is not lost."""
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
        self._channel = PipeChannel(selector, fds, on_line=on_line, on_end=lambda: None)
        self._channel.send(launch)

    @property
    def pid(self) -> int:
        """The process, which is also its group's number."""
        return self._process.pid

    @property
    def stderr(self) -> str:
        """Place of its standard error, for people."""
        return str(self._stderr)

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object; a child that is gone is none of the sender's business."""
        self._channel.send(command)

    def push(self) -> bool:
        """Do nothing: the selector tells when there is room."""
        return False

    def reattach(self) -> None:
        """Do nothing: a pipe does not break."""

    def drain(self) -> None:
        """Read all that has come until now, and listen no more; called when it has ended."""
        self._channel.drain()
        self._channel.close()

    def release(self) -> None:
        """Let go of it without ending it: it is detached, and its output from now on has no reader."""
        self._channel.close()
        self._process.returncode = 0  # it is not waited for: the kernel gives it another parent

    def close(self) -> None:
        """Close both directions, and reap it if it has ended; harmless when repeated."""
        self._process.poll()
        self._channel.close()

    def has_exited(self) -> bool:
        """Tell whether its leader has ended."""
        return self._process.poll() is not None

    def returncode(self) -> int | None:
        """Return how its leader ended, negative for a signal; None while it lives."""
        return self._process.poll()

    def describe_exit(self) -> str:
        """Return how its leader ended, in words."""
        code = self.returncode()
        return "is still running" if code is None else describe_exit(code)

    def members(self) -> list[int]:
        """Return who of its group lives."""
        return living_members(self.pid)

    def members_age_s(self) -> float:
        """Return how old that answer is: it is looked up as it is asked for."""
        return 0.0

    def terminate(self) -> None:
        """Close its standard input and send its whole group SIGTERM."""
        self._channel.close_writing()
        signal_group(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """Send its whole group SIGKILL."""
        signal_group(self.pid, signal.SIGKILL)

    def end_by_force(self) -> list[int]:
        """Kill its group and wait: the last resort, in a thread; returns who outlived it."""
        if not self.members():
            return []
        self.kill()
        granted = GrantedClock(self.members)  # a busy computer is late to carry it out
        while (left := self.members()) and granted.now_s() < KILL_WAIT_S:
            self._process.poll()  # reaps
            time.sleep(GROUP_CHECK_S)
        return left

    def tell_last_words(self, tell: Callable[[list[str]], None]) -> None:
        """Call *tell* with the last lines of its standard error."""
        try:
            with self._stderr.open("rb") as file:
                file.seek(max(0, self._stderr.stat().st_size - STDERR_BYTES))
                text = file.read(STDERR_BYTES).decode(errors="replace")
        except OSError:
            return
        lines = (line for line in text.splitlines() if line.strip())
        tell(list(deque(lines, STDERR_LINES)))

    def tell_last_call(self, session_hex: str, tell: Callable[[str], None]) -> None:
        """Call *tell* with the plug-in's call in which a host has ended, in words or empty."""
        tell(take_page(session_hex))


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteProgram:
    """Program to start on a machine, and its place there."""

    name: str
    module: str
    run_directory: str
    stderr: str
    """File below the run directory."""
    access: Access | None = None
    """Access to the run directory there."""


def start_command(program: RemoteProgram, paths: MachinePaths) -> str:
    """Return the shell command that starts a module there and tells its number as the first event."""
    stderr = str(PurePosixPath(program.run_directory, program.stderr))
    assignments = _assignments(paths, {MARK: program.run_directory})
    script = (
        f"{SYSTEM_PATH}{NO_PYTHON_HOME}mkdir -p {shlex.quote(str(PurePosixPath(program.run_directory).parent))}"
        f" && umask {umask_of(program.access):03o}"
        f" && mkdir -p {shlex.quote(str(PurePosixPath(stderr).parent))}"
        f" && cd {shlex.quote(paths.root)}"
        """ && echo '{"event":"process","pid":'$$'}'"""
        f" && exec env {assignments} {shlex.quote(paths.python)} -P -m {program.module}"
        f" 2>>{shlex.quote(stderr)}"
    )
    return for_login_shell(script)


def relay_command(program: RemoteProgram, incarnation: int, paths: MachinePaths) -> str:
    """Return the shell command that relays to a program there which waits for its operator."""
    directory = PurePosixPath(program.run_directory, program.stderr).parent
    relay = f"{RELAY_MODULE} {shlex.quote(str(directory))} {shlex.quote(OPERATOR_SOCKET.format(incarnation))}"
    script = (
        f"{SYSTEM_PATH}{NO_PYTHON_HOME}cd {shlex.quote(paths.root)}"
        f" && exec env {_assignments(paths, {})} {shlex.quote(paths.python)} -P -m {relay}"
    )
    return for_login_shell(script)


def _assignments(paths: MachinePaths, more: Mapping[str, str]) -> str:
    environment = {
        **ENVIRONMENT,
        **paths.variables,
        **more,
        "COSMOS_STATE_DIR": paths.state,
    }
    return " ".join(f"{name}={shlex.quote(value)}" for name, value in environment.items())
