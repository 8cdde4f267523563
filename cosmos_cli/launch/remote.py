"""
The programs that a run starts on other machines: as those here, through a stream and the machine's helper.

What a machine does not answer at once is asked in the background; what was known last counts until then.
"""

from __future__ import annotations

import shlex
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import PurePosixPath
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.onboard.processes import MARK
from cosmos_cli.launch.children import ENVIRONMENT, STDERR_BYTES, STDERR_LINES
from cosmos_cli.launch.events import ProcessKnown, parse_event
from cosmos_cli.launch.groups import describe_exit
from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.machines import Paths, RemoteMachine
from cosmos_cli.launch.stream_channel import StreamChannel

STATUS_TRIES = 10
STATUS_PAUSE_S = 0.1
"""A program's exit status comes a moment after the end of its output."""
KILL_TIMEOUT_S = 4.0
LAUNCH_TIMEOUT_S = 20.0
NO_STATUS = "ended, and nobody knows how"


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteProgram:
    """What to start, and where it lives there."""

    name: str
    module: str
    run_directory: str
    stderr: str
    """File below the run directory."""


def start_command(program: RemoteProgram, paths: Paths) -> str:
    """Return the shell command that starts a module there and tells its number as the first event."""
    stderr = str(PurePosixPath(program.run_directory, program.stderr))
    environment = {
        **ENVIRONMENT,
        **paths.variables,
        MARK: program.run_directory,
        "COSMOS_STATE_DIR": paths.state,
        "PYTHONPYCACHEPREFIX": Layout(paths.root).compiled,
    }
    assignments = " ".join(f"{name}={shlex.quote(value)}" for name, value in environment.items())
    script = (
        f"mkdir -p {shlex.quote(str(PurePosixPath(stderr).parent))}"
        f" && cd {shlex.quote(paths.root)}"
        """ && echo '{"event":"process","pid":'$$'}'"""
        f" && exec env {assignments} {shlex.quote(paths.python)} -P -m {program.module}"
        f" 2>>{shlex.quote(stderr)}"
    )
    return f"exec /bin/sh -c {shlex.quote(script)}"


