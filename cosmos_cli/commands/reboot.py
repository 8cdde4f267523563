"""`cosmos reboot`: reboot machines, and say of each when it is back."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from cosmos_cli.commands.fleet_command import (
    TIMEOUT_S_MAX,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    finish,
    fleet_of,
    without_this_computer,
)
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.outcome import Outcome, failed
from cosmos_cli.fleet.reboot import Rebooted, Rebooting, same_words
from cosmos_cli.fleet.target import same_targets
from cosmos_cli.ui.console import WORK_GOES_ON, Console, JsonOption, QuietOption, confirm
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.processes import read_boot_id

FORKS_DEFAULT = 100
"""All at once: there is nothing to do here but wait."""
TIMEOUT_S = 180.0


def reboot(
    inventory: InventoryOption,
    limit: LimitOption = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Also machines where a run lives, or a command works.")
    ] = False,
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout",
            metavar="S",
            min=1.0,
            max=TIMEOUT_S_MAX,
            help="Until a machine must be back, s.",
        ),
    ] = TIMEOUT_S,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Reboot machines and wait until each is really back: another boot that answers.

    This computer is never rebooted. Ends with 3 when any machine failed or was not back in time.
    """
    console = Console(json=json, quiet=quiet, instead=WORK_GOES_ON)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    own = [target.name for target in fleet.targets if target.connection == "local"]
    fleet = without_this_computer(console, fleet)
    if fleet.targets and not yes:
        _ask(fleet)
    start_s = time.monotonic()
    outcomes = _reboot(console, fleet, timeout_s, is_forced=force)
    return finish(
        console,
        fleet,
        outcomes=outcomes,
        verdict=_verdict(outcomes, time.monotonic() - start_s),
        document={"machines": [_mapping(outcome) for outcome in outcomes], "left_alone": own},
    )


def _ask(fleet: Fleet) -> None:
    """
    Have a person agree.

    Raises:
        InputError: There is none to ask.
        typer.Abort: The answer is no.
    """
    names = compact(target.name for target in fleet.targets)
    what = f"reboot {counted(len(fleet.targets), 'machine')} ({names})"
    if not sys.stdin.isatty():
        raise InputError(f"{what}: nobody is there to ask; give --yes")
    if not confirm(f"{what}?", is_sure=False):
        raise typer.Abort


def _reboot(
    console: Console, fleet: Fleet, timeout_s: float, *, is_forced: bool
) -> list[Outcome[Rebooted]]:
    if not fleet.targets:
        return []
    rebooting = Rebooting(
        timeout_s=timeout_s,
        own_boot_id=read_boot_id(),
        is_forced=is_forced,
        options=fleet.options,
        connect=connect,
    )
    width = max(len(target.name) for target in fleet.targets)

    def tell(outcome: Outcome[Rebooted]) -> None:
        console.data(f"{outcome.machine:<{width}}  {_words(outcome)}")

    same = same_targets(fleet.targets)  # while it goes down, a second login there would fail
    once = tuple(target for target in fleet.targets if target.name not in same)
    done = dataclasses.replace(fleet, targets=once).each_target(rebooting.reboot, tell)
    outcomes = {outcome.machine: outcome for outcome in done}
    for name, first in same.items():
        left_alone = Rebooted(boot_id="", why_not=same_words(first))
        outcomes[name] = Outcome(machine=name, value=left_alone)
        tell(outcomes[name])
    return [outcomes[target.name] for target in fleet.targets]


def _words(outcome: Outcome[Rebooted]) -> str:
    done = outcome.value
    if done is None:
        return f"failed  {outcome.failure}"
    if done.back_s is None:
        return f"left alone: {done.why_not}"
    return f"back after {done.back_s:.1f} s"


def _verdict(outcomes: Sequence[Outcome[Rebooted]], duration_s: float) -> str:
    back = sum(bool(o.value and o.value.back_s is not None) for o in outcomes)
    bad = len(failed(outcomes))
    left_alone = len(outcomes) - back - bad
    parts = [f"{back} back"]
    parts += [f"{left_alone} left alone"] if left_alone else []
    parts += [f"{bad} failed"] if bad else []
    return f"{counted(len(outcomes), 'machine')}: {', '.join(parts)} in {duration_s:.1f} s"


def _mapping(outcome: Outcome[Rebooted]) -> dict[str, Any]:
    done = outcome.value
    back_s = done.back_s if done else None
    status = "failed" if done is None else "left_alone" if back_s is None else "back"
    return outcome.to_mapping(
        {
            "status": status,
            "back_s": None if back_s is None else round(back_s, 2),
            "boot_id": (done.boot_id or None) if done else None,
        }
    )
