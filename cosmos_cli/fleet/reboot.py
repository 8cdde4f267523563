"""One machine's reboot: asked for, and waited for until it is another boot that answers."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.fleet.connection import SMALL_BYTES_MAX, Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.target import Target, require_root
from cosmos_cli.onboard.request_loop import BOOT_ID_FILE
from madns_runtime.plain_values import first_few

PARTS = ("madns_runtime.processes", "processes", "scratch", "files", "power")
TRY_INTERVAL_S = 1.0
REFUSED_INTERVAL_S = 5.0
"""After a refused login: a machine that is starting refuses everybody, and sshd is slow to forgive."""
TRY_TIMEOUT_S = 5.0
ORDER_TIMEOUT_S = 15.0
RUNS_SHOWN_MAX = 5
ROOT_ADVICE = "leave that machine out with --limit, or reboot it by hand"
FINAL = (FailureKind.HOST_KEY_CHANGED, FailureKind.HOST_KEY_UNKNOWN)
"""Failures that more patience does not mend."""

Connect = Callable[[Target, ConnectOptions], Connection]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rebooted:
    """Outcome of a machine that could be asked."""

    boot_id: str
    back_s: float | None = None
    """Time from the order until it answered again; None when it was left alone."""
    why_not: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Rebooting:
    """Settings of a reboot."""

    timeout_s: float
    """Time until each is back."""
    own_boot_id: str
    """Boot of this computer, which is never rebooted, under whatever name it stands in the inventory."""
    is_forced: bool = False
    """Whether a living run, or another command at work there, is no reason against it."""
    options: ConnectOptions = ConnectOptions()
    connect: Connect
    claims: dict[tuple[str, str], str] = field(default_factory=dict)
    """Name in whose stead a machine is rebooted, by its boot before and after and its own name; shared by all threads."""

    def reboot(self, connection: Connection) -> Rebooted:
        """
        Reboot a machine and wait until it is back; one that another name of the inventory stands for, too, only once.

        Raises:
            MachineFailure: A run lives there, it refused, or it was not back in time.
        """
        ordered = self._order(connection)
        if isinstance(ordered, Rebooted):
            return ordered
        (boot_id, node), start_s = ordered
        connection.close()
        new_boot_id = self._wait(connection.target, boot_id, start_s + self.timeout_s)
        self._claim(new_boot_id, node, connection.target.name)
        return Rebooted(boot_id=new_boot_id, back_s=time.monotonic() - start_s)

    def _claim(self, boot_id: str, node: str, name: str) -> str:
        """Return by which name the machine is rebooted: this one, unless another came first."""
        return self.claims.setdefault((boot_id, node), name) if boot_id else name

    def _order(self, connection: Connection) -> tuple[tuple[str, str], float] | Rebooted:
        """Give the order, and return which boot is to end, and when that was; or why the machine is left alone."""
        layout = Layout(connection.target.root)
        with Helper.start(connection, PARTS) as helper:
            told = helper.call("boot", {"state": layout.state, "root": layout.root}).value
            boot_id, node = str(told["boot_id"]), str(helper.greeting["node"])
            if boot_id == self.own_boot_id:
                return Rebooted(boot_id=boot_id, why_not="it is this computer")
            if (
                first := self._claim(boot_id, node, connection.target.name)
            ) != connection.target.name:
                return Rebooted(boot_id=boot_id, why_not=same_words(first))
            if helper.greeting["uid"] != 0:  # who is root already becomes nobody
                require_root(connection.target, ROOT_ADVICE)
            if not self.is_forced:
                refuse_if_living(told["living"], told["others"])
                if told["has_root"]:
                    _take_lock(helper, layout)
            start_s = time.monotonic()
            try:
                helper.call("reboot", as_root=True, timeout_s=ORDER_TIMEOUT_S)
            except MachineFailure as failure:
                # A connection that breaks on the order is what it should be: the machine goes down.
                if failure.kind not in (FailureKind.LOST, FailureKind.TIMEOUT):
                    raise
        return (boot_id, node), start_s

    def _wait(self, target: Target, boot_id: str, until_s: float) -> str:
        """Return the new boot's name."""
        last = "it is still going down"
        pause_s = TRY_INTERVAL_S
        while (left_s := until_s - time.monotonic()) > 0:
            time.sleep(min(pause_s, left_s))
            pause_s = TRY_INTERVAL_S
            try:
                found = self._ask_boot_id(target, min(TRY_TIMEOUT_S, max(left_s, 0.1)))
                if found not in ("", boot_id):
                    return found
                last = "it answers, and has not gone down"
            except MachineFailure as failure:
                if failure.kind in FINAL:
                    raise
                if failure.kind == FailureKind.AUTHENTICATION:
                    pause_s = REFUSED_INTERVAL_S
                last = failure.text
        raise MachineFailure(
            FailureKind.TIMEOUT,
            f"not back in {self.timeout_s:g} s: {last}",
            "look at its power, its card and its console, then `cosmos ping`; a slow one needs a longer"
            " --timeout",
        )

    def _ask_boot_id(self, target: Target, timeout_s: float) -> str:
        options = ConnectOptions(
            timeout_s=timeout_s, accept_new_host_keys=self.options.accept_new_host_keys
        )
        with contextlib.closing(self.connect(target, options)) as connection:
            done = connection.run(
                f"cat {BOOT_ID_FILE}", timeout_s=timeout_s, said_bytes_max=SMALL_BYTES_MAX
            )
            # What came otherwise is the words of a shell that lets nobody in.
            is_told = done.exit_status == 0
            return done.stdout.decode(errors="replace").strip() if is_told else ""


def same_words(name: str) -> str:
    """Say why a machine is left alone that is rebooted already, by *name*."""
    return f"it is {name}, under another name"


def refuse_if_living(living: Sequence[Mapping[str, Any]], others: Sequence[str]) -> None:
    """
    Let nobody take a machine away from a run, be it of another user or another folder there.

    Raises:
        MachineFailure: BUSY, with the runs that live there.
    """
    own = sorted({str(entry["run"]) for entry in living})
    runs = [*own, *others]
    if runs:
        end = (
            "`cosmos down`" if own else "`cosmos down` with the inventory and user that started it"
        )
        raise MachineFailure(
            FailureKind.BUSY,
            f"{first_few(runs, RUNS_SHOWN_MAX)} {'lives' if len(runs) == 1 else 'live'} there",
            f"{end} ends a run; --force reboots all the same",
        )


def _take_lock(helper: Helper, layout: Layout) -> None:
    """Wait for nobody: a machine at which another command works is not rebooted."""
    try:
        helper.call("lock", {"path": layout.lock, "holder": "cosmos reboot"})
    except MachineFailure as failure:
        if failure.kind == FailureKind.BUSY:
            raise
        # A full or broken disk takes no lock; a reboot may be what it needs.
