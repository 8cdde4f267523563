"""
Faults in what a scenario says of vehicles and their sensors; and in code that it names.

Whether code that it names is there is found out without running any of it, for `cosmos validate`: a file is
parsed, not imported. What it does when it is imported shows on the agent.
"""

from __future__ import annotations

import ast
import fnmatch
import importlib.util
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path

from madns_runtime.bounded_files import FileRefused, read_regular_file
from madns_runtime.plugin.code_places import CODE_BYTES_MAX
from madns_runtime.plugin.registry import is_file
from madns_runtime.simulations.constellation.actuation import actuation_faults
from madns_runtime.simulations.constellation.alignment import alignment_fault
from madns_runtime.simulations.constellation.check_radio import radio_faults
from madns_runtime.simulations.constellation.equipment import (
    AnySensorDevice,
    ClockDevice,
    MagnetometerDevice,
    SensorDevice,
    SensorNoise,
    StarTrackerDevice,
    Vehicle,
)
from madns_runtime.simulations.constellation.orbit.earth import days_since_j2000
from madns_runtime.simulations.constellation.orbit.magnetic import IGRF_14_DIPOLE_NT, decimal_year
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.sensor_channels import sensors_from_devices
from madns_runtime.simulations.constellation.stimulus import stimulus_faults
from madns_runtime.simulations.constellation.vehicles import fits, is_glob

_HERE = "madns_runtime.simulations.constellation"
WALL = tuple(f"{_HERE}.{part}" for part in ("truth", "vehicle", "host_side", "host", "agent"))
"""Packages that flight software must not import: all that knows truth."""
EVERYBODY = "*"
"""The glob of all vehicles."""
FIELD_YEARS = {
    "dipole": (min(IGRF_14_DIPOLE_NT), max(IGRF_14_DIPOLE_NT)),
    "igrf": (1900.0, 2030.0),
}
"""First and last year of each model of the Earth's field; of the IGRF's 14th generation."""
MOMENT_ROUNDING = 1e-12
"""Of the largest moment of inertia: a flat body's is the sum of the others, but for rounding."""
PENDING_MAX = 10_000
"""Measurements that a sensor may have under way: see vehicle.sensors.sensor."""


def board_faults(
    parameters: ConstellationParameters, names: Sequence[tuple[str, str]]
) -> list[str]:
    """
    Return the faults.

    Args:
        parameters: Of the scenario, within their bounds.
        names: Names of each agent and of its satellite; empty if they are not known.
    """
    globs = [vehicle.agents for vehicle in parameters.vehicles]
    faults = unreached_faults("parameters.vehicles", globs, names)
    for number, vehicle in enumerate(parameters.vehicles):
        field = f"parameters.vehicles[{number}]"
        faults += glob_faults(f"{field}.agents", vehicle.agents, names)
        faults += _body_faults(field, vehicle)
        faults += _sensor_faults(field, vehicle)
        faults += _actuation_faults(field, vehicle)
        faults += _stimulus_faults(field, vehicle, parameters.segments.buffer_s / 2.0)
    faults += radio_faults(parameters, names)
    return faults


def glob_faults(field: str, globs: Iterable[str], names: Sequence[tuple[str, str]]) -> list[str]:
    """Return a fault for each glob that fits nobody."""
    if not names:
        return []
    known = {name for pair in names for name in pair}
    return [
        f"{field}: {glob!r} fits no agent and no satellite, such as {names[0][0]} or {names[0][1]}"
        for glob in globs
        if glob not in known
        and not (is_glob(glob) and any(map(re.compile(fnmatch.translate(glob)).match, known)))
    ]


def unreached_faults(
    field: str, entries: Sequence[Sequence[str]], names: Sequence[tuple[str, str]]
) -> list[str]:
    """
    Return a fault for each entry that holds for nobody, since all that it fits are those of entries before it.

    A pattern such as "agent-*" may find none left where few agents fly, if none before it is "*": that is no fault.

    Args:
        field: Dotted name of the list.
        entries: Globs of each entry.
        names: Names of each agent and of its satellite; empty if they are not known.
    """
    bearers: dict[str, list[str]] = {}
    for pair in names:
        for name in dict.fromkeys(pair):
            bearers.setdefault(name, []).append(pair[0])
    taken: dict[str, int] = {}
    is_rest_taken = False
    faults = []
    for number, globs in enumerate(entries):
        plain = [agent for glob in globs for agent in bearers.get(glob, ())]
        patterns = tuple(filter(is_glob, globs))
        more = [agent for agent, other in names if fits(patterns, agent, other)] if patterns else []
        fitting = dict.fromkeys((*plain, *more))
        if fitting and fitting.keys() <= taken.keys() and (is_rest_taken or not patterns):
            first = taken[next(iter(fitting))]
            faults.append(
                f"{field}[{number}].agents: expected agents or satellites that no entry before it fits, "
                f"got those of {field}[{first}]: the first that fits holds"
            )
        for agent in fitting:
            taken.setdefault(agent, number)
        is_rest_taken = is_rest_taken or EVERYBODY in globs
    return faults


