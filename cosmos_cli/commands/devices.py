"""`cosmos devices`: kinds of devices, what hangs where, and devices that are tried and recorded without a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.commands.device_trials import Trial, record_device, test_devices
from cosmos_cli.commands.devices_calibrate import (
    CalibrationWish,
    ChannelOption,
    FieldOption,
    FromOption,
    PlaceOption,
    calibrate_device,
    calibrate_recorded,
)
from cosmos_cli.commands.devices_verify import verify_driver
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    AcceptHostKeysOption,
    ForksOption,
    LimitOption,
    SomeInventoryOption,
    fleet_of,
)
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.models.device_kinds import describe_kinds
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.inventory.devices import MachineDevice
from cosmos_cli.models.inventory_arguments import refuse_stray_limit
from cosmos_cli.ui.console import Column, Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted

SECONDS = 5.0
SECONDS_MAX = 3600.0
ACTIONS = ("test", "record", "verify", "calibrate")
KINDS = (Column("kind"), Column("what it is"), Column("parameters"))
LISTED = (Column("machine"), Column("device"), Column("kind"), Column("rate Hz", is_number=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Wish:
    """The words of the command: an action, or "" for a list, and its words and options."""

    action: str
    names: Sequence[str]
    has_inventory: bool
    parameters: Sequence[str]
    write: bool
    of_calibration: bool
    """Whether an option was given that calibration alone has."""

    def refuse_misfits(self) -> None:
        """
        Refuse words and options that belong to another action.

        Raises:
            InputError: The first that does.
        """
        if self.action and self.action not in ACTIONS:
            raise InputError(f"{self.action}: expected test, record, verify, calibrate, or nothing")
        if self.of_calibration and self.action != "calibrate":
            raise self._error("--from, --channel, --field-ut and --place are of calibrate alone")
        if self.action == "verify":
            if len(self.names) != 1 or self.has_inventory:
                raise self._error(
                    "expected one KIND or ./file.py:NAME, and no inventory: leave out -i and"
                    " COSMOS_INVENTORY"
                )
            return
        if self.parameters:
            raise self._error("--parameters is of verify alone")
        if self.action == "calibrate":
            if not self.names or self.write:
                raise self._error("expected DEVICE and no --write")
            return
        if self.action and not self.has_inventory:
            raise self._error("give the inventory that lists it with -i")
        if self.write and self.action != "test":
            raise self._error("--write is of test and verify alone")
        if self.action == "record" and len(self.names) != 2:
            raise self._error("expected NAME and DIRECTORY")
        if self.action != "record" and len(self.names) > 1:
            raise self._error(f"expected one NAME at most, got {', '.join(self.names)}")

    def _error(self, text: str) -> InputError:
        return InputError(f"devices {self.action}".rstrip() + f": {text}")


WordsArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[test [NAME] | record NAME DIRECTORY | verify KIND | calibrate DEVICE [SENSOR...]]",
        help="test: sample devices and show rate, jitter, age and errors;"
        " record: write what the kind playback plays; verify: put the driver of a kind, or ./file.py:NAME, through"
        " what befalls it in runs; calibrate: find bias and scale of gyro, accelerometer, magnetometer, step by step."
        " Else: list kinds, or with -i what hangs where.",
    ),
]
SecondsOption = Annotated[
    float,
    typer.Option("--seconds", metavar="S", min=0.1, max=SECONDS_MAX, help="How long, s."),
]
WriteOption = Annotated[
    bool,
    typer.Option(
        "--write",
        help="test: put out the safe value of outputs, where the inventory says outputs: true;"
        " verify: move outputs to their limits and back.",
    ),
]
ParametersOption = Annotated[
    list[str] | None,
    typer.Option(
        "--parameters",
        metavar="FILE|KEY=VALUE",
        help="verify: parameters of the kind; port=pty lets a pseudo-terminal stand in for a line.",
    ),
]


def devices(
    words: WordsArgument = None,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    seconds: SecondsOption = SECONDS,
    write: WriteOption = False,
    parameters: ParametersOption = None,
    from_: FromOption = None,
    channel: ChannelOption = None,
    field_ut: FieldOption = None,
    place: PlaceOption = None,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    List kinds of devices, or with -i what hangs where; try devices, or record one, without a run.

    A test ends with 1 when a device gave errors or no sample, with 3 when a machine failed; a verification with 4 when
    something does not hold; a calibration with 1 when something could not be told.
    """
    console = Console(json=json, quiet=quiet)
    action, *names = words or [""]
    _Wish(
        action=action,
        names=names,
        has_inventory=bool(inventory),
        parameters=parameters or (),
        write=write,
        of_calibration=bool(from_ or channel or place) or field_ut is not None,
    ).refuse_misfits()
    if not inventory:
        refuse_stray_limit(limit)
    if action == "verify":
        return verify_driver(console, names[0], parameters or (), write=write)
    if action == "calibrate":
        wish = CalibrationWish.of(
            names, recordings=from_ or (), channel=channel, field_ut=field_ut, place=place
        )
        if wish.recordings or not inventory:
            return calibrate_recorded(console, wish)
        fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
        return calibrate_device(console, fleet, wish, seconds)
    if not inventory:
        return _list_kinds(console)
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    if not action:
        return _list_devices(console, fleet.machines)
    name = names[0] if names else None
    trial = Trial(console=console, fleet=fleet, name=name, seconds=seconds, writes=write)
    return record_device(trial, Path(names[1])) if action == "record" else test_devices(trial)


def _list_kinds(console: Console) -> int:
    kinds = describe_kinds()
    rows = [(k["kind"], k["summary"], ", ".join(p["name"] for p in k["parameters"])) for k in kinds]
    console.table(KINDS, rows)
    for kind in kinds:
        if kind["fault"]:
            console.warn(f"{kind['kind']}: {kind['fault']}")
    console.print_json({"kinds": kinds})
    return int(ExitCode.OK)


def _list_devices(console: Console, machines: Sequence[Machine]) -> int:
    listed = [
        (machine.name, each)
        for machine in machines
        for each in machine.variables.cosmos_devices or ()
    ]
    rows = []
    for machine, each in listed:
        if isinstance(each, MachineDevice):
            rate = "" if each.rate_hz is None else f"{each.rate_hz:g}"
            rows.append((machine, each.name, each.kind, rate))
        else:
            rows.append((machine, each, "", ""))
    console.table(LISTED, rows)
    console.data(f"{counted(len(rows), 'device')} on {counted(len(machines), 'machine')}")
    told = [{"machine": row[0], "device": row[1], "kind": row[2] or None} for row in rows]
    console.print_json({"devices": told})
    return int(ExitCode.OK)
