"""Reads a scenario file into a checked scenario, or names all of its faults at once, each with its place."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, apply_overrides, parse_override, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.scenario import Scenario, cross_faults
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.yaml_source import Source, read_source
from madns_runtime.config import Agents, RunConfig, to_mapping
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.plugin.api import Simulation
from madns_runtime.plugin.guard import blame, said
from madns_runtime.plugin.questions import ask_check
from madns_runtime.plugin.registry import is_file, part_faults, resolve

_PLACEHOLDERS = {"name": "x", "simulation": "x", "agents": {"count": 1}}
"""Stand in for sections with faults, while the others are checked against each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFile:
    """A scenario that was read and found right, and what it was read from."""

    path: Path
    text: str
    """The file as it stands on disk."""
    overrides: tuple[str, ...]
    """Of --set, applied after reading."""
    scenario: Scenario
    simulation: Simulation
    """The descriptor that `scenario.simulation` names."""
    parameters: Any
    """An instance of the simulation's parameters class."""

    @property
    def base_directory(self) -> Path:
        """The folder of the file, absolute: relative files are found from here."""
        return self.path.resolve().parent

    @property
    def parameters_mapping(self) -> dict[str, Any]:
        """The parameters as a plain mapping, defaults filled in."""
        return to_mapping(self.parameters)

    def fault(self, path: ValuePath, text: str) -> Fault:
        """Return a fault at its place in the file, for what only a later step can find wrong."""
        document = read_document(Source.of(str(self.path), self.text))
        apply_overrides(document, self.overrides)
        written = _is_written(document, path)
        return document.fault(path, text) if written else document.missing(path, text)

    def run_config(self, run: str) -> RunConfig:
        """Return what host and agents of the run named *run* are told."""
        return self.scenario.run_config(
            run=run, base_directory=self.base_directory, parameters=self.parameters_mapping
        )

    def to_mapping(self) -> dict[str, Any]:
        """Return the scenario as plain values, overrides applied and defaults filled in."""
        values = {key: getattr(self.scenario, key) for key in Scenario.model_fields}
        return to_mapping(values | {"parameters": self.parameters_mapping})


def load_scenario(path: Path, overrides: Sequence[str] = ()) -> ScenarioFile:
    """
    Read and check a scenario.

    Args:
        path: The YAML file.
        overrides: KEY=VALUE of --set.

    Raises:
        InputError: With every fault found, in the order of the file; faults of --set come last.
        MissingExtraError: The simulation needs an optional dependency that is not installed.
    """
    document = read_document(read_source(path))
    faults = apply_overrides(document, overrides)
    faults += document.faults
    return _check(document, path, tuple(overrides), faults)


def _check(
    document: Document, path: Path, overrides: tuple[str, ...], faults: list[Fault]
) -> ScenarioFile:
    scenario, scenario_faults = _scenario(document)
    faults = faults + scenario_faults
    base_directory = path.resolve().parent
    simulation, simulation_faults = _simulation(document, base_directory)
    faults += simulation_faults
    parameters: Any = None
    if simulation is not None:
        parameters, parameter_faults = _parameters(document, simulation)
        if parameters is not None and scenario is not None:
            parameter_faults += _plugin_faults(
                document, simulation, parameters, scenario.agents, base_directory
            )
        faults += parameter_faults
    if scenario is None or simulation is None or faults:
        raise InputError(faults=sorted(_told_once(faults, document.faults), key=_order))
    return ScenarioFile(
        path=path,
        text=document.source.text,
        overrides=overrides,
        scenario=scenario,
        simulation=simulation,
        parameters=parameters,
    )


def _told_once(faults: Sequence[Fault], scalars: Sequence[Fault]) -> list[Fault]:
    """Leave out what follows from a scalar without a value: that it is missing, or of the wrong type."""
    places = {(fault.line, fault.column) for fault in scalars}
    return [f for f in faults if f in scalars or f.override or (f.line, f.column) not in places]


