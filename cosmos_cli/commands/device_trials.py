"""`cosmos devices test` and `record`: devices that are driven without a run, here and on other machines."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.outcome import Outcome, raise_if_failed
from cosmos_cli.launch.device_sampling import (
    chosen_devices,
    launch_of,
    missing_for,
    record,
    sample_here,
)
from cosmos_cli.launch.remote_sampling import MachineSampler
from cosmos_cli.ui.console import Column, Console
from cosmos_cli.ui.plural import counted
from madns_runtime.config import DeviceLaunch
from madns_runtime.hardware.count_table import NOT_FINITE
from madns_runtime.plain_values import mapping_at

FIGURES = (
    Column("device"),
    Column("channel"),
    Column("samples", is_number=True),
    Column("rate Hz", is_number=True),
    Column("jitter p99 us", is_number=True),
    Column("age p50 us", is_number=True),
    Column("age max us", is_number=True),
    Column("errors", is_number=True),
)
LOCAL = "local"


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """The devices that are tried: of this computer, and of others."""

    console: Console
    fleet: Fleet
    name: str | None
    """Of the device; None for all."""
    seconds: float
    writes: bool = False
    here: list[DeviceLaunch] = field(default_factory=list)
    there: dict[str, list[DeviceLaunch]] = field(default_factory=dict)
    """By machine."""

    def __post_init__(self) -> None:
        for machine, device in chosen_devices(self.fleet.machines, self.name):
            launch = launch_of(machine, device, writes=self.writes)
            if machine.connection == LOCAL:
                self.here.append(launch)
                for text in missing_for(machine, device):
                    self.console.warn(f"{launch.full_name}: {text}")
            else:
                self.there.setdefault(machine.name, []).append(launch)

    @property
    def names(self) -> list[str]:
        """Full names of all devices."""
        elsewhere = (each.full_name for launches in self.there.values() for each in launches)
        return [*(each.full_name for each in self.here), *elsewhere]

    @property
    def launches(self) -> list[DeviceLaunch]:
        """Return the launches that drive all of them."""
        return [*self.here, *(each for launches in self.there.values() for each in launches)]

    def sample_there(
        self, records: Path | None = None, *, seconds: float | None = None
    ) -> list[Outcome[dict[str, Any]]]:
        """Sample the devices of other machines, all at once, and return what each machine told."""
        if not self.there:
            return []
        machines = [machine for machine in self.fleet.machines if machine.name in self.there]
        sampler = MachineSampler(
            machines, seconds or self.seconds, writes=self.writes, say=self.console.say
        )
        targets = tuple(t for t in self.fleet.targets if t.name in self.there)
        # Each is driven for as long: none waits for another.
        fleet = Fleet(
            targets=targets,
            forks=max(self.fleet.forks, len(targets)),
            options=self.fleet.options,
            load=lambda: tuple(machines),
        )
        return fleet.each(
            lambda connection, machine: sampler.sample(
                connection, machine, self.there[machine.name], records
            )
        )


def test_devices(trial: Trial) -> int:
    """Sample devices, and show what each gave; return the exit code."""
    console = trial.console
    console.say(f"sampling {', '.join(trial.names)} for {trial.seconds:g} s")
    outcomes = trial.sample_there()
    told = _sampled_here(trial) if trial.here else {}
    for outcome in outcomes:
        told |= outcome.value or {}
        if outcome.failure is not None:
            console.say(f"{outcome.machine}: failed: {outcome.failure}")
    console.table(FIGURES, [row for name, each in told.items() for row in _rows(name, each)])
    bad = [name for name, each in told.items() if is_bad(each)]
    for name, each in told.items():
        console.data(f"{name}: {each['status']}, identity {each['identity'] or 'none'}")
        for text in shortcomings(each):
            console.say(f"{name}: {text}")
    failures = {each.machine: each.failure.to_mapping() for each in outcomes if each.failure}
    missed = [name for name in trial.names if name not in told]
    code = ExitCode.MACHINES if failures else ExitCode.RUN_FAILED if bad else ExitCode.OK
    console.print_json(
        {"devices": told, "not_sampled": missed, "failures": failures, "exit_code": int(code)}
    )
    return int(code)


def _sampled_here(trial: Trial) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="cosmos-devices-") as folder:
        return sample_here(
            trial.here, trial.seconds, Path(folder), writes=trial.writes, say=trial.console.say
        )


def record_device(trial: Trial, directory: Path) -> int:
    """Record one device into a folder, and show what it gave; return the exit code."""
    console = trial.console
    told = recorded(trial, directory)
    console.table(FIGURES, _rows(trial.names[0], told))
    console.data(
        f"{directory}: recorded; kind: playback with parameters: {{directory: ...}} plays it"
    )
    for text in shortcomings(told):
        console.say(f"{trial.names[0]}: {text}")
    is_whole = not _dropped(told)
    code = ExitCode.RUN_FAILED if is_bad(told) or not is_whole else ExitCode.OK
    console.print_json({"directory": str(directory), "device": told, "exit_code": int(code)})
    return int(code)


def recorded(trial: Trial, directory: Path, *, seconds: float | None = None) -> dict[str, Any]:
    """
    Record the one device of a trial into a new folder, and return what it gave.

    Args:
        trial: Of one device.
        directory: The folder; it is made.
        seconds: How long; None for as long as the trial says.

    Raises:
        InputError: The trial has several, or the folder is there already.
        MachinesError: There was no sample, or its machine failed.
    """
    console = trial.console
    if len(trial.names) > 1:
        raise InputError(f"{trial.name} means {', '.join(trial.names)}: name one")
    seconds = seconds or trial.seconds
    console.say(f"recording {trial.names[0]} for {seconds:g} s")

    def sample(folder: Path) -> dict[str, Any]:
        if trial.here:
            return sample_here(trial.here, seconds, folder, say=console.say)
        (outcome,) = trial.sample_there(folder, seconds=seconds)
        raise_if_failed([outcome], "nothing was recorded")
        return dict(outcome.value or {})

    return record(trial.launches[0], seconds, directory, sample)


def shortcomings(told: Mapping[str, Any]) -> list[str]:
    """Return why a device failed, and what is missing in what it gave though it gave samples."""
    found = [failure] if (failure := _failure(told)) else []
    if dropped := _dropped(told):
        found.append(f"not on record for want of room: {counted(dropped, 'record')}")
    if told.get("silent_inputs") and told.get("samples"):
        found.append(f"no value came of {', '.join(told['silent_inputs'])}")
    for channel, number in _not_finite(told).items():
        found.append(f"{counted(number, 'sample')} of {channel} held what is no number")
    return found


def is_bad(told: Mapping[str, Any]) -> bool:
    """Tell whether a device failed, or gave values that are no numbers."""
    return bool(_failure(told) or _not_finite(told))


def _failure(told: Mapping[str, Any]) -> str:
    """Return why a device failed: errors, a loss, inputs that gave nothing at all, an end without its report; else empty."""
    inputs = [each for each in told["channels"].values() if "samples" in each]
    is_silent = bool(inputs) and not any(each["samples"] for each in inputs)
    if mapping_at(told, "report").get("unreported"):
        return str(told["why"] or told["error"] or "its process ended without its report")
    if told["errors"] or told["lost"] or is_silent:
        return str(told["error"] or told["why"] or "no sample of any input")
    return ""


def _not_finite(told: Mapping[str, Any]) -> dict[str, int]:
    """Return how often each input was no number, by its name; those that were not at all are left out."""
    counts = mapping_at(told, "report").items()
    return {k.removesuffix(NOT_FINITE): n for k, n in counts if k.endswith(NOT_FINITE) and n}


def _dropped(told: Mapping[str, Any]) -> int:
    return int(mapping_at(told, "report", "records").get("dropped", 0))


def _rows(full_name: str, told: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    figures: tuple[str, ...]
    for channel, each in told["channels"].items():
        if "written" in each:
            figures = (f"{each['written']} written", "", "", _figure(each.get("lateness_us")), "")
        else:
            names = ("samples", "rate_hz", "jitter_us", "age_us", "age_us_max")
            figures = tuple(_figure(each.get(name)) for name in names)
        rows.append((full_name, channel, *figures, str(told["errors"])))
    return rows


def _figure(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, int | float) else ""
