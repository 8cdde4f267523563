"""What can go wrong with a board, on demand. Every function here is one fault of the table at the end."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from . import kernel
from .base import NO_PASSWORD_NEEDED, REPOSITORY, USER, USER_ID
from .board import Board, BoardError, Condition, Power
from .keys import generate_key
from .network import Switch
from .packages import INDEX, NEWER_INDEX
from .pretend import THERMAL

SLOW_SUDO_S = 5.0
SUDO_RULES = "/etc/pam.d/sudo"
SLOW_MARK = "# slow"
AUTHORIZED = f"/home/{USER}/.ssh/authorized_keys"
HOST_KEY = "/etc/ssh/ssh_host_ed25519_key"
OWN_KEY = f"{HOST_KEY}.own"
NO_SSHD = "/run/tower/no-sshd"
DONE = "/run/tower/done"
"""Grows by one line each time that connections were cut."""
PATIENCE_S = 120.0
READ_ONLY = kernel.MS_REMOUNT | kernel.MS_BIND | kernel.MS_RDONLY
WRITABLE = kernel.MS_REMOUNT | kernel.MS_BIND


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """Where a fault happens."""

    board: Board
    switch: Switch
    argument: str | None

    def number(self, default: float | None = None) -> float:
        """Return the argument as a number."""
        if self.argument is None and default is not None:
            return default
        try:
            return float(self.argument or "")
        except ValueError:
            raise BoardError(f"expected a number after the fault, got {self.argument!r}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One kind of fault: what it does, and the line that explains it."""

    act: Callable[[Scene], None]
    text: str
    takes: str = ""


# The cable --------------------------------------------------------------------------------------


def _set_link(scene: Scene, is_up: bool) -> None:
    scene.board.condition.is_link_up = is_up
    if scene.board.supply is not None:  # else at its next boot
        scene.switch.set_link(scene.board.number, is_up=is_up)


def _set_loss(scene: Scene, loss_percent: float, *, is_udp_alone: bool = False) -> None:
    if not 0 <= loss_percent <= 100:
        raise BoardError(f"loss: expected 0 to 100 percent, got {loss_percent:g}")
    condition = scene.board.condition
    condition.loss_percent, condition.is_loss_of_udp_alone = loss_percent, is_udp_alone
    if scene.board.supply is not None:
        scene.switch.set_loss(
            scene.board.number, scene.board.supply, loss_percent, is_udp_alone=is_udp_alone
        )


# Power ------------------------------------------------------------------------------------------


def _cut_power(scene: Scene) -> None:
    """Lose the link first: a machine without power says no goodbye to its peers."""
    board = scene.board
    if board.supply is None:
        raise BoardError(f"{board.name} is {board.power.value}, expected it to be on")
    scene.switch.set_link(board.number, is_up=False)
    board.disk.lose_power()
    board.kill()


def _power_off(scene: Scene) -> None:
    _cut_power(scene)
    scene.board.condition.stays_off = True


def _power_on(scene: Scene) -> None:
    board = scene.board
    if board.power not in (Power.OFF, Power.AWAY):
        raise BoardError(f"{board.name} is {board.power.value} already")
    board.condition.stays_off = False
    board.power = Power.AWAY  # the supervisor boots what is away when its time has come
    board.condition.boot_due_s = 0.0


def _reflash(scene: Scene) -> None:
    board = scene.board
    board.condition = Condition(is_reflashed=True)
    if board.supply is None:
        _power_on(scene)
    else:
        _cut_power(scene)


# The disk ---------------------------------------------------------------------------------------


def _make_read_only(scene: Scene) -> None:
    """Remount; where a program has files open for writing that is refused, so let the medium fail."""
    try:
        scene.board.run_inside(lambda: kernel.mount(None, "/", flags=READ_ONLY))
    except BoardError as error:
        if "busy" not in str(error):
            raise
        scene.board.disk.fail()


