"""Common parts of commands on machines: their options, and their end with what failed and how to repeat it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.failure import ELSEWHERE_NOW, MachineFailure
from cosmos_cli.fleet.fleet import Fleet, fleet_of
from cosmos_cli.fleet.outcome import Outcome, failed
from cosmos_cli.fleet.pool import FORKS_DEFAULT
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.fleet.target import same_targets
from cosmos_cli.models.inventory_arguments import refuse_stray_limit
from cosmos_cli.system.import_turn import IMPORT_TURN
from cosmos_cli.ui.console import Console
from cosmos_cli.ui.plural import counted

if TYPE_CHECKING:
    from cosmos_cli.models.inventory import Machine

__all__ = [
    "FORKS_DEFAULT",
    "TIMEOUT_S_MAX",
    "AcceptHostKeysOption",
    "Fleet",
    "ForksOption",
    "HostOption",
    "InventoryOption",
    "LimitOption",
    "PresentInventoryOption",
    "SomeInventoryOption",
    "ask_whether_moved",
    "finish",
    "fleet_of",
    "row_teller",
    "some_machines",
]

T = TypeVar("T")
TIMEOUT_S_MAX = 1e6
"""Of any --timeout, eleven days: the kernel's waits end at twenty-four."""


def _inventory_option(help_text: str) -> Any:
    return typer.Option(
        "--inventory", "-i", metavar="FILE", envvar="COSMOS_INVENTORY", help=help_text
    )


InventoryOption = Annotated[
    list[str],
    _inventory_option(
        "Inventory: a file, a folder, or machines as in pi01,pi02, (with a comma). Repeatable; the later wins."
    ),
]
SomeInventoryOption = Annotated[
    list[str] | None,
    _inventory_option(
        "Inventory (file, folder, or pi01,pi02, with a comma; repeatable):"
        " the machines to run on; default: this computer alone."
    ),
]
PresentInventoryOption = Annotated[
    list[str] | None,
    _inventory_option(
        "Inventory (repeatable) that says where a machine is by now that is not reached where it was in the run."
    ),
]
HostOption = Annotated[
    str | None,
    typer.Option(
        "--host", metavar="MACHINE", help="Machine that runs the host; default: this computer."
    ),
]
LimitOption = Annotated[
    str | None,
    typer.Option(
        "--limit",
        "-l",
        metavar="PATTERN",
        envvar="COSMOS_LIMIT",
        help="Only these machines: names, groups, globs, as in tower:!chiefs; @FILE: one on each line.",
    ),
]
ForksOption = Annotated[
    int,
    typer.Option(
        "--forks", min=1, max=500, metavar="N", envvar="COSMOS_FORKS", help="Machines at a time."
    ),
]
AcceptHostKeysOption = Annotated[
    bool,
    typer.Option(
        "--accept-new-host-keys",
        envvar="COSMOS_ACCEPT_NEW_HOST_KEYS",
        help="Record unknown host keys in known_hosts; a changed one is always refused.",
    ),
]


def some_machines(
    inventory: Sequence[str] | None, limit: str | None, host: str | None
) -> tuple[Machine, ...]:
    """
    Return the machines that a run would have: the inventory's, or this computer alone.

    Raises:
        InputError: Faults of the inventory or the pattern; or a host or a pattern, and no inventory for it.
    """
    # Imported late: most commands that have the options above never read an inventory's models.
    with IMPORT_TURN:
        from cosmos_cli.models.inventory import LOOPBACK, load_machines

    if inventory:
        return load_machines(inventory, limit)
    refuse_stray_limit(limit)
    if host is not None:
        raise InputError(
            f"--host {host}: there is no machine without an inventory; give one with -i"
        )
    return (LOOPBACK,)


def row_teller(
    console: Console, fleet: Fleet, words: Callable[[Outcome[T]], str]
) -> Callable[[Outcome[T]], None]:
    """Return a function that prints a machine's name and the *words* about its outcome, aligned with other machines."""
    width = max((len(target.name) for target in fleet.targets), default=0)

    def tell(outcome: Outcome[T]) -> None:
        console.data(f"{outcome.machine:<{width}}  {words(outcome)}")

    return tell


def ask_whether_moved(
    console: Console,
    failures: Iterable[MachineFailure | None],
    inventory: Sequence[str] | None,
    words: str,
) -> None:
    """Say how to name an inventory to a command, *words*, where machines of runs were not found and it was given none."""
    if not inventory and any(each and each.kind in ELSEWHERE_NOW for each in failures):
        console.say(f"at another address by now? cosmos {words} -i FILE")


def without_this_computer(console: Console, fleet: Fleet) -> Fleet:
    """Leave out what is reached without a connection, and tell: it is its owner's affair."""
    for target in fleet.targets:
        if target.connection == "local":
            console.say(f"{target.name}: left alone, it is this computer")
    return fleet.elsewhere()


def warn_of_same(console: Console, fleet: Fleet) -> None:
    """Tell of machines that are one, by what the inventory says: it is worked on once for each of its names."""
    for name, first in same_targets(fleet.targets).items():
        address = next(target.address for target in fleet.targets if target.name == name)
        console.say(
            f"warning: {first} and {name} are one machine, {address}, which is worked on for each: correct"
            " ansible_host, or leave one of them out (--limit)"
        )


def finish(
    console: Console,
    fleet: Fleet,
    *,
    outcomes: Sequence[Outcome[Any]],
    verdict: str,
    document: Mapping[str, Any],
) -> int:
    """
    Print the end of a command, with how to repeat it for the machines that failed.

    Args:
        console: Where it is printed.
        fleet: The machines.
        outcomes: Of all of them.
        verdict: The last line.
        document: What --json prints, but for "retry" and "exit_code".

    Returns:
        The exit code: MACHINES when any machine failed.
    """
    names = [outcome.machine for outcome in failed(outcomes)]
    exit_code = int(ExitCode.MACHINES if names else ExitCode.OK)
    retry = offer_retry(console, fleet.sources, failed=names, count=len(outcomes))
    console.data(verdict)
    console.print_json({**document, "retry": retry, "exit_code": exit_code})
    return exit_code


def where_words(answered: int) -> str:
    """Say of which machines it is known what lives there: what nobody could ask about is left out."""
    here = "on this machine"
    return f"{here} and on the {counted(answered, 'machine')} that answered" if answered else here
