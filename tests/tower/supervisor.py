"""
The supervisor: makes a tower, keeps its boards booting, obeys its control socket, and takes it down.

One process, one loop: it waits for the control socket, for the end of a board, for its own end.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from . import cleaning, kernel, layout
from .board import EXIT_OFF, Board, BoardError, Power, kill_group, remove_group
from .console import say
from .disk import DiskError
from .faults import Scene, apply_fault
from .network import NetworkError, Switch
from .places import Places
from .specification import TowerSpec

POLL_S = 0.02
"""How often booting boards are looked at; nothing is polled while all are up."""
REQUEST_BYTES_MAX = 65_536
REQUEST_PATIENCE_S = 30.0
START_PATIENCE_S = 120.0
EXPECTED_ERRORS = (BoardError, DiskError, NetworkError, OSError)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """
    How a supervisor runs.

    Args:
        spec: The tower.
        ends_with_input: End when standard input does: a test's tower must not outlive the test.
        tell: Gets lines for people.
    """

    spec: TowerSpec
    ends_with_input: bool = False
    tell: Callable[[str], None] = say


class Supervisor:
    """
    Runs one tower. Create it in a process of its own: it changes that process's mount namespace.

    Args:
        options: See there.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._tell = options.tell
        self._selector = selectors.DefaultSelector()
        self._must_stop = False
        self._boards: dict[str, Board] = {}
        self._places: Places
        self._switch: Switch

    def run(self, on_up: Callable[[dict[str, Any]], None]) -> None:
        """
        Make the tower, call *on_up* with its state when every board is up, and keep it until told to end.

        Raises:
            BoardError: A board did not come up.
            DiskError: No disks can be made here.
            NetworkError: No network is free.
        """
        self._watch_signals()
        spec = self._options.spec
        self._places, network, lock = layout.claim(spec.network, spec.index)
        with contextlib.ExitStack() as stack:
            stack.callback(os.close, lock)
            stack.callback(os.close, cleaning.start_guardian(self._places, lock))
            stack.callback(cleaning.clean, self._places)
            self._switch = Switch(network, self._places.uplink)
            stack.callback(self._switch.close)
            kernel.unshare(kernel.CLONE_NEWNS)
            kernel.make_mounts_private()
            stack.callback(cleaning.unmount, self._places)
            groups = cleaning.mount_groups(self._places)
            self._boards = layout.make_boards(spec, self._places, network, groups)
            stack.callback(self._end_boards)
            self._listen()
            self._start_all()
            if not self._must_stop:
                on_up(self.describe())
            while not self._must_stop:
                self._step()

    def describe(self) -> dict[str, Any]:
        """Return the tower's state as plain data."""
        return {
            "tower": self._places.index,
            "pid": os.getpid(),
            "network": self._switch.network.cidr,
            "operator_address": self._switch.network.operator,
            "uplink": self._places.uplink,
            "folder": str(self._places.folder),
            "boards": {name: board.to_mapping() for name, board in self._boards.items()},
        }

    # Boots ----------------------------------------------------------------------------------------

    def _start_all(self) -> None:
        """Boot every board and wait until all are up."""
        self._boot(list(self._boards.values()))
        until_s = time.monotonic() + START_PATIENCE_S
        while not self._must_stop and any(
            board.power is not Power.ON for board in self._boards.values()
        ):
            self._step()
            ended = [name for name, board in self._boards.items() if board.power is Power.AWAY]
            if ended or time.monotonic() > until_s:
                names = ended or [n for n, b in self._boards.items() if b.power is not Power.ON]
                raise BoardError(f"{', '.join(names)}: did not boot\n{self._read_logs(names)}")

    def _boot(self, boards: list[Board]) -> None:
        """Switch boards on, together: their cables are laid by one command."""
        supplies = [(board.number, board.prepare_boot()) for board in boards]
        self._switch.plug(supplies)
        for board in boards:
            assert board.supply is not None
            condition = board.condition
            if not condition.is_link_up:
                self._switch.set_link(board.number, is_up=False)
            if condition.loss_percent:
                self._switch.set_loss(
                    board.number,
                    board.supply,
                    condition.loss_percent,
                    is_udp_alone=condition.is_loss_of_udp_alone,
                )
            self._selector.register(os.pidfd_open(board.supply), selectors.EVENT_READ, board)
            board.finish_boot()

    @property
    def _template(self) -> Path:
        return self._places.private / layout.TEMPLATE

    def _handle_end(self, board: Board, pidfd: int) -> None:
        """A board has ended: release what it had, and decide whether it comes back."""
        self._selector.unregister(pidfd)
        os.close(pidfd)
        assert board.supply is not None
        _, status = os.waitpid(board.supply, 0)
        code = os.waitstatus_to_exitcode(status)
        condition = board.condition
        board.power = Power.OFF
        try:
            self._release(board)
        except EXPECTED_ERRORS as error:
            self._give_up(board, error)
            return
        if code != EXIT_OFF and not condition.stays_off:
            delay_s = 0.0 if condition.is_reflashed else self._options.spec.boot_delay_s
            board.power = Power.AWAY
            condition.boot_due_s = time.monotonic() + delay_s
        self._tell(f"{board.name}: {board.power.value} (exit {code})")

    def _boot_again(self, board: Board) -> None:
        """Boot one board of a running tower; if it fails, the others go on."""
        try:
            if board.condition.is_reflashed:
                board.flash(self._template)
                board.condition.is_reflashed = False
            self._boot([board])
            board.condition.trouble = ""
        except EXPECTED_ERRORS as error:
            board.power = Power.OFF
            self._give_up(board, error)

    def _give_up(self, board: Board, error: Exception) -> None:
        board.condition.trouble = str(error)
        self._tell(f"{board.name}: stays off: {error}")

    def _release(self, board: Board) -> None:
        """Take away what belonged to a boot. Whatever remains is known to belong to none."""
        board.supply = None
        kill_group(board.surroundings.cgroup)
        remove_group(board.surroundings.cgroup)
        self._switch.unplug(board.number)
        board.disk.release()

    # The loop -------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Wait for the next event and handle it."""
        for key, _ in self._selector.select(self._timeout_s()):
            if isinstance(key.data, Board):
                self._handle_end(key.data, key.fd)
            else:
                key.data()
        now_s = time.monotonic()
        due = []
        for board in self._boards.values():
            if board.power is Power.BOOTING and board.is_listening:
                board.power = Power.ON
                self._tell(f"{board.name}: on ({board.address}, boot {board.boots})")
            if board.power is Power.AWAY and now_s >= board.condition.boot_due_s:
                due.append(board)
        for board in due:
            self._boot_again(board)

    def _timeout_s(self) -> float | None:
        powers = {board.power for board in self._boards.values()}
        if Power.BOOTING in powers:
            return POLL_S
        if Power.AWAY in powers:
            due_s = min(
                b.condition.boot_due_s for b in self._boards.values() if b.power is Power.AWAY
            )
            return max(0.0, due_s - time.monotonic())
        return None

    def _watch_signals(self) -> None:
        read, write = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        signal.set_wakeup_fd(write)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._stop)
        self._selector.register(read, selectors.EVENT_READ, lambda: os.read(read, 64))
        if self._options.ends_with_input:
            self._selector.register(0, selectors.EVENT_READ, self._read_input)

    def _stop(self, *_: object) -> None:
        self._must_stop = True

    def _read_input(self) -> None:
        if not os.read(0, 64):
            self._must_stop = True
            self._selector.unregister(0)

    # Control --------------------------------------------------------------------------------------

    def _listen(self) -> None:
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        server.bind(str(self._places.control))
        server.listen(16)
        self._selector.register(server, selectors.EVENT_READ, lambda: self._accept(server))

    def _accept(self, server: socket.socket) -> None:
        """Answer one request; a caller that does not ask in time, or goes away, is forgotten."""
        connection, _ = server.accept()
        with connection, contextlib.suppress(OSError):
            connection.settimeout(REQUEST_PATIENCE_S)
            with connection.makefile("rb") as lines:
                line = lines.readline(REQUEST_BYTES_MAX)
            connection.sendall(json.dumps(self._answer(line)).encode() + b"\n")

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            verb = request["verb"]
            if verb == "fault":
                self._apply(request["board"], request["fault"], request.get("argument"))
            elif verb == "stop":
                self._must_stop = True
            elif verb != "status":
                raise ValueError(f"unknown verb {verb!r}")
        except (*EXPECTED_ERRORS, ValueError, KeyError) as error:
            return {"error": str(error)}
        return self.describe()

    def _apply(self, name: str, fault: str, argument: str | None) -> None:
        board = self._boards.get(name)
        if board is None:
            raise BoardError(f"no board {name!r}; there are {', '.join(self._boards)}")
        apply_fault(fault, Scene(board=board, switch=self._switch, argument=argument))
        self._tell(f"{name}: {fault} {argument or ''}".rstrip())

    # The end --------------------------------------------------------------------------------------

    def _end_boards(self) -> None:
        """Kill every board; what they held is let go by `cleaning`, whatever fails here."""
        for board in self._boards.values():
            board.kill()
        for board in self._boards.values():
            if board.supply is not None:
                os.waitpid(board.supply, 0)
                with contextlib.suppress(*EXPECTED_ERRORS):
                    self._release(board)

    def _read_logs(self, names: list[str]) -> str:
        texts = []
        for name in names:
            with contextlib.suppress(OSError):
                log = (self._places.logs / f"{name}.log").read_text()
                texts.append(f"--- log of {name}\n{log[-2000:]}")
        return "\n".join(texts)