def _make_writable(scene: Scene) -> None:
    if scene.board.disk.has_failed:
        raise BoardError(f"{scene.board.name}: its disk has failed; `crash` or `reboot` repairs it")
    scene.board.run_inside(lambda: kernel.mount(None, "/", flags=WRITABLE))


# What runs on it --------------------------------------------------------------------------------


def _edit(scene: Scene, function: Callable[[], None]) -> None:
    scene.board.run_inside(function)


def _set_sudo(scene: Scene, is_allowed: bool) -> None:
    def act() -> None:
        path = Path("/") / NO_PASSWORD_NEEDED
        path.unlink(missing_ok=True)
        rules = Path(SUDO_RULES)
        lines = [line for line in rules.read_text().splitlines() if SLOW_MARK not in line]
        rules.write_text("\n".join(lines) + "\n")
        if is_allowed:
            path.write_text(f"{USER} ALL=(ALL) NOPASSWD: ALL\n")
            path.chmod(0o440)

    _edit(scene, act)


def _slow_sudo(scene: Scene) -> None:
    delay_s = scene.number(SLOW_SUDO_S)

    def act() -> None:
        rules = Path(SUDO_RULES)
        line = f"account optional pam_exec.so quiet /bin/sleep {delay_s:g} {SLOW_MARK}\n"
        rules.write_text(line + rules.read_text())

    _edit(scene, act)


def _set_user_key(scene: Scene, is_known: bool) -> None:
    def act() -> None:
        own = Path(f"{AUTHORIZED}.own")
        if is_known:
            if own.exists():
                own.rename(AUTHORIZED)
            return
        if not own.exists():
            Path(AUTHORIZED).rename(own)
        Path(AUTHORIZED).write_text(generate_key("stranger").public + "\n")
        os.chown(AUTHORIZED, USER_ID, USER_ID)
        os.chmod(AUTHORIZED, 0o600)

    _edit(scene, act)


def _set_host_key(scene: Scene, is_own: bool) -> None:
    def act() -> None:
        own = Path(OWN_KEY)
        if is_own:
            if own.exists():
                own.rename(HOST_KEY)
            return
        if not own.exists():
            Path(HOST_KEY).rename(own)
        Path(HOST_KEY).write_text(generate_key("changed").private)
        os.chmod(HOST_KEY, 0o600)

    _edit(scene, act)
    _ask(scene, signal.SIGHUP)


def _set_sshd(scene: Scene, is_running: bool) -> None:
    def act() -> None:
        if is_running:
            Path(NO_SSHD).unlink(missing_ok=True)
        else:
            Path(NO_SSHD).touch()

    _edit(scene, act)
    if not is_running:
        _ask(scene, signal.SIGHUP)


def _cut_connections(scene: Scene) -> None:
    _ask(scene, signal.SIGUSR1)


def _ask(scene: Scene, number: int) -> None:
    """Signal the board's first process, and return when it has done what that asks: it may have to wait for a processor."""

    def count() -> int:
        return scene.board.run_inside(lambda: len(read_lines(DONE)))  # type: ignore[no-any-return]

    before, until_s = count(), time.monotonic() + PATIENCE_S
    scene.board.signal(number)
    while count() == before:
        if time.monotonic() > until_s:
            raise BoardError(
                f"{scene.board.name}: not done in {PATIENCE_S:g} s: {signal.strsignal(number)}; is it frozen?"
            )
        time.sleep(0.02)


def read_lines(path: str) -> list[str]:
    """Return the lines of a file; none if it is not there."""
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def _write(scene: Scene, path: str, text: str) -> None:
    def act() -> None:
        Path(path).write_text(text)

    _edit(scene, act)


def _publish_update(scene: Scene) -> None:
    def act() -> None:
        repository = Path(REPOSITORY)
        (repository / INDEX).write_text((repository / NEWER_INDEX).read_text())

    _edit(scene, act)


