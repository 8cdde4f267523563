"""`cosmos devices calibrate`: bias and scale of inertial sensors and magnetometers, guided or from recordings."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, get_args

import typer

from cosmos_cli.commands.device_trials import Trial, is_bad, recorded, shortcomings
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.launch.calibration import (
    DEVICE_SENSORS,
    calibrate,
    field_at_t,
    pasteable,
    to_document,
    vector_channels,
)
from cosmos_cli.ui.console import Column, Console, wait_for_enter
from cosmos_cli.ui.plural import counted
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.calibration.result import AXES, SensorCalibration, SensorName

FromOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--from",
        metavar="DIRECTORY",
        help="calibrate: a folder that `record` wrote, instead of a device; one per position of an accelerometer.",
    ),
]
ChannelOption = Annotated[
    str | None,
    typer.Option(
        "--channel", metavar="NAME", help="calibrate: the channel, where units do not tell which."
    ),
]
FieldOption = Annotated[
    float | None,
    typer.Option(
        "--field-ut",
        metavar="UT",
        min=1.0,
        max=1e6,
        help="calibrate: strength of the magnetic field where the magnetometer is turned, uT.",
    ),
]
PlaceOption = Annotated[
    str | None,
    typer.Option(
        "--place",
        metavar="LAT,LON[,HEIGHT_M]",
        help="calibrate: the same by the IGRF at a place today (extra igrf), deg and m.",
    ),
]
POSITIONS: Final = tuple(f"{axis} {way}" for axis in AXES for way in ("up", "down"))
TURNING: Final = 6.0
"""Times as long as at rest: nobody turns a board to all sides in five seconds."""
COLUMNS: Final = (
    Column("sensor"),
    Column("number"),
    Column("x", is_number=True),
    Column("y", is_number=True),
    Column("z", is_number=True),
    Column("unit"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationWish:
    """The calibration that is asked for: of which device, and against what."""

    device: str
    """Its name; in the scenario it stands by that."""
    sensors: tuple[SensorName, ...]
    """Empty for all that the device has."""
    recordings: tuple[Path, ...]
    channel: str | None
    field_t: float | None

    @classmethod
    def of(
        cls,
        words: Sequence[str],
        *,
        recordings: Sequence[Path],
        channel: str | None,
        field_ut: float | None,
        place: str | None,
    ) -> CalibrationWish:
        """
        Return what words and options say.

        Raises:
            InputError: They do not fit together.
            MissingExtraError: A place is given, and the extra igrf is not installed.
        """
        device, *names = words
        known: tuple[SensorName, ...] = get_args(SensorName)
        sensors = tuple(sensor for sensor in known if sensor in names)
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"{unknown[0]}: expected one of {', '.join(known)}")
        if recordings and len(sensors) != 1:
            raise InputError("--from: expected one sensor behind the device's name, such as gyro")
        if channel is not None and len(sensors) != 1:
            raise InputError(
                "--channel: expected one sensor behind the device's name, such as gyro"
            )
        if field_ut is not None and place is not None:
            raise InputError("expected --field-ut or --place, got both")
        field_t = None if field_ut is None else field_ut * 1e-6
        return cls(
            device=device,
            sensors=sensors,
            recordings=tuple(recordings),
            channel=channel,
            field_t=field_at_t(place) if place is not None else field_t,
        )


def calibrate_recorded(console: Console, wish: CalibrationWish) -> int:
    """Calibrate one sensor from recordings, and show what it came to; return the exit code."""
    if not wish.recordings:
        raise InputError("devices calibrate: give the inventory that lists it with -i, or --from")
    (sensor,) = wish.sensors
    try:
        found = calibrate(sensor, wish.recordings, channel=wish.channel, field_t=wish.field_t)
    except ConfigurationError as error:
        raise InputError(str(error)) from error
    return _show(console, wish.device, [found])


def calibrate_device(console: Console, fleet: Fleet, wish: CalibrationWish, seconds: float) -> int:
    """Guide through the calibration of a device, and show what it came to; return the exit code."""
    trial = Trial(console=console, fleet=fleet, name=wish.device, seconds=seconds)
    channels = vector_channels(trial.launches[0])
    sensors = wish.sensors or tuple(s for s in DEVICE_SENSORS if channels.of(s))
    if not sensors:
        raise InputError(
            f"{wish.device}: no input of three numbers in a unit of a sensor; it has {channels.known}"
        )
    found = []
    with tempfile.TemporaryDirectory(prefix="cosmos-calibrate-") as folder:
        guide = _Guide(trial, Path(folder))
        for sensor in sensors:
            try:
                channel = channels.one(sensor, wish.channel)
                folders = getattr(guide, sensor)()
                found.append(
                    calibrate(
                        sensor,
                        folders,
                        channel=channel.name,
                        field_t=wish.field_t,
                        limits=channel.limits,
                    )
                )
            except ConfigurationError as error:
                raise InputError(str(error)) from error
            except KeyboardInterrupt:
                _tell_interrupted(console, wish.device, sensor, found)
                raise
    return _show(console, trial.launches[0].name, found, failures=guide.failures)


def _tell_interrupted(
    console: Console, device: str, sensor: SensorName, found: Sequence[SensorCalibration]
) -> None:
    """Tell what was interrupted, and show what had been calibrated before."""
    console.say(f"{sensor} of {device} was interrupted: nothing of it is kept")
    if usable := [each for each in found if each.is_usable]:
        console.data(pasteable(device, usable))


class _Guide:
    """Tells how the device is to be laid, and records it; a method per sensor returns the folders of its records."""

    def __init__(self, trial: Trial, folder: Path) -> None:
        self._trial, self._folder = trial, folder
        self._say = trial.console.say
        self.failures: list[str] = []
        """How the device failed while it was recorded, though it gave samples."""

    def gyro(self) -> list[Path]:
        """Record once, at rest."""
        self._say("gyro: lay the device down and leave it alone")
        return [self._record("rest")]

    def accelerometer(self) -> list[Path]:
        """Record six times, at rest, each axis once up and once down."""
        folders = []
        for number, position in enumerate(POSITIONS, start=1):
            wait_for_enter(
                f"accelerometer, position {number} of {len(POSITIONS)}: lay the device down with {position}",
                instead="record each position with `cosmos devices record`, and give all of them with --from",
            )
            folders.append(self._record(f"position-{number}"))
        return folders

    def magnetometer(self) -> list[Path]:
        """Record once, while it is turned."""
        seconds = TURNING * self._trial.seconds
        self._say(
            f"magnetometer: turn the device slowly to all sides for {seconds:g} s, each axis once along"
            " the field and once against it, away from iron"
        )
        return [self._record("turned", seconds)]

    def _record(self, name: str, seconds: float | None = None) -> Path:
        directory = self._folder / name
        told = recorded(self._trial, directory, seconds=seconds)
        lacks = [f"{name}: {text}" for text in shortcomings(told)]
        for text in lacks:
            self._trial.console.warn(text)
        if is_bad(told):
            self.failures += lacks
        return directory


def _show(
    console: Console,
    device: str,
    found: Sequence[SensorCalibration],
    *,
    failures: Sequence[str] = (),
) -> int:
    if rows := [row for each in found for row in _rows(each)]:
        console.table(COLUMNS, rows)
    for each in found:
        for remark in each.remarks:
            console.warn(f"{each.sensor}: {remark}")
        count = counted(each.samples, "sample")
        state = "calibrated" if each.is_usable else "not calibrated"
        left = "" if each.residual is None else f", {each.residual:.3g} {each.unit} rms remain"
        console.data(f"{each.sensor}: {state} by {count} of {device}.{each.channel}{left}")
    usable = [each for each in found if each.is_usable]
    if usable:
        console.data(pasteable(device, usable))
    is_whole = len(usable) == len(found) and not failures
    code = ExitCode.OK if is_whole else ExitCode.RUN_FAILED
    told: dict[str, Any] = {"device": device, "sensors": [to_document(each) for each in found]}
    console.print_json(
        {
            **told,
            "failures": list(failures),
            "yaml": pasteable(device, usable),
            "exit_code": int(code),
        }
    )
    return int(code)


def _rows(each: SensorCalibration) -> list[tuple[str, ...]]:
    """Return a row per kind of number, and one below it with the standard deviations."""
    rows: list[tuple[str, ...]] = []
    if each.bias is not None:
        rows += _with_sigma(each, "bias", each.bias.values, each.bias.sigmas, each.unit)
    if each.scale is not None:
        rows += _with_sigma(each, "scale", each.scale.values, each.scale.sigmas, "")
    if each.alignment is not None and each.alignment_sigmas is not None:
        for axis, row, sigmas in zip(AXES, each.alignment, each.alignment_sigmas, strict=True):
            rows += _with_sigma(each, f"alignment {axis}", row, sigmas, "")
    return rows


def _with_sigma(
    each: SensorCalibration,
    name: str,
    values: Sequence[float],
    sigmas: Sequence[float],
    unit: str,
) -> list[tuple[str, ...]]:
    return [
        (each.sensor, name, *(f"{value:.6g}" for value in values), unit),
        (each.sensor, f"{name} +-", *(f"{sigma:.2g}" for sigma in sigmas), unit),
    ]
