"""`cosmos inject`: a fault around a device of a living run."""

from __future__ import annotations

from typing import Annotated

import typer

from cosmos_cli.commands.runs import RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.launch.order_socket import order_fault
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.fault_actions import check_fault


def inject(
    run: Annotated[str, typer.Argument(metavar="RUN", help="Name, number or directory; or last.")],
    target: Annotated[
        str, typer.Argument(metavar="DEVICE", help="Its full name, such as pi22/imu.")
    ],
    action: Annotated[
        str,
        typer.Argument(
            metavar="ACTION", help="freeze, bias, noise, drop, delay, disconnect or clear."
        ),
    ],
    value: Annotated[
        float | None,
        typer.Argument(metavar="[VALUE]", help="Of bias, noise, drop (0 to 1) and delay (s)."),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Insert a fault around a device of a living run, or clear all of it.

    What the device measures is frozen, biased, noisy, dropped or late, or it is unplugged; the device itself knows
    nothing of it. Recorded in the run. Ends with 1 when the run refuses.
    """
    console = Console(json=as_json, quiet=quiet)
    try:
        check_fault(action, value)
    except ConfigurationError as error:
        raise InputError(str(error)) from None
    found = find_run(runs_root(folder), run)
    refusal = order_fault(found.path, found.name, (target, action, value))
    code = ExitCode.RUN_FAILED if refusal else ExitCode.OK
    console.data(f"{target} {action}: {f'refused: {refusal}' if refusal else 'in force'}")
    console.print_json(
        {
            "run": found.name,
            "target": target,
            "action": action,
            "value": value,
            "refusal": refusal or None,
            "exit_code": int(code),
        }
    )
    return int(code)
