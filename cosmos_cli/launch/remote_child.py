"""
The programs that a run starts on other machines: as those here, through a stream and the machine's helper.

What a machine does not answer at once is asked in the background; what was known last counts until then.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import PurePosixPath
from typing import Any

import orjson

from cosmos_cli.fleet.connection import Stream
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch.background import BackgroundTasks
from cosmos_cli.launch.child import (
    STDERR_BYTES,
    STDERR_LINES,
    RemoteProgram,
    relay_command,
    start_command,
)
from cosmos_cli.launch.events import ProcessKnown, parse_event
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.remote_line import RemoteLine
from cosmos_cli.launch.remote_stream import STARTED_ANEW, fate_of, reach_again, start_program
from cosmos_cli.launch.run_events import (
    LineBroke,
    Reattached,
    ReattachFailed,
    RunEvent,
    SignalUndelivered,
)
from cosmos_cli.system.bounded_process import describe_exit
from madns_runtime.plugin.host_calls import interrupted_call, page_path

KILL_TIMEOUT_S = 4.0
NO_STATUS = "ended, and nobody knows how"
ENDED_CUT = "ended as the connection to it broke"
SAID_CHARACTERS_MAX = 300
"""Characters shown of a last line that tells why it could not be started."""


class RemoteChild:
    """
    A program on another machine.

    Its first line of input is *launch*, which holds the run key and therefore never touches argv,
    environment or disk, there or here.

    When its line breaks it waits for another one, and `reattach` makes that.

    Args:
        program: What to start.
        machine: Where.
        background: Threads of the operator, for what may wait.
        launch: Its first line of input.
        on_line: Called with each line that it says.
        tell: Called with what becomes of the lines to it.
    """

    def __init__(  # noqa: PLR0913 - collaborators, by name
        self,
        program: RemoteProgram,
        machine: RemoteMachine,
        background: BackgroundTasks,
        *,
        launch: Mapping[str, Any],
        on_line: Callable[[bytes], None],
        tell: Callable[[RunEvent], None],
    ) -> None:
        self.name = program.name
        self._tell = tell
        self.pid: int | None = None
        self._program = program
        self._machine = machine
        self._background = background
        self._on_line = on_line
        self._may_reattach = bool(launch.get("reattach_s"))
        self._session = str(launch["session_hex"])
        self._incarnation = int(launch.get("life", 1))
        self._stream: Stream | None = None
        self._line = RemoteLine(background.selector, on_line=self._said, on_end=self._output_ended)
        self._is_relayed = False
        self._is_closed = False
        self._has_exited = False
        self.loss: str | None = None
        """Why nobody knows how it ended, if its machine was lost."""
        self._status: int | None = None
        self._no_status = NO_STATUS
        self._members: list[int] = []
        self._is_asking = False
        self._asked_s = self._known_s = time.monotonic()
        background.submit(
            partial(start_program, machine, start_command(program, machine.paths), launch),
            self._opened,
        )

    @property
    def stderr(self) -> str:
        """Place of its standard error."""
        return f"{self._machine.name}:{PurePosixPath(self._program.run_directory, self._program.stderr)}"

    def send(self, command: Mapping[str, Any]) -> None:
        """Send one object, or keep it until the program is there to take it."""
        self._line.send(command)

    def push(self) -> bool:
        """Hand over what could not be sent at once."""
        return self._line.push()

    def drain(self) -> None:
        """Listen no more: its output was read to the end before its end was known."""
        self._line.close()

    def release(self) -> None:
        """Let go of it without ending it."""
        self._is_closed = True
        self._line.close()

    def close(self) -> None:
        """Let go of its stream; a program that still reads from it ends."""
        if self._is_closed:
            return
        self.release()
        self._has_exited, self._members = True, []
        self._close_stream()

    def has_exited(self) -> bool:
        """Tell whether its leader has ended, or its machine is lost."""
        return self._has_exited

    def returncode(self) -> int | None:
        """Return how its leader ended."""
        return self._status

    def describe_exit(self) -> str:
        """Return how its leader ended, in words."""
        if not self._has_exited:
            return "is still running"
        if self.loss is not None:
            return f"was lost: {self.loss}"
        if self._status is None:
            return self._no_status
        return self._no_start() or describe_exit(self._status)

    def _no_start(self) -> str:
        """Return why it never began, as on a disk without room for its folder; empty if it did, or nothing was said."""
        said = "" if self._stream is None else self._stream.ending().errors.strip()
        if self.pid is not None or not said:
            return ""
        return f"could not be started ({said.splitlines()[-1][:SAID_CHARACTERS_MAX]})"

    def members(self) -> list[int]:
        """Return who of its group lived when that was asked last, and ask again."""
        if self.pid is not None and not self._is_asking and not self._is_closed:
            self._is_asking, self._asked_s = True, time.monotonic()
            self._ask("group", self._group(), self._answered)
        return list(self._members)

    def members_age_s(self) -> float:
        """Return how long ago the question was put that `members` told the answer to."""
        return time.monotonic() - self._known_s

    def terminate(self) -> None:
        """Close its standard input and send its whole group SIGTERM."""
        self._line.leave()
        self._signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send its whole group SIGKILL."""
        self._signal(signal.SIGKILL)

    def _signal(self, number: signal.Signals) -> None:
        """Send a signal to its whole group, through the helper there."""
        if self.pid is not None:
            self._ask("signal_group", {**self._group(), "signal": int(number)}, self._signalled)

    def end_by_force(self) -> list[int]:
        """Kill its group and wait for the machine's answer."""
        left: list[int] = []
        if self.pid is not None and self._members and self.loss is None:
            arguments = {**self._group(), "signal": int(signal.SIGKILL)}
            try:
                self._machine.ask("signal_group", arguments, timeout_s=KILL_TIMEOUT_S)
            except MachineFailure:
                left = list(self._members)
        return left

    def tell_last_words(self, tell: Callable[[list[str]], None]) -> None:
        """Fetch the last lines of its standard error, and tell them when they come."""
        path = str(PurePosixPath(self._program.run_directory, self._program.stderr))
        said = self._stream.ending().errors.splitlines() if self._stream is not None else []
        if self.loss is None:
            self._fetch_lines(
                path, STDERR_LINES, lambda lines: tell([*lines, *said][-STDERR_LINES:])
            )

    def tell_last_call(self, session_hex: str, tell: Callable[[str], None]) -> None:
        """Fetch the call in which it has ended, and tell it when it comes; its page goes with the next host there."""
        if self.loss is None:
            self._fetch_lines(
                str(page_path(session_hex)),
                1,
                lambda lines: tell(interrupted_call("".join(lines[:1]).encode())),
            )
        else:
            tell("")

    def _fetch_lines(self, path: str, count: int, tell: Callable[[list[str]], None]) -> None:
        """Fetch the last lines of a file there, and tell them when they come; none if they cannot be had."""
        arguments = {"path": path, "bytes": STDERR_BYTES, "lines": count}
        self._ask("last_words", arguments, lambda lines, _: tell(list(map(str, lines or ()))))

    # The line -------------------------------------------------------------------------------------

    def reattach(self) -> None:
        """Make a new line to it; what comes of it is told."""
        if not self._may_reattach:
            self._end(loss="the connection broke")
        if self._has_exited:
            return
        attach = {
            "command": "attach",
            "session": self._session,
            "incarnation": self._incarnation,
            "seen": self._line.seen,
        }
        task = partial(
            reach_again,
            self._machine,
            relay_command(self._program, self._incarnation, self._machine.paths),
            orjson.dumps(attach) + b"\n",
        )
        self._background.submit(task, self._reattached)

    def _opened(self, stream: Stream | None, failure: MachineFailure | None) -> None:
        if stream is None:
            self._end(loss=str(failure))
            return
        self._stream = stream
        if self._is_closed:
            self._background.submit(stream.close)
        else:
            self._line.open(stream)

    def _reattached(
        self, found: tuple[Stream, bytes] | None, failure: MachineFailure | None
    ) -> None:
        if self._is_closed or self._has_exited:
            if found is not None:
                self._background.submit(found[0].close)
        elif failure is not None and failure.text == STARTED_ANEW:
            self._end(loss=STARTED_ANEW)
        elif failure is not None:
            self._tell(ReattachFailed(self.name, str(failure)))
        elif found is None:
            self._no_status = ENDED_CUT
            self._end(loss=None)
        else:
            self._close_stream()
            self._stream, said = found
            self._is_relayed = True
            self._tell(Reattached(self.name))
            self._line.attach(self._stream, said)

    def _close_stream(self) -> None:
        if self._stream is not None:
            # A connection that is lost may take its time to close.
            self._background.submit(self._stream.close)

    def _said(self, line: bytes) -> None:
        if self.pid is None:
            event = parse_event(line)
            if isinstance(event, ProcessKnown):
                self.pid = event.pid
                self._members = [event.pid]
        self._on_line(line)

    def _output_ended(self, failure: MachineFailure | None) -> None:
        """Find out how it ended: by itself, or because its line broke."""
        stream = self._stream
        assert stream is not None
        if failure is not None:
            self._broke(failure.text)
        else:
            self._background.submit(
                partial(fate_of, stream, self._machine), partial(self._fate_known, stream)
            )

    def _fate_known(
        self, stream: Stream, fate: tuple[int | None, bool] | None, failure: Any
    ) -> None:
        if stream is not self._stream:  # the program has closed that line for another one
            return
        status, is_alive = fate or (None, False)
        if self._is_relayed and status == 0 and self._line.has_greeted:
            self._end(loss=None)  # the relay's status: nobody knows the program's own
        elif self._is_relayed or (status is None and (self._may_reattach or not is_alive)):
            self._broke("the connection broke")
        else:
            self._status = status
            self._end(loss=None)

    def _broke(self, why: str) -> None:
        if self._may_reattach and self.pid is not None:
            self._tell(LineBroke(self.name, why))
        else:
            self._end(loss=why)

    def _end(self, *, loss: str | None) -> None:
        self._has_exited = True
        self.loss = loss
        if loss is not None:
            self._members = []

    # The helper -----------------------------------------------------------------------------------

    def _ask(
        self,
        verb: str,
        arguments: Mapping[str, Any],
        on_done: Callable[[Any, MachineFailure | None], None],
    ) -> None:
        """Ask the helper in the background."""
        self._background.submit(partial(self._machine.ask, verb, arguments), on_done)

    def _group(self) -> dict[str, Any]:
        return {"group": self.pid, "directory": self._program.run_directory}

    def _answered(self, members: Sequence[int] | None, failure: MachineFailure | None) -> None:
        self._is_asking, self._known_s = False, self._asked_s
        if members is not None:
            self._members = list(members)
        elif self._has_exited:
            self._members = []  # of a machine that does not answer nothing is known

    def _signalled(self, members: Any, failure: MachineFailure | None) -> None:
        if failure is not None and self.loss is None:
            self._tell(SignalUndelivered(self._machine.name))