FAULTS: dict[str, Fault] = {
    "down": Fault(act=lambda s: _set_link(s, False), text="pull the network cable"),
    "up": Fault(act=lambda s: _set_link(s, True), text="plug the cable in again"),
    "loss": Fault(
        act=lambda s: _set_loss(s, s.number()), text="lose packets, each way", takes="PERCENT"
    ),
    "udploss": Fault(
        act=lambda s: _set_loss(s, s.number(), is_udp_alone=True),
        text="lose UDP datagrams, each way; a login cannot fail by it",
        takes="PERCENT",
    ),
    "noloss": Fault(act=lambda s: _set_loss(s, 0), text="lose none"),
    "freeze": Fault(
        act=lambda s: s.board.freeze(is_frozen=True),
        text="stop every program (the kernel answers pings)",
    ),
    "thaw": Fault(act=lambda s: s.board.freeze(is_frozen=False), text="let them go on"),
    "crash": Fault(
        act=_cut_power, text="cut the power for the boot delay; what was not synced is lost"
    ),
    "poweroff": Fault(act=_power_off, text="cut the power and leave it off"),
    "poweron": Fault(act=_power_on, text="switch on again"),
    "reboot": Fault(
        act=lambda s: s.board.signal(signal.SIGTERM),
        text="reboot in good order, as `sudo reboot` does",
    ),
    "reflash": Fault(
        act=_reflash, text="undo every fault: put a freshly written card in, and boot at once"
    ),
    "fill": Fault(
        act=lambda s: s.board.disk.fill(int(s.number(0)) * 1024),
        text="fill the disk but for so many KiB",
        takes="[KIB]",
    ),
    "unfill": Fault(act=lambda s: s.board.disk.remove_ballast(), text="give the room back"),
    "ro": Fault(
        act=_make_read_only,
        text="make the disk read-only; under open files it fails as a worn card does, until the next boot",
    ),
    "rw": Fault(act=_make_writable, text="make it writable again"),
    "slow-sudo": Fault(act=_slow_sudo, text="let each sudo take so long", takes="[SECONDS]"),
    "no-sudo": Fault(act=lambda s: _set_sudo(s, False), text="let sudo ask for a password"),
    "sudo": Fault(act=lambda s: _set_sudo(s, True), text="let sudo work, quickly"),
    "wrong-key": Fault(act=lambda s: _set_user_key(s, False), text="accept only a stranger's key"),
    "right-key": Fault(act=lambda s: _set_user_key(s, True), text="accept the tower's key again"),
    "new-host-key": Fault(act=lambda s: _set_host_key(s, False), text="change its host key"),
    "own-host-key": Fault(act=lambda s: _set_host_key(s, True), text="change it back"),
    "stop-sshd": Fault(act=lambda s: _set_sshd(s, False), text="refuse new connections"),
    "start-sshd": Fault(act=lambda s: _set_sshd(s, True), text="accept them again"),
    "cut": Fault(act=_cut_connections, text="break every ssh connection it has"),
    "throttle": Fault(
        act=lambda s: _write(s, "/run/tower/throttled", f"{s.argument or '0x0'}\n"),
        text="let vcgencmd get_throttled say so",
        takes="0x50005",
    ),
    "temperature": Fault(
        act=lambda s: _write(s, f"/sys/{THERMAL}", f"{round(s.number() * 1000)}\n"),
        text="let the processor be so hot",
        takes="CELSIUS",
    ),
    "publish-update": Fault(
        act=_publish_update, text="put a newer cosmos-test-hello into its apt repository"
    ),
}


def apply_fault(name: str, scene: Scene) -> None:
    """
    Let it happen.

    Raises:
        BoardError: There is no such fault, or the board is not in a state for it.
    """
    fault = FAULTS.get(name)
    if fault is None:
        raise BoardError(f"no fault {name!r}; there are {', '.join(FAULTS)}")
    if scene.argument is not None and not fault.takes:
        raise BoardError(f"{name} takes no argument, got {scene.argument!r}")
    try:
        fault.act(scene)
    except OSError as error:
        raise BoardError(f"{scene.board.name}: {name}: {error}") from error