class RemoteChild:
    """
    A program on another machine.

    Its first line of input is *launch*, which holds the run key and therefore never touches argv,
    environment or disk, there or here.

    Args:
        program: What to start.
        machine: Where.
        loop: The operator's.
        launch: Its first line of input.
        on_line: Called with each line that it says.
        on_unreachable: Called with the reason when a signal could not be brought to it.
    """

    def __init__(  # noqa: PLR0913 - collaborators, by name
        self,
        program: RemoteProgram,
        machine: RemoteMachine,
        loop: Loop,
        *,
        launch: Mapping[str, Any],
        on_line: Callable[[bytes], None],
        on_unreachable: Callable[[str], None],
    ) -> None:
        self.name = program.name
        self._on_unreachable = on_unreachable
        self.pid: int | None = None
        self._program = program
        self._machine = machine
        self._loop = loop
        self._on_line = on_line
        self._waiting: list[Mapping[str, Any]] = []
        self._stream: Stream | None = None
        self._channel: StreamChannel | None = None
        self._is_closed = False
        self._has_exited = False
        self._loss: str | None = None
        self._status: int | None = None
        self._members: list[int] = []
        self._is_asking = False
        command = start_command(program, machine.paths)
        loop.background.submit(partial(_start, machine, command, launch), self._opened)

    @property
    def stderr(self) -> str:
        """Where its standard error goes."""
        return f"{self._machine.name}:{PurePosixPath(self._program.run_directory, self._program.stderr)}"

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object, or keep it until the program is there to take it."""
        if self._channel is not None:
            self._channel.send(command)
        elif not self._is_closed:
            self._waiting.append(command)

    def push(self) -> bool:
        """Hand over what could not be sent at once."""
        if self._channel is None or not self._channel.has_unsent:
            return False
        self._channel.push()
        return self._channel.has_unsent

    def close_writing(self) -> None:
        """Close its standard input."""
        if self._channel is not None:
            self._channel.close_writing()

    def drain(self) -> None:
        """Listen no more: its output was read to the end before its end was known."""
        if self._channel is not None:
            self._channel.close()

    def release(self) -> None:
        """Let go of it without ending it."""
        self._is_closed = True
        if self._channel is not None:
            self._channel.close()

    def close(self) -> None:
        """Let go of its stream; a program that still reads from it ends."""
        if self._is_closed:
            return
        self.release()
        self._has_exited, self._members = True, []
        if self._stream is not None:
            # A connection that is lost may take its time to close.
            self._loop.background.submit(self._stream.close)

    def has_exited(self) -> bool:
        """Tell whether its leader has ended, or its machine is lost."""
        return self._has_exited

    def loss(self) -> str | None:
        """Return why nobody knows how it ended."""
        return self._loss

    def returncode(self) -> int | None:
        """Return how its leader ended."""
        return self._status

    def describe_exit(self) -> str:
        """Return how its leader ended, in words."""
        if not self._has_exited:
            return "is still running"
        if self._loss is not None:
            return f"was lost: {self._loss}"
        return NO_STATUS if self._status is None else describe_exit(self._status)

    def members(self) -> list[int]:
        """Return who of its group lived when that was asked last, and ask again."""
        if self.pid is not None and not self._is_asking and not self._is_closed:
            self._is_asking = True
            ask = partial(self._machine.ask, "group", self._group())
            self._loop.background.submit(ask, self._answered)
        return list(self._members)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole group, through the helper there."""
        if self.pid is not None:
            arguments = {**self._group(), "signal": int(number)}
            ask = partial(self._machine.ask, "signal_group", arguments)
            self._loop.background.submit(ask, self._signalled)

    def end_by_force(self) -> list[int]:
        """Kill its group and wait for the machine's answer."""
        left: list[int] = []
        if self.pid is not None and self._members and self._loss is None:
            arguments = {**self._group(), "signal": int(signal.SIGKILL)}
            try:
                self._machine.ask("signal_group", arguments, timeout_s=KILL_TIMEOUT_S)
            except MachineFailure:
                left = list(self._members)
        return left

    def tell_last_words(self, tell: Callable[[list[str]], None]) -> None:
        """Fetch the last lines of its standard error, and tell them when they come."""
        path = str(PurePosixPath(self._program.run_directory, self._program.stderr))
        arguments = {"path": path, "bytes": STDERR_BYTES, "lines": STDERR_LINES}
        said = self._stream.errors().splitlines() if self._stream is not None else []

        def answered(lines: Any, failure: MachineFailure | None) -> None:
            tell([*(lines or []), *said][-STDERR_LINES:])

        if self._loss is None:
            self._loop.background.submit(
                partial(self._machine.ask, "last_words", arguments), answered
            )

    # The stream -----------------------------------------------------------------------------------

    def _opened(self, stream: Stream | None, failure: MachineFailure | None) -> None:
        if stream is None:
            self._end(loss=str(failure))
            return
        self._stream = stream
        if self._is_closed:
            self._loop.background.submit(stream.close)
            return
        self._channel = StreamChannel(
            self._loop.selector, stream, on_line=self._line, on_end=self._output_ended
        )
        for command in self._waiting:
            self._channel.send(command)
        self._waiting.clear()

    def _line(self, line: bytes) -> None:
        if self.pid is None:
            event = parse_event(line)
            if isinstance(event, ProcessKnown):
                self.pid = event.pid
                self._members = [event.pid]
                return
        self._on_line(line)

    def _output_ended(self) -> None:
        """Find out how it ended: by itself, or because its machine is lost."""
        stream = self._stream
        assert stream is not None and self._channel is not None
        if self._channel.failure is not None:
            self._end(loss=self._channel.failure.text)
            return
        self._loop.background.submit(partial(_fate, stream, self._machine), self._fate_known)

    def _fate_known(self, fate: tuple[int | None, bool] | None, failure: Any) -> None:
        status, is_alive = fate or (None, False)
        self._status = status
        self._end(loss=None if status is not None or is_alive else "the connection broke")

    def _end(self, *, loss: str | None) -> None:
        self._has_exited = True
        self._loss = loss
        if loss is not None:
            self._members = []

    # The helper -----------------------------------------------------------------------------------

    def _group(self) -> dict[str, Any]:
        return {"group": self.pid, "directory": self._program.run_directory}

    def _answered(self, members: Sequence[int] | None, failure: MachineFailure | None) -> None:
        self._is_asking = False
        if members is not None:
            self._members = list(members)
        elif self._has_exited:
            self._members = []  # of a machine that does not answer nothing is known

    def _signalled(self, members: Any, failure: MachineFailure | None) -> None:
        if failure is not None and self._loss is None:
            self._on_unreachable(failure.text)


def _start(machine: RemoteMachine, command: str, launch: Mapping[str, Any]) -> Stream:
    """Start a program there and hand over its launch line, which may be long."""
    stream = machine.open(command)
    try:
        stream.write_all(orjson.dumps(launch) + b"\n", timeout_s=LAUNCH_TIMEOUT_S)
    except MachineFailure as failure:
        if failure.kind is not FailureKind.LOST:  # of one that has ended, its output tells why
            stream.close()
            raise
    return stream


def _fate(stream: Stream, machine: RemoteMachine) -> tuple[int | None, bool]:
    """Return the exit status of a program whose output has ended, and whether its machine answers."""
    for _ in range(STATUS_TRIES):
        status = stream.exit_status()
        if status is not None:
            return status, True
        if not machine.is_alive():
            return None, False
        time.sleep(STATUS_PAUSE_S)
    return None, True
