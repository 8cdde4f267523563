"""
One board: its power, its disk, its boots.

A boot is two processes. The outer one, the "power supply", makes the namespaces and waits; the inner
one is PID 1 of the board. Either dies with the supervisor, and with PID 1 everything on the board.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import time
import traceback
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from . import kernel, setup
from .disk import UPPER, Disk
from .layer import Layer
from .network import Network
from .specification import BoardSpec

PATIENCE_S = 120.0
POLL_S = 0.01
EXIT_OFF = 3
"""PID 1's exit status after `poweroff`."""
EXIT_SETUP = 99
SSH_LISTENS = " 00000000:0016 00000000:0000 0A "
"""A line of /proc/net/tcp: something listens on port 22 of all addresses."""
NAMESPACES = (
    kernel.CLONE_NEWNET
    | kernel.CLONE_NEWNS
    | kernel.CLONE_NEWUTS
    | kernel.CLONE_NEWIPC
    | kernel.CLONE_NEWPID
)


class BoardError(Exception):
    """A board cannot do what was asked, or did not start."""


class Power(Enum):
    """What a board is doing."""

    OFF = "off"
    BOOTING = "booting"
    ON = "on"
    ENDING = "ending"  # its processes have been killed, and may live for a moment
    AWAY = "away"  # between two boots


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """
    What a board is plugged into.

    Args:
        lowers: Layers of its file system below its disk, topmost first.
        sys_layer: What is laid over /sys.
        settings_layer: What stands in for /proc/sys.
        cgroup: Its control group; made by whoever made this.
        log: Where PID 1 and sshd write.
    """

    lowers: tuple[Path, ...]
    sys_layer: Path
    settings_layer: Path
    cgroup: Path
    log: Path


@dataclass(slots=True)
class Condition:
    """What outlasts a board's boots, and what went wrong at the last."""

    is_link_up: bool = True
    loss_percent: float = 0.0
    is_loss_of_udp_alone: bool = False
    stays_off: bool = False
    is_reflashed: bool = False
    """A fresh card is put in before the next boot."""
    boot_due_s: float = 0.0
    trouble: str = ""


