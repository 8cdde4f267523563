"""
The tower as tests and the command line see it: starts a supervisor, asks it, ends it.

    with Tower(count=8) as tower:
        tower.write_inventory(path)
        tower.fault("pi03", "freeze")
"""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from .inventory import format_inventory
from .places import Places
from .specification import BoardSpec, TowerSpec, name_boards

STOP_PATIENCE_S = 150.0
ANSWER_PATIENCE_S = 150.0
POLL_S = 0.02
SSH_CONFIG_VARIABLE = "COSMOS_SSH_CONFIG"
PACKAGE_ROOT = Path(__file__).parents[1]


class TowerError(Exception):
    """A tower did not start, or refused what was asked; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardInfo:
    """A board as the operator knows it."""

    name: str
    address: str
    arch: str
    ssh_key: Path


class Tower:
    """
    A tower that lives as long as this object's `with` block, and never longer than this process.

    Args:
        count: So many alike boards, pi01, pi02, ... on this computer's own system.
        boards: Further boards, or other ones.
        boot_delay_s: Time that a rebooting board stays away before it starts again.
        disk_mib: Size of each disk.
        network: First two numbers of the /16, such as `10.77`; None takes a free one.
    """

    def __init__(
        self,
        count: int = 0,
        boards: Sequence[BoardSpec] = (),
        *,
        boot_delay_s: float = 0.5,
        disk_mib: int = 1024,
        network: str | None = None,
        index: int | None = None,
    ) -> None:
        self.spec = TowerSpec(
            boards=(*name_boards(count), *boards),
            boot_delay_s=boot_delay_s,
            disk_mib=disk_mib,
            network=network,
            index=index,
        )
        self.boards: dict[str, BoardInfo] = {}
        self.places: Places
        self.process: subprocess.Popen[bytes] | None = None
        self._key = b""
        """By which its folder is told from that of another tower, which may have the index as soon as this one is gone."""

    def __enter__(self) -> Tower:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    # Its life -------------------------------------------------------------------------------------

    def start(self) -> None:
        """
        Start it and wait until every board takes connections.

        Raises:
            TowerError: With what the supervisor said.
        """
        self.process = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.serve", json.dumps(self.spec.to_mapping())],
            cwd=PACKAGE_ROOT.parent if __package__ != "tower" else PACKAGE_ROOT,
            stdin=subprocess.PIPE,  # its end is the supervisor's: also when this process is killed
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the test runner, which then stops the tower
        )
        state = self._read_state(self.process)
        self.places = Places(state["tower"])
        self._key = self.places.key.read_bytes()
        self.boards = {
            name: BoardInfo(
                name=name, address=board["address"], arch=board["arch"], ssh_key=self.places.key
            )
            for name, board in state["boards"].items()
        }

    def stop(self) -> None:
        """Take everything down and wait until nothing is left of it."""
        if self.process is not None:
            _end(self.process)
            self.process = None
            wait_until_gone(self.places, self._key)

    def _read_state(self, process: subprocess.Popen[bytes]) -> dict[str, Any]:
        """Return what the supervisor says when it is up; if it does not come up, raise what it says then."""
        assert process.stdout is not None and process.stderr is not None
        try:
            line = process.stdout.readline()  # the supervisor's own deadlines end this wait
            if line:
                state: dict[str, Any] = json.loads(line)
                return state
            talk = process.stderr.read().decode(errors="replace")
        except BaseException:  # an impatient user's Ctrl-C, too, must not leave a tower
            _end(process)
            raise
        _end(process)
        raise TowerError(f"the tower did not start:\n{talk}")

    # What it can do -------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return what the supervisor knows now; see README.md."""
        return ask(self.places, {"verb": "status"})

    def fault(self, name: str, fault: str, argument: str | float | None = None) -> None:
        """Let something happen to a board; README.md has the list."""
        text = None if argument is None else str(argument)
        ask(self.places, {"verb": "fault", "board": name, "fault": fault, "argument": text})

    def reflash(self, *names: str) -> None:
        """Undo everything that happened to these boards, or to all: fresh disks, no fault; and wait."""
        boards = self.state()["boards"]
        for name in names or boards:
            self.fault(name, "reflash")
        for name in names or boards:
            self.wait_until_on(name, boards[name]["boots"] + 1)

    def wait_until_on(self, name: str, boots: int = 0) -> dict[str, Any]:
        """Wait until a board takes connections, in its boot number *boots* at least; return its state."""
        return self.wait_until(
            lambda board: board["power"] == "on" and board["boots"] >= boots, name, "on"
        )

    def wait_until(
        self, condition: Callable[[Mapping[str, Any]], bool], name: str, what: str
    ) -> dict[str, Any]:
        """Wait until the state of a board fulfils *condition*."""
        until_s = time.monotonic() + ANSWER_PATIENCE_S
        while True:
            board: dict[str, Any] = self.state()["boards"][name]
            if condition(board):
                return board
            if time.monotonic() > until_s:
                raise TowerError(f"{name}: not {what} in {ANSWER_PATIENCE_S:g} s: {board}")
            time.sleep(POLL_S)

    def run(
        self, name: str, command: str, *, timeout_s: float = 120.0, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """Run a command on a board as its user, by OpenSSH's own client."""
        return subprocess.run(
            ["ssh", "-F", str(self.ssh_config), "-o", "BatchMode=yes", name, command],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=check,
            stdin=subprocess.DEVNULL,
        )

    # What an operator needs -----------------------------------------------------------------------

    @property
    def address(self) -> str:
        """The operator's own address in the tower's network."""
        return f"{self.boards[next(iter(self.boards))].address.rsplit('.', 2)[0]}.0.1"

    @property
    def known_hosts(self) -> Path:
        return self.places.known_hosts

    @property
    def ssh_config(self) -> Path:
        return self.places.ssh_config

    def operator_environment(self) -> dict[str, str]:
        """Return the variables by which `cosmos` reaches the boards without anything of this user's."""
        return {SSH_CONFIG_VARIABLE: str(self.ssh_config)}

    def write_inventory(
        self,
        path: Path,
        machines: Mapping[str, Mapping[str, Any]] | None = None,
        boards: Sequence[str] | None = None,
        **variables: Any,
    ) -> Path:
        """
        Write an inventory of the boards.

        Args:
            path: Where.
            machines: Further variables of single boards, by name; or further machines.
            boards: Only these boards, in this order.
            **variables: Of the group `all`.
        """
        chosen = {name: self.boards[name].address for name in (boards or self.boards)}
        path.write_text(format_inventory(chosen, self.places.key, machines or {}, variables))
        return path


def ask(places: Places, request: Mapping[str, Any]) -> dict[str, Any]:
    """
    Send one request to a supervisor and return its answer: the tower's state.

    Raises:
        TowerError: No supervisor answers, or it refuses.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(ANSWER_PATIENCE_S)
            connection.connect(str(places.control))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as lines:
                line = lines.readline()
    except OSError as error:
        raise TowerError(f"tower {places.index} does not answer ({error}); is it up?") from error
    if not line:
        raise TowerError(f"tower {places.index} ended while it was asked")
    answer: dict[str, Any] = json.loads(line)
    if "error" in answer:
        raise TowerError(answer["error"])
    return answer


def wait_until_gone(places: Places, key: bytes = b"") -> None:
    """
    Wait until a stopped or killed tower's guardian has removed its last trace.

    Args:
        places: The tower's.
        key: Its own; without it a tower that takes the index meanwhile is waited for, too.

    Raises:
        TowerError: It is still there.
    """
    until_s = time.monotonic() + STOP_PATIENCE_S
    while places.folder.exists() and not _is_of_another(places, key):
        if time.monotonic() > until_s:
            raise TowerError(f"{places.folder} is still there; `python -m tests.tower down`")
        time.sleep(POLL_S)


def _is_of_another(places: Places, key: bytes) -> bool:
    """Tell whether a folder has the key of another tower; not while it has none, as at its begin and end."""
    with contextlib.suppress(FileNotFoundError):
        return bool(key) and places.key.read_bytes() not in (key, b"")
    return False


def _end(process: subprocess.Popen[bytes]) -> None:
    """Let a supervisor end by closing its input, or end it."""
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.close()
    try:
        process.wait(STOP_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()  # its guardian cleans up
        process.wait()
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()
