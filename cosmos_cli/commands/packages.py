"""`cosmos packages`: system packages of all machines at once."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Any

import typer

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    TIMEOUT_S_MAX,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    finish,
    fleet_of,
    row_teller,
    warn_of_same,
    without_this_computer,
)
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.outcome import InOrder, Outcome, failed
from cosmos_cli.fleet.target import Target, require_root
from cosmos_cli.onboard.apt_words import PYTHON_HINT
from cosmos_cli.ui.console import WORK_GOES_ON, Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted
from madns_runtime.plain_values import first_few

PARTS = ("files", "links", "dpkg", "facts", "scratch", "system", "apt_words", "apt")
PIECE_TIMEOUT_S = 60.0
"""A sign of life comes each second; a slow card may hold one up."""
TIMEOUT_S = 1800.0
ANSWER_MARGIN_S = 60.0
"""The machine itself ends its work in time, and says so."""
ROOT_ADVICE = "leave that machine out with --limit"
NAMES_SHOWN_MAX = 5
NAME = re.compile(r"[a-z0-9][a-z0-9+.-]*[a-z0-9+.](?::[a-z0-9-]+)?(?:=[A-Za-z0-9.+:~-]+)?")
"""A package's name, perhaps with its architecture and a version; one that ends in - would be removed."""

Changed = dict[str, Any]
"""Changes and notes that the verb "packages" tells at its end."""


class Action(StrEnum):
    """Things that can be done."""

    INSTALL = "install"
    REMOVE = "remove"
    UPGRADE = "upgrade"


def packages(
    inventory: InventoryOption,
    action: Annotated[
        Action, typer.Argument(metavar="ACTION", help="What to do: install, remove or upgrade.")
    ],
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME...]", help="Packages; upgrade without one means all."),
    ] = None,
    limit: LimitOption = None,
    check: Annotated[
        bool, typer.Option("--check", help="Show what would change, and change nothing.")
    ] = False,
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout", metavar="S", min=1.0, max=TIMEOUT_S_MAX, help="Time for each machine, s."
        ),
    ] = TIMEOUT_S,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Install, remove or upgrade system packages (apt) on every machine.

    Ends with 3 when any machine failed. What a machine always needs belongs into cosmos_packages of the
    inventory; `cosmos up` installs it.
    """
    console = Console(json=json, quiet=quiet, instead=WORK_GOES_ON)
    wanted = check_names(action, names or [])
    fleet = without_this_computer(console, fleet_of(inventory, limit, forks, accept_new_host_keys))
    warn_of_same(console, fleet)
    start_s = time.monotonic()
    outcomes = _change(console, fleet, action, wanted, timeout_s=timeout_s, is_check=check)
    return finish(
        console,
        fleet,
        outcomes=outcomes,
        verdict=_verdict(outcomes, time.monotonic() - start_s, is_check=check),
        document={
            "action": action.value,
            "names": wanted,
            "is_check": check,
            "machines": [outcome.to_mapping(_mapping(outcome)) for outcome in outcomes],
            "changed": sum(_is_changed(outcome) for outcome in outcomes),
            "failed": len(failed(outcomes)),
        },
    )


def check_names(action: Action, names: Sequence[str]) -> list[str]:
    """
    Return the names, each once.

    Raises:
        InputError: There is none where one is needed, or some are no names of packages: all of them are named.
    """
    if not names and action != Action.UPGRADE:
        raise InputError(f"name the packages to {action.value}")
    wrong = [name for name in names if not NAME.fullmatch(name)]
    if wrong:
        shown = ", ".join(map(repr, wrong))
        raise InputError(
            f"expected names of Debian packages such as i2c-tools, got {shown}; {PYTHON_HINT}"
        )
    return list(dict.fromkeys(names))


def _change(
    console: Console,
    fleet: Fleet,
    action: Action,
    names: Sequence[str],
    *,
    timeout_s: float,
    is_check: bool,
) -> list[Outcome[Changed]]:
    arguments = {
        "action": action.value,
        "names": list(names),
        "is_check": is_check,
        "timeout_s": timeout_s,
    }
    in_order = InOrder(fleet.targets, row_teller(console, fleet, _words))
    return fleet.each_target(
        lambda connection: _change_one(connection, arguments), in_order, in_order.wait
    )


def _change_one(connection: Connection, arguments: dict[str, Any]) -> Changed:
    """Work on one machine; what is said meanwhile is a sign of life."""
    target, is_check = connection.target, bool(arguments["is_check"])
    last: Changed = {}
    with Helper.start(connection, PARTS) as helper:
        if not is_check:
            _require_root(helper, target)
            helper.call("lock", {"path": Layout(target.root).lock, "holder": "cosmos packages"})
        for piece in helper.pieces(
            "packages",
            arguments,
            as_root=not is_check,
            timeout_s=PIECE_TIMEOUT_S,
            whole_s=float(arguments["timeout_s"]) + ANSWER_MARGIN_S,
        ):
            last = dict(piece.value)
        if "changes" not in last:
            raise MachineFailure(FailureKind.DATA, "ended without saying what it changed")
        if is_check and last["changes"]:
            _require_root(helper, target)
            helper.call("look", as_root=True)  # what the change itself would meet: sudo's refusal
    return last


def _require_root(helper: Helper, target: Target) -> None:
    if helper.greeting["uid"] != 0:  # who is root already becomes nobody
        require_root(target, ROOT_ADVICE)


def _is_changed(outcome: Outcome[Changed]) -> bool:
    return bool(outcome.value and outcome.value["changes"])


def _words(outcome: Outcome[Changed]) -> str:
    done = outcome.value
    if done is None:
        return f"failed   {outcome.failure}"
    changes = first_few([_change_words(change) for change in done["changes"]], NAMES_SHOWN_MAX)
    status = f"changed  {changes}" if changes else "ok"
    notes = "; ".join(done["notes"])
    return f"{status}  ({notes})" if notes else status


def _change_words(change: dict[str, Any]) -> str:
    name, old, new = change["name"], change["old"], change["new"]
    if old is None:
        return f"{name} {new} (new)"
    return f"{name} {old} (removed)" if new is None else f"{name} {old} -> {new}"


def _verdict(outcomes: Sequence[Outcome[Changed]], duration_s: float, *, is_check: bool) -> str:
    count, bad = len(outcomes), len(failed(outcomes))
    changed = sum(map(_is_changed, outcomes))
    machines = counted(count, "machine")
    would = "would be " if is_check else ""
    return (
        f"{machines}: {changed} {would}changed, {count - changed - bad} ok, {bad} failed"
        f" in {duration_s:.1f} s"
    )


def _mapping(outcome: Outcome[Changed]) -> dict[str, Any]:
    done = outcome.value
    return {
        "status": "failed" if done is None else "changed" if done["changes"] else "ok",
        "changes": done["changes"] if done else [],
        "notes": done["notes"] if done else [],
    }