class Board:
    """
    One board.

    Args:
        number: Its place in the tower, from 1.
        spec: What it is.
        network: Gives its address.
        disk: Its medium.
        surroundings: What it is plugged into.
        identity: Files that tell it from other boards: content and mode by path.
    """

    def __init__(
        self,
        number: int,
        spec: BoardSpec,
        *,
        network: Network,
        disk: Disk,
        surroundings: Surroundings,
        identity: Mapping[str, tuple[str, int]],
    ) -> None:
        self.number = number
        self.spec = spec
        self.disk = disk
        self.address = network.address(number)
        self.surroundings = surroundings
        self.power = Power.OFF
        self.boots = 0
        self.boot_id = ""
        self.condition = Condition()
        self.supply: int | None = None
        self._identity = identity
        self._plugged: int | None = None

    @property
    def name(self) -> str:
        return self.spec.name

    @property
    def init(self) -> int | None:
        """PID 1 of the board, as the operator's machine counts processes."""
        if self.supply is None:
            return None
        with contextlib.suppress(OSError, IndexError):
            children = Path(f"/proc/{self.supply}/task/{self.supply}/children").read_text()
            return int(children.split()[0])
        return None

    @property
    def is_frozen(self) -> bool:
        """Whether its programs are stopped."""
        with contextlib.suppress(OSError):
            return "frozen 1" in (self.surroundings.cgroup / "cgroup.events").read_text()
        return False

    @property
    def cpu_s(self) -> float | None:
        """Processor time, s, that its programs have used since it was switched on; None while it is off."""
        with contextlib.suppress(OSError, ValueError):
            text = (self.surroundings.cgroup / "cpu.stat").read_text()
            return int(text.split("usage_usec ", 1)[1].split()[0]) / 1e6
        return None

    @property
    def is_listening(self) -> bool:
        """Whether its sshd takes connections."""
        with contextlib.suppress(OSError):
            return SSH_LISTENS in Path(f"/proc/{self.supply}/net/tcp").read_text()
        return False

    def flash(self, template: Path) -> None:
        """Put a freshly written card in: the empty *template* with this board's identity."""
        self.disk.create(template)
        self.disk.mount()
        upper = Layer(self.disk.mount_point / UPPER, self.surroundings.lowers[-1])
        for path, (text, mode) in self._identity.items():
            upper.add(path, text, mode)
        self.disk.release()

    def prepare_boot(self) -> int:
        """
        Switch on: start the power supply and return it, once its network namespace exists.

        The caller plugs the cable in and calls `finish_boot`.
        """
        self.disk.mount()
        self.boots += 1
        self.boot_id = str(uuid.uuid4())
        self.surroundings.cgroup.mkdir(exist_ok=True)
        ready_read, ready_write = os.pipe2(os.O_CLOEXEC)
        plugged_read, plugged_write = os.pipe2(os.O_CLOEXEC)
        supervisor = os.getpid()
        child = os.fork()
        if child == 0:
            os.close(ready_read)
            os.close(plugged_write)
            _guard(lambda: self._supply_power(supervisor, ready_write, plugged_read))
        os.close(ready_write)
        os.close(plugged_read)
        is_ready = os.read(ready_read, 1)  # ends with the child, whatever becomes of it
        os.close(ready_read)
        self.supply, self._plugged, self.power = child, plugged_write, Power.BOOTING
        if not is_ready:
            raise BoardError(f"{self.name}: no namespaces; see {self.surroundings.log}")
        return child

    def finish_boot(self) -> None:
        """Go on booting: the cable is there."""
        assert self._plugged is not None
        os.write(self._plugged, b"1")
        os.close(self._plugged)
        self._plugged = None

    def kill(self) -> None:
        """End every process of the board at once."""
        if self._plugged is not None:
            os.close(self._plugged)
            self._plugged = None
        kill_group(self.surroundings.cgroup)
        if self.supply is not None:
            self.power = Power.ENDING
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.supply, signal.SIGKILL)

    def freeze(self, *, is_frozen: bool) -> None:
        """Stop or continue every process of the board."""
        (self.surroundings.cgroup / "cgroup.freeze").write_text("1" if is_frozen else "0")
        wanted = f"frozen {int(is_frozen)}"
        _wait(lambda: wanted in (self.surroundings.cgroup / "cgroup.events").read_text(), wanted)

    def signal(self, number: signal.Signals) -> None:
        """Signal PID 1; see board_files/init for what it does then."""
        os.kill(self._need_init(), number)

    def run_inside(self, function: Callable[[], Any]) -> Any:
        """
        Call *function* in a process that sees the board's file system and processes, and return its value.

        Raises:
            BoardError: The board is off, or the function raised.
        """
        init = self._need_init()
        read, write = os.pipe2(os.O_CLOEXEC)
        child = os.fork()
        if child == 0:
            os.close(read)
            try:
                kernel.enter(f"/proc/{init}/ns/mnt")
                assert Path(setup.INIT).exists(), "not on the board"
                answer = {"value": function()}
            except Exception as error:  # noqa: BLE001 - it is told to the caller, whatever it is
                answer = {"error": f"{type(error).__name__}: {error}"}
            os.write(write, json.dumps(answer).encode())
            os._exit(0)
        os.close(write)
        with os.fdopen(read, "rb") as pipe:
            text = pipe.read()
        os.waitpid(child, 0)
        answer = json.loads(text or b'{"error": "the helper died"}')
        if "error" in answer:
            raise BoardError(f"{self.name}: {answer['error']}")
        return answer["value"]

    def to_mapping(self) -> dict[str, Any]:
        """Return its state as plain data."""
        return {
            "name": self.name,
            "number": self.number,
            "address": self.address,
            "arch": self.spec.arch,
            "python": self.spec.python,
            "power": self.power.value,
            "boots": self.boots,
            "boot_id": self.boot_id,
            "init": self.init,
            "is_link_up": self.condition.is_link_up,
            "is_frozen": self.is_frozen,
            "cpu_s": self.cpu_s,
            "loss_percent": self.condition.loss_percent,
            "has_disk_failed": self.disk.has_failed,
            "trouble": self.condition.trouble,
        }

    def _need_init(self) -> int:
        """Return PID 1 of a board that is up: before that it still has the operator's root directory."""
        init = self.init
        if init is None or self.power is not Power.ON:
            raise BoardError(f"{self.name} is {self.power.value}, expected it to be on")
        return init

    def _supply_power(self, supervisor: int, ready: int, plugged: int) -> None:
        """Be the power supply; ends as PID 1 does."""
        os.setsid()
        kernel.die_with_parent(supervisor)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)
        setup.keep_only_descriptors(self.surroundings.log, ready, plugged)
        kernel.unshare(NAMESPACES)
        setup.renew_clocks()
        os.write(ready, b"1")
        os.close(ready)
        if not os.read(plugged, 1):
            os._exit(EXIT_SETUP)
        kernel.raise_interface("lo")
        kernel.raise_interface("eth0", self.address)
        supply = os.getpid()
        init = os.fork()
        if init == 0:
            _guard(lambda: self._become_init(supply))
        _, status = os.waitpid(init, 0)
        os._exit(os.waitstatus_to_exitcode(status) & 0xFF)

    def _become_init(self, supply: int) -> None:
        """Build the board around this process and become its PID 1."""
        del supply  # its number is 0 as seen from here
        kernel.die_with_parent(0)
        (self.surroundings.cgroup / "cgroup.procs").write_text("0")
        kernel.unshare(kernel.CLONE_NEWCGROUP)
        setup.build_root(self.surroundings, self.disk.mount_point, self.boot_id)
        kernel.set_host_name(self.name)
        setup.execute_init()


def kill_group(cgroup: Path) -> None:
    """End everything in a control group, frozen or not."""
    with contextlib.suppress(FileNotFoundError):
        (cgroup / "cgroup.kill").write_text("1")


def remove_group(cgroup: Path) -> None:
    """Wait until a control group is empty and remove it."""

    def is_removed() -> bool:
        try:
            cgroup.rmdir()
        except FileNotFoundError:
            return True
        except OSError:
            return False
        return True

    _wait(is_removed, f"end of {cgroup.name}")


def _guard(function: Callable[[], None]) -> None:
    """Run a forked process's part; it never returns into the supervisor's code."""
    try:
        function()
    except BaseException:  # noqa: BLE001 - a forked process has nobody to raise to but its log
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(EXIT_SETUP)


def _wait(condition: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > until_s:
            raise BoardError(f"no {what} within {PATIENCE_S:g} s")
        time.sleep(POLL_S)
