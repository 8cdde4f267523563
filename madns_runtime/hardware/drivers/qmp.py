"""
QEMU's machine protocol: JSON lines over a socket, one answer per command, in order. Pure but for the socket.

Source: QEMU, docs/interop/qmp-spec.
"""

from __future__ import annotations

import json
import socket
from collections import deque
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Any, Final

from madns_runtime.errors import MachineError
from madns_runtime.timing.granted_clock import UNMEASURED_S, GrantedLimit

UNANSWERED_MAX: Final = 256
"""Commands under way; a monitor that is so far behind hangs."""
LINE_BYTES_MAX: Final = 1 << 20
READ_BYTES: Final = 65_536
ANSWER_S: Final = 2.0
"""Time for an answer, in which the emulator does not wait for a processor: they come within a few milliseconds."""

Answer = Callable[[Any], object]


class MachineMonitor:
    """
    The monitor of an emulator; nothing here waits but `wait`.

    Args:
        line: Connected to it; closed by `close`.
        processes: Returns the emulator's; that a busy machine lets them wait is no silence of theirs.
    """

    def __init__(
        self, line: socket.socket, processes: Callable[[], Iterable[int]] = lambda: ()
    ) -> None:
        self._line = line
        self._processes = processes
        line.setblocking(False)
        self._rest = b""
        self._unsent = b""
        self._waiting: deque[Answer] = deque()
        self._answered = 0
        self._judged: int | None = None
        """Number of the command whose time is measured."""
        self._is_greeted = False

    def fileno(self) -> int:
        """Return the line's descriptor."""
        return self._line.fileno()

    def begin(self, deadline_s: float) -> None:
        """
        Wait for the greeting and begin to command.

        Raises:
            MachineError: It does not greet until *deadline_s*, or is gone.
        """
        answers: list[Any] = []
        while not self._is_greeted:
            self.wait(deadline_s)
        self.command("qmp_capabilities", answers.append)
        while not answers:
            self.wait(deadline_s)

    def wait(self, deadline_s: float) -> None:
        """
        Take what comes next.

        Raises:
            MachineError: Nothing comes until *deadline_s*, or it is gone.
        """
        self._line.settimeout(max(0.001, deadline_s - monotonic()))
        try:
            data = self._line.recv(READ_BYTES)
        except TimeoutError:
            raise MachineError("the emulator's monitor does not answer") from None
        except OSError as error:
            raise MachineError(f"the emulator is gone: {error.strerror}") from None
        finally:
            self._line.setblocking(False)
        self._take(data)

    def command(self, name: str, answer: Answer, **arguments: Any) -> None:
        """
        Send a command; *answer* is called with what it returns.

        Raises:
            MachineError: Too many are unanswered, or it is gone.
        """
        if len(self._waiting) >= UNANSWERED_MAX:
            raise MachineError(f"the emulator leaves {UNANSWERED_MAX} commands unanswered")
        self._waiting.append(answer)
        line = {"execute": name, "arguments": arguments} if arguments else {"execute": name}
        self._unsent += json.dumps(line).encode() + b"\n"
        self._push()

    def poll(self) -> None:
        """
        Take all answers that have come.

        Raises:
            MachineError: A command was refused, is unanswered for too long, or the emulator is gone.
        """
        try:
            while True:
                self._take(self._line.recv(READ_BYTES))
        except BlockingIOError:
            pass
        except OSError as error:
            raise MachineError(f"the emulator is gone: {error.strerror}") from None
        self._push()
        oldest = self._answered if self._waiting else None
        if oldest != self._judged:
            self._judged = oldest
            self._limit = GrantedLimit(ANSWER_S - UNMEASURED_S, self._processes)
        elif oldest is not None and self._limit.is_over():
            raise MachineError(f"the emulator answers nothing for {ANSWER_S:g} s")

    def close(self) -> None:
        """Close the line."""
        self._line.close()

    def _push(self) -> None:
        try:
            while self._unsent:
                self._unsent = self._unsent[self._line.send(self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            raise MachineError(f"the emulator is gone: {error.strerror}") from None

    def _take(self, data: bytes) -> None:
        if not data:
            raise MachineError("the emulator is gone: its monitor is closed")
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LINE_BYTES_MAX:
            raise MachineError("the emulator's monitor sends a line without an end")
        for line in lines:
            if line.strip():
                self._take_line(line)

    def _take_line(self, line: bytes) -> None:
        try:
            message = json.loads(line)
            error = message.get("error", {}).get("desc")
        except (ValueError, AttributeError):
            raise MachineError(f"the emulator's monitor sends {line[:80]!r}") from None
        if "QMP" in message:
            self._is_greeted = True
        elif error is not None or "return" in message:
            if not self._waiting:
                raise MachineError("the emulator's monitor answers what nobody asked")
            answer = self._waiting.popleft()
            self._answered += 1
            if error is not None:
                raise MachineError(f"the emulator refuses: {error}")
            answer(message["return"])