def _order(fault: Fault) -> tuple[bool, int, int]:
    return bool(fault.override), fault.line or 0, fault.column or 0


def _scenario(document: Document) -> tuple[Scenario | None, list[Fault]]:
    """Return the scenario, and faults; sections without faults are checked against each other anyway."""
    try:
        scenario = _validate_scenario(document.value)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faults = faults_of(document, errors, Scenario)
        broken = frozenset(str(item["loc"][0]) for item in errors)
        rest = {key: value for key, value in document.value.items() if key not in broken}
        spared = {key: value for key, value in _PLACEHOLDERS.items() if key in broken}
        partial = _validate_scenario(rest | spared)
        return None, faults + _cross(document, partial, broken)
    return scenario, _cross(document, scenario, frozenset())


def _validate_scenario(value: Any) -> Scenario:
    """Validate as JSON and strictly: no text passes for a number, yet a list does for a tuple."""
    return Scenario.model_validate_json(json.dumps(value), strict=True)


def _cross(document: Document, scenario: Scenario, broken: frozenset[str]) -> list[Fault]:
    return [
        document.fault(path, text) if _is_written(document, path) else document.missing(path, text)
        for path, text in cross_faults(scenario, skip=broken)
    ]


def _is_written(document: Document, path: ValuePath) -> bool:
    return path in document.value_places


def _simulation(document: Document, base_directory: Path) -> tuple[Simulation | None, list[Fault]]:
    spec = document.value.get("simulation")
    if not isinstance(spec, str) or not spec:
        return None, []  # the model has said so already
    try:
        simulation = resolve(spec, base_directory)
    except MadnsError as error:
        return None, [document.fault(("simulation",), str(error))]
    except OSError as error:  # such as a name that is too long for a file
        return None, [document.fault(("simulation",), f"not to be found: {error.strerror}")]
    # Whoever writes a file wants to hear of all its slips; an installed simulation's halves stay unloaded.
    texts = part_faults(simulation, base_directory) if is_file(spec) else []
    return simulation, [document.fault(("simulation",), text) for text in texts]


def _parameters(document: Document, simulation: Simulation) -> tuple[Any, list[Fault]]:
    value = document.value.get("parameters", {})
    if not isinstance(value, Mapping):
        return None, []  # the model has said so already
    try:
        adapter = adapter_of(simulation.parameters)
        return adapter.validate_json(json.dumps(value), strict=True), []
    except ValidationError as error:
        if "parameters" not in document.value:
            document.value["parameters"] = {}
        errors = error.errors(include_url=False)
        return None, faults_of(document, errors, simulation.parameters, below=("parameters",))
    except Exception as error:  # noqa: BLE001 - a plug-in's class may raise anything
        kind = simulation.parameters
        text = f"{blame(error, kind)}: {kind.__name__}: {said(error)}"
        return None, [document.fault(("simulation",), text)]


def _plugin_faults(
    document: Document,
    simulation: Simulation,
    parameters: Any,
    agents: Agents,
    base_directory: Path,
) -> list[Fault]:
    """Ask the simulation itself: it knows of missing files and of what fits together."""
    if simulation.check is None:
        return []
    try:
        texts = ask_check(
            simulation.check,
            base_directory,
            parameters=parameters,
            agents=agents.count,
            names=agents.resolved_names(),
        )
    except PluginError as error:
        return [document.fault(("simulation",), str(error))]
    return [_plugin_fault(document, text) for text in texts]


def _plugin_fault(document: Document, text: str) -> Fault:
    """Find the place of `dotted.name: what is wrong`; the name may leave out `parameters.`."""
    name, colon, message = text.partition(":")
    path: ValuePath = ("parameters",)
    if not colon or " " in name:
        return document.fault(path, text, at_key=True)
    try:
        steps = parse_override(f"{name}=")[1]
    except InputError:
        return document.fault(path, text, at_key=True)
    path = steps if steps[:1] == path else path + steps
    if _is_written(document, path):
        return document.fault(path, message.strip())
    return document.missing(path, message.strip())