def _body_faults(field: str, vehicle: Vehicle) -> list[str]:
    faults = []
    thruster, limits = vehicle.thruster, vehicle.ballistic_m2_kg_range
    if thruster is not None and thruster.propellant_kg >= vehicle.mass_kg:
        faults.append(
            f"{field}.thruster.propellant_kg: expected less than the vehicle's mass_kg, "
            f"{vehicle.mass_kg:g}, got {thruster.propellant_kg:g}"
        )
    if limits is not None and not 0.0 <= limits[0] <= vehicle.ballistic_m2_kg <= limits[1]:
        faults.append(
            f"{field}.ballistic_m2_kg_range: expected smallest and largest, and ballistic_m2_kg "
            f"({vehicle.ballistic_m2_kg:g}) between them, got {limits[0]:g} to {limits[1]:g}"
        )
    if vehicle.attitude is not None:
        a, b, c = sorted(vehicle.attitude.inertia_kg_m2)
        if a + b < c * (1.0 - MOMENT_ROUNDING):
            faults.append(
                f"{field}.attitude.inertia_kg_m2: no body has moments of which one exceeds the sum "
                f"of the others, got {a:g}, {b:g} and {c:g}"
            )
    return faults


def _sensor_faults(field: str, vehicle: Vehicle) -> list[str]:
    sensors = vehicle.sensors
    faults = [
        f"{field}.sensors.{name}: needs a vehicle with attitude"
        for name in ("gyro", "star_tracker")
        if getattr(sensors, name) is not None and vehicle.attitude is None
    ]
    for name in type(sensors).__dataclass_fields__:
        sensor: SensorNoise | AnySensorDevice | None = getattr(sensors, name)
        if not isinstance(sensor, SensorNoise):
            continue
        if sensor.latency_s * sensor.rate_hz > PENDING_MAX:
            faults.append(
                f"{field}.sensors.{name}.latency_s: expected at most {PENDING_MAX} measurements "
                f"under way, got {sensor.latency_s * sensor.rate_hz:g}"
            )
    for name, settings in sensors_from_devices(vehicle):
        faults += _device_faults(f"{field}.sensors.{name}", settings)
    models = _field_models(vehicle)
    if "igrf" in models.values() and importlib.util.find_spec("ppigrf") is None:
        faults += [
            f"{field}.{name}.field: ppigrf is not installed here; "
            "install it with: pip install 'cosmos-madns[igrf]'"
            for name, model in models.items()
            if model == "igrf"
        ]
    return faults


def _field_models(vehicle: Vehicle) -> dict[str, str]:
    """Return the model of the Earth's field that sensors and magnetorquers take, by their place in a vehicle."""
    magnetometer, inner = vehicle.sensors.magnetometer, ""
    if isinstance(magnetometer, MagnetometerDevice):
        magnetometer, inner = magnetometer.model, ".model"
    torquers = None if vehicle.attitude is None else vehicle.attitude.magnetorquers
    return {
        name: user.field
        for name, user in (
            (f"sensors.magnetometer{inner}", magnetometer),
            ("attitude.magnetorquers", torquers),
        )
        if user is not None and user.field is not None
    }


def field_year_remarks(parameters: ConstellationParameters, epoch_utc: datetime) -> list[str]:
    """Return a remark that the Earth's field at the epoch is that of another year: the models' coefficients end before."""
    year = decimal_year(days_since_j2000(epoch_utc))
    for number, vehicle in enumerate(parameters.vehicles):
        models = {
            **_field_models(vehicle),
            **{
                f"stimuli[{place}]": stimulus.field
                for place, stimulus in enumerate(vehicle.stimuli)
                if stimulus.source == "magnetic_field"
            },
        }
        for name, model in models.items():
            first, last = FIELD_YEARS[model]
            if not first <= year <= last:
                return [
                    f"remark: parameters.vehicles[{number}].{name}.field: the Earth's field is that of"
                    f" {min(max(year, first), last):g}, not of the epoch ({epoch_utc:%Y-%m-%d}): {model} is known"
                    f" from {first:g} to {last:g}"
                ]
    return []


def _actuation_faults(field: str, vehicle: Vehicle) -> list[str]:
    attitude = vehicle.attitude
    has_torquers = attitude is not None and attitude.magnetorquers is not None
    return [
        f"{field}.actuation[{number}].{name}: {text}"
        for number, actuation in enumerate(vehicle.actuation)
        for name, text in actuation_faults(
            actuation, has_attitude=attitude is not None, has_torquers=has_torquers
        )
    ]


