"""`cosmos bench floor`: the least lateness and the least UDP round trip of machines, and of this computer."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Annotated

import typer

from cosmos_cli.bench.floor import COLUMNS, RATES_HZ, Told, measure_floor, questions, rows_of
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    LimitOption,
    SomeInventoryOption,
    fleet_of,
)
from cosmos_cli.doctor.finding import HERE
from cosmos_cli.doctor.probe import Responder
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.local import LocalConnection, this_computer
from cosmos_cli.fleet.outcome import Outcome, failed, failure_teller
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory_arguments import refuse_stray_limit
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted

SECONDS_DEFAULT = 5.0
SECONDS_MAX = 60.0


def floor(
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    seconds: Annotated[
        float,
        typer.Option(
            "--seconds", metavar="S", min=0.1, max=SECONDS_MAX, help="Of each measurement, s."
        ),
    ] = SECONDS_DEFAULT,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Measure how late a bare loop wakes up, and how long a bare datagram takes there and back.

    At 100 Hz and 1 kHz, without and with SCHED_FIFO, on this computer and with -i on machines; from machines
    also to this computer and back. Ends with 3 when machines failed.
    """
    console = Console(json=json, quiet=quiet)
    if not inventory:
        refuse_stray_limit(limit)
    fleet = (
        fleet_of(inventory, limit, forks, accept_new_host_keys).elsewhere() if inventory else None
    )
    start_s = time.monotonic()
    lasts_s = seconds * len(questions(has_network=fleet is not None))
    console.say(f"{len(RATES_HZ)} rates, with and without SCHED_FIFO: about {lasts_s:.0f} s each")
    outcomes = [_measure_here(seconds, console)]
    if fleet and fleet.targets:
        with contextlib.ExitStack() as opened:
            responder = opened.enter_context(Responder())

            def task(connection: Connection, machine: Machine) -> list[Told]:
                return measure_floor(
                    connection, seconds, responder=responder, machine=machine, say=console.say
                )

            outcomes += fleet.each(task, failure_teller(console.say))
    rows = [row for each in outcomes for row in rows_of(each.machine, each.value or ())]
    rows += [
        (each.machine, "", f"failed: {each.failure}", *[""] * (len(COLUMNS) - 3))
        for each in failed(outcomes)
    ]
    console.table(COLUMNS, rows)
    lacking = [each.machine for each in outcomes if each.failure or _not_made([each])]
    exit_code = ExitCode.MACHINES if lacking else ExitCode.OK
    retry = None
    if fleet:
        names = [name for name in lacking if name != HERE]
        retry = offer_retry(console, fleet.sources, failed=names, count=len(fleet.targets))
    console.data(_verdict(outcomes, time.monotonic() - start_s))
    console.print_json(
        {
            "machines": [each.to_mapping({"floor": each.value}) for each in outcomes],
            "seconds": seconds,
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _measure_here(seconds: float, console: Console) -> Outcome[list[Told]]:
    """Measure this computer alone, before it has to answer machines."""
    return for_each(
        [this_computer(HERE)],
        lambda target: measure_floor(LocalConnection(target), seconds, say=console.say),
    )[0]


def _verdict(outcomes: Sequence[Outcome[list[Told]]], duration_s: float) -> str:
    bad = len(failed(outcomes))
    refused = sum(
        any(told["refusal"] for told in each.value) for each in outcomes if each.value is not None
    )
    parts = [f"{counted(len(outcomes) - bad, 'machine')} measured"]
    parts += [f"{bad} failed"] if bad else []
    missing = _not_made(outcomes)
    parts += [f"{counted(missing, 'measurement')} not made"] if missing else []
    parts += [f"SCHED_FIFO refused on {refused}"] if refused else []
    return f"{', '.join(parts)} in {duration_s:.1f} s"


def _not_made(outcomes: Sequence[Outcome[list[Told]]]) -> int:
    """Return how many measurements failed on machines that answered; one that SCHED_FIFO was refused for did not."""
    return sum(bool(told["error"]) for each in outcomes for told in each.value or ())
