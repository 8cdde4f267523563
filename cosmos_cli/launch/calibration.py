"""From recordings of a device to calibrated sensors, and to what stands in a scenario for them."""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from cosmos_cli.errors import InputError
from cosmos_cli.launch.feasibility import finite
from cosmos_cli.models.device_kinds import DeviceQuestion, ask_kinds
from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import ConfigurationError, MissingExtraError
from madns_runtime.hardware.calibration.recorded import read_samples
from madns_runtime.hardware.calibration.rest import rest_bias
from madns_runtime.hardware.calibration.result import SI_UNITS, SensorCalibration, SensorName
from madns_runtime.hardware.calibration.strength import calibrate_positions, calibrate_turned
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.units import factor_of

DEVICE_SENSORS: Final[tuple[SensorName, ...]] = ("gyro", "accelerometer", "magnetometer")
"""In the order in which a device is guided through them."""
POSITIONS_MAX: Final = 100
HEIGHT_M_MAX: Final = 100_000.0
VECTOR: Final = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class VectorChannels:
    """The inputs of three numbers that a device has."""

    channels: tuple[Channel, ...]

    @property
    def known(self) -> str:
        """Names and units of all of them."""
        return ", ".join(f"{c.name} ({c.unit or 'no unit'})" for c in self.channels) or "none"

    def of(self, sensor: SensorName) -> list[Channel]:
        """Return those in a unit of a sensor."""
        return [c for c in self.channels if factor_of(c.unit, SI_UNITS[sensor]) is not None]

    def one(self, sensor: SensorName, name: str | None) -> Channel:
        """
        Return the one of a sensor, by its name where several have its unit.

        Raises:
            ConfigurationError: There is none, or there are several.
        """
        fitting = [c for c in self.of(sensor) if name in (None, c.name)]
        if len(fitting) != 1:
            what = "several inputs" if fitting else "no input"
            named = f" called {name}" if name else ""
            raise ConfigurationError(
                f"{sensor}: {what}{named} of three numbers in a unit of {SI_UNITS[sensor]}; it has {self.known};"
                " --channel names one"
            )
        return fitting[0]


def vector_channels(launch: DeviceLaunch) -> VectorChannels:
    """
    Return a device's inputs of three numbers, by its kind.

    Raises:
        InputError: Its kind does not tell.
    """
    question = DeviceQuestion(
        path=(),
        kind=launch.kind,
        parameters=launch.parameters,
        base_directory=Path(launch.base_directory),
    )
    (answer,) = ask_kinds([question])
    if answer.faults:
        raise InputError(f"{launch.full_name}: {answer.faults[0].text}")
    return VectorChannels(
        channels=tuple(
            c
            for c in answer.channels
            if c.direction == "in" and not c.is_frame and c.size == VECTOR
        )
    )


def calibrate(
    sensor: SensorName,
    folders: Sequence[Path],
    *,
    channel: str | None,
    field_t: float | None,
    limits: tuple[float, float] | None = None,
) -> SensorCalibration:
    """
    Return what recordings tell of a sensor.

    Args:
        sensor: Which.
        folders: Recordings: of a gyro one at rest, of an accelerometer one per position, of a magnetometer one turned.
        channel: Its channel; None for the only one in its unit.
        field_t: Strength of the magnetic field, T; None where nobody knows.
        limits: The channel's, where they are known.

    Raises:
        ConfigurationError: A folder holds no such channel, or there are too many of them.
        MachineError: A file cannot be read.
    """
    most = POSITIONS_MAX if sensor == "accelerometer" else 1
    if len(folders) > most:
        raise ConfigurationError(
            f"{sensor}: expected at most {most} recordings, got {len(folders)}"
        )
    samples = [read_samples(folder, sensor, channel, limits=limits) for folder in folders]
    if sensor == "gyro":
        return rest_bias(samples[0])
    if sensor == "accelerometer":
        return calibrate_positions(samples)
    return calibrate_turned(samples[0], field_t)


def field_at_t(place: str) -> float:
    """
    Return the strength of the Earth's field today, T, by the IGRF.

    Args:
        place: Geodetic latitude and longitude, deg, and height above the ellipsoid, m, with commas between.

    Raises:
        InputError: It is no place.
        MissingExtraError: ppigrf is not installed.
    """
    try:
        latitude, longitude, *more = (float(part) for part in place.split(","))
    except ValueError:
        latitude, longitude, more = math.nan, math.nan, []
    height_m = more[0] if more else 0.0
    is_place = abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and len(more) <= 1
    if not is_place or not abs(height_m) <= HEIGHT_M_MAX:
        raise InputError(
            f"--place: expected latitude and longitude, deg, such as 52.5,13.4 or 52.5,13.4,35, got {place!r:.80}"
        )
    try:
        model: Any = importlib.import_module("ppigrf")
    except ImportError as error:
        raise MissingExtraError("ppigrf", "igrf") from error
    today = datetime.now(UTC).replace(tzinfo=None)
    components_nt = model.igrf(longitude, latitude, height_m * 1e-3, today)
    return 1e-9 * math.hypot(*(float(component.ravel()[0]) for component in components_nt))


def pasteable(device: str, found: Sequence[SensorCalibration]) -> str:
    """Return what to paste into a vehicle of a scenario; empty for nothing."""
    name = device.rpartition("/")[2]  # a scenario names no machine: each agent has its own device
    lines = []
    for each in found:
        settings = {"device": f"{name}.{each.channel}", **each.settings()}
        inner = ", ".join(f"{key}: {value}" for key, value in settings.items())
        lines.append(f"  {each.sensor}: {{{inner}}}")
    return "\n".join(["sensors:", *lines]) if lines else ""


def to_document(found: SensorCalibration) -> dict[str, Any]:
    """Return a calibration as plain values for scripts; what is not a number is left out."""
    told = dataclasses.asdict(found)
    for key in ("bias", "scale"):
        if told[key] is not None:
            told[key] = {name: [finite(n) for n in numbers] for name, numbers in told[key].items()}
    return {**told, "settings": found.settings()}