def _stimulus_faults(field: str, vehicle: Vehicle, lead_s_max: float) -> list[str]:
    faults = []
    channels: set[str] = set()
    for number, stimulus in enumerate(vehicle.stimuli):
        own = f"{field}.stimuli[{number}]"
        found = stimulus_faults(
            stimulus, has_attitude=vehicle.attitude is not None, lead_s_max=lead_s_max
        )
        faults += [f"{own}.{name}: {text}" for name, text in found]
        if stimulus.channel in channels:
            faults.append(
                f"{own}.channel: expected every channel once, got {stimulus.channel} again"
            )
        channels.add(stimulus.channel)
        if stimulus.field == "igrf" and importlib.util.find_spec("ppigrf") is None:
            faults.append(
                f"{own}.field: ppigrf is not installed here; "
                "install it with: pip install 'cosmos-madns[igrf]'"
            )
    return faults


def _device_faults(field: str, settings: AnySensorDevice) -> list[str]:
    """Return what is wrong with a sensor that is hardware, whatever its device."""
    faults = []
    device, _, channel = settings.device.rpartition(".")
    if not device or not channel.isidentifier():
        faults.append(
            f"{field}.device: expected a device and its channel such as imu.gyro, got {settings.device!r:.80}"
        )
    if isinstance(settings, SensorDevice | StarTrackerDevice):
        must_turn = isinstance(settings, StarTrackerDevice)
        if wrong := alignment_fault(settings.alignment, must_turn=must_turn):
            faults.append(f"{field}.alignment: {wrong}")
    if isinstance(settings, SensorDevice | ClockDevice):
        scale = settings.scale if isinstance(settings.scale, tuple) else (settings.scale,)
        if not all(number and math.isfinite(number) for number in scale):
            faults.append(f"{field}.scale: expected factors other than 0, got {settings.scale}")
    unused = SensorNoise()
    faults += [
        f"{field}.model.{name}: the model is asked at the times of the device's samples: leave it out"
        for name in ("rate_hz", "latency_s", "dropout")
        if settings.model is not None and getattr(settings.model, name) != getattr(unused, name)
    ]
    return faults


def code_faults(
    field: str, spec: str, base_directory: Path, *, forbidden: Sequence[str] = ()
) -> list[str]:
    """
    Return what is wrong with a class that a scenario names.

    Args:
        field: Dotted name of the parameter.
        spec: file.py:Class beside the scenario, or module:Class.
        base_directory: Folder of the scenario.
        forbidden: Modules that its file must not import, nor what is below them.
    """
    place, _, name = spec.rpartition(":")
    if not place or not name.isidentifier():
        return [f"{field}: expected file.py:Class or module:Class, got {spec!r}"]
    if not is_file(spec):
        top = place.partition(".")[0]
        if not top.isidentifier() or importlib.util.find_spec(top) is None:
            return [f"{field}: no module {top!r} here; a file is written {place}.py:{name}"]
        return []
    path = base_directory / place
    try:
        tree = _parse(read_regular_file(path, bytes_max=CODE_BYTES_MAX), path)
    except FileNotFoundError:
        return [f"{field}: no such file: {path}"]
    except SyntaxError as error:
        return [f"{field}: {path}:{error.lineno}: {error.msg}"]
    except FileRefused as error:
        return [f"{field}: {error}"]
    except (OSError, ValueError) as error:
        return [f"{field}: {path} cannot be read: {error}"]
    except (RecursionError, MemoryError):
        return [f"{field}: {path}: its expressions are too deeply nested to be read"]
    faults = [
        f"{field}: {path}:{line}: expected no import of {module}: flight software sees what its "
        "context gives it"
        for line, module in _imports(tree)
        if any(f"{module}.".startswith(f"{one}.") for one in forbidden)
    ]
    names = set(_names(tree))
    if name not in names and "*" not in names:
        classes = [node.name for node in tree.body if isinstance(node, ast.ClassDef)]
        told = f"; it has {', '.join(classes)}" if classes else ""
        faults.append(f"{field}: {path} has no class {name!r}{told}")
    return faults


def _parse(code: bytes, path: Path) -> ast.Module:
    """Return the syntax tree of a file's code; CPython 3.11 may lose count in it while another thread parses (its issue 106905)."""
    try:
        return ast.parse(code, str(path))
    except SystemError:
        return ast.parse(code, str(path))


def _imports(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and module of every import, wherever it stands; what is taken from a package may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


def _names(tree: ast.Module) -> Iterator[str]:
    """Yield what a module's own lines bind, wherever below an if or a try they stand."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            yield node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            for alias in node.names:
                yield (alias.asname or alias.name).partition(".")[0]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
