"""Reads a scenario file into a checked scenario, or names all of its faults at once, each with its place."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.agent_rules import RULES
from cosmos_cli.models.checks import ResolvedChecks, scenario_checks
from cosmos_cli.models.declared_streams import AgentStreams, every_stream
from cosmos_cli.models.document import Document, dotted, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.executor_answer import EXECUTOR_KIND, ask_executor
from cosmos_cli.models.expectation import Expectation, conditions_of_checks, unjudged_remark
from cosmos_cli.models.extending import ScenarioSource, read_scenario_source
from cosmos_cli.models.fault_place import fault_found_at
from cosmos_cli.models.hardware import hardware_faults
from cosmos_cli.models.known_streams import KnownDevice, KnownStreams
from cosmos_cli.models.overrides import apply_overrides
from cosmos_cli.models.own_requirements import own_requirement_faults
from cosmos_cli.models.place_uses import cure_of, shared_places
from cosmos_cli.models.plugin_answers import PluginAnswers, ask_plugin
from cosmos_cli.models.plugin_demand import ask_plugin_demand
from cosmos_cli.models.scenario import OF_AUTHORS, Scenario, cross_faults
from cosmos_cli.models.test_settings import settings_without_variables
from cosmos_cli.models.timeline import NO_TIMELINE, ResolvedTimeline, resolve_timeline
from cosmos_cli.models.timeline_rules import NO_TIME
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.variables import (
    author_override_faults,
    escaped_values,
    substitute_variables,
    texts_with_words,
)
from cosmos_cli.models.yaml_source import YamlSource
from madns_runtime.agent_parameters import AgentParameters
from madns_runtime.bounded_files import real_path
from madns_runtime.config import RunConfig, to_mapping
from madns_runtime.plugin.api import DeclaredStream, Demand, PlaceUse

RULE_LISTS = ("checks[", "timeline[")
_ASKED = frozenset({"agents", "time"})
"""Keys that a simulation is asked with; of the others its answers do not speak."""
_OF_DEVICES = _ASKED | {"hardware", "timeouts"}
_OF_ACTIONS = _OF_DEVICES | {"on_agent_loss"}
_OF_PARAMETERS = frozenset({"parameters", RULES})
_PLACEHOLDERS = {"name": "x", "simulation": "x", "agents": {"count": 1}}
"""Stand in for sections with faults, while the others are checked against each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioFile:
    """A scenario that was read and found right, and what it was read from."""

    path: Path
    document: Document
    """Its values with those of the files that it extends, each with its place."""
    root: Path
    """The folder that travels with it, absolute."""
    files: tuple[str, ...]
    """The file, and those that it extends."""
    overrides: tuple[str, ...]
    """Of --set, applied after reading."""
    scenario: Scenario
    parameters: Mapping[str, Any]
    """The simulation's, as a plain mapping, defaults filled in."""
    agent_parameters: tuple[AgentParameters, ...] = ()
    """Whole parameters of agents for which others hold."""
    has_demand: bool
    """Whether the simulation tells what it asks of host and network."""
    streams: tuple[DeclaredStream, ...] | None = None
    """Streams that the simulation declares; None if it declares none."""
    agent_streams: tuple[AgentStreams, ...] = ()
    """Streams of agents for which it declares others."""
    labels: AgentLabels = NO_LABELS
    """Second names of the agents."""
    place_uses: tuple[PlaceUse, ...] = ()
    """Places of its machine that each agent takes for itself."""
    timeline: ResolvedTimeline = NO_TIMELINE
    """Its timeline among these agents and actions."""
    expectations: tuple[Expectation, ...] = ()
    """Expectations of its checks, of these agents and streams."""
    placeholders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Words that the simulation replaces itself, by field."""
    remarks: tuple[Fault, ...] = ()
    """Remarks of the simulation on what is odd in its parameters, and no fault."""

    @property
    def text(self) -> str:
        """The file as it stands on disk."""
        return self.document.source.text

    @property
    def base_directory(self) -> Path:
        """The root, absolute: relative files are found from here."""
        return self.root

    def fault(self, path: ValuePath, text: str) -> Fault:
        """Return a fault at its place in the file, for what only a later step can find wrong."""
        return self.document.fault(path, text)

    def fault_of(self, text: str) -> Fault:
        """Return a fault at the parameter that a text names, as in `parameters.gain: too large`."""
        return fault_found_at(self.document, text)

    def demand(self) -> Demand:
        """
        Return what the simulation asks of host and network, if it `has_demand`.

        Raises:
            PluginError: It raised, returned no proper Demand, or did not come to an end.
            MissingExtraError: It needs an optional dependency that is not installed.
        """
        agents = self.scenario.agents
        return ask_plugin_demand(self.document, self.parameters, agents, self.base_directory)

    def run_config(self, run: str) -> RunConfig:
        """Return what host and agents of the run named *run* are told."""
        config = self.scenario.run_config(
            run=run,
            base_directory=self.base_directory,
            parameters=self.parameters,
            agent_parameters=self.agent_parameters,
            timeline=self.timeline.entries,
        )
        awaited = self.timeline.conditions
        broken = conditions_of_checks(self.expectations, first=len(awaited))
        return replace(config, conditions=(*awaited, *broken))

    def to_written(self) -> dict[str, Any]:
        """Return the same as a scenario file holds it: what is no variable there is escaped."""
        kept = texts_with_words(self.document, self.placeholders)
        kept |= {("test", "set", dotted(path)) for path in kept}
        values: dict[str, Any] = escaped_values(json.loads(json.dumps(self.to_mapping())), kept)
        return values

    def with_test_settings(self, settings: Mapping[str, Any]) -> ScenarioFile:
        """Return the same with another `test.set`."""
        test = replace(self.scenario.test, set=dict(settings))
        return replace(self, scenario=self.scenario.model_copy(update={"test": test}))

    def to_mapping(self) -> dict[str, Any]:
        """Return the scenario as plain values, overrides applied and defaults filled in."""
        keys = (key for key in Scenario.model_fields if key not in OF_AUTHORS)
        values = {key: getattr(self.scenario, key) for key in keys}
        own = {"parameters": self.parameters, "agent_parameters": self.agent_parameters}
        return to_mapping(values | own)


def load_scenario(
    path: Path, overrides: Sequence[str] = (), *, warn: Callable[[str], None] = lambda remark: None
) -> ScenarioFile:
    """
    Read and check a scenario.

    Args:
        path: The YAML file.
        overrides: KEY=VALUE of --set.
        warn: Told of settings that are read for now and should be written otherwise, each with its place.

    Raises:
        InputError: With every fault found, in the order of the file; faults of --set come last.
        MissingExtraError: The simulation needs an optional dependency that is not installed.
    """
    source = read_scenario_source(path)
    document = source.document
    settings = settings_without_variables(document, overrides)
    faults = [*author_override_faults(document, overrides), *apply_overrides(document, overrides)]
    substitute_variables(document)
    faults += document.faults
    remarks, old_faults = _rename_old_keys(document)
    checked = _check(source, path, tuple(overrides), faults + old_faults)
    for remark in remarks:
        warn(remark)
    return checked if settings is None else checked.with_test_settings(settings)


def check_scenario(text: str, path: Path) -> ScenarioFile:
    """
    Check a scenario that lies in no file, extends none, and in which ${...} is no variable.

    Args:
        text: As YAML.
        path: Where it would lie: relative files are found from there, and faults name it.

    Raises:
        InputError: With every fault found.
        MissingExtraError: The simulation needs an optional dependency that is not installed.
    """
    document = read_document(YamlSource.of(str(path), text))
    source = ScenarioSource(document=document, root=real_path(path).parent, files=(str(path),))
    return _check(source, path, (), list(document.faults))


def _rename_old_keys(document: Document) -> tuple[tuple[str, ...], list[Fault]]:
    """Give old keys their new names; return a remark on each, and a fault on each beside its new one."""
    remarks, faults = [], []
    for section, known in Scenario.model_fields.items():
        written = document.value.get(section)
        old_keys: Mapping[str, str] = getattr(known.annotation, "__old_keys__", {})
        if not isinstance(written, dict):
            continue
        for old in sorted(old_keys.keys() & written):
            path, new = (section, old), old_keys[old]
            if new in written:
                text = f"is the old name of {section}.{new}, which is given as well: leave it out"
                faults.append(document.fault(path, text, at_key=True))
                del written[old]
            else:
                text = f"is an old name: write {section}.{new}"
                remarks.append(document.fault(path, text, at_key=True).render())
                document.rename(path, new)
    return tuple(remarks), faults


def _check(
    source: ScenarioSource, path: Path, overrides: tuple[str, ...], faults: list[Fault]
) -> ScenarioFile:
    document, base_directory = source.document, source.root
    scenario, broken, scenario_faults = _scenario(document)
    faults = faults + scenario_faults
    agents = None if _ASKED & broken.keys() else scenario.agents
    faults += [
        document.fault(where, text)
        for where, text in own_requirement_faults(scenario.requirements, base_directory)
    ]
    asked = _without(document, RULES) if _OF_PARAMETERS & broken.keys() else document
    answers = ask_plugin(asked, agents, base_directory, duration_s=scenario.time.duration_s)
    faults += answers.faults
    devices: tuple[KnownDevice, ...] = ()
    if not _OF_DEVICES & broken.keys():
        device_faults, devices = _hardware(document, scenario, base_directory, answers)
        faults += device_faults
    faults += [
        document.fault(where, text)
        for where, text in cross_faults(scenario, skip=frozenset(broken), labels=answers.labels)
    ]
    wrong, odd = ask_executor(scenario)
    faults += [document.fault(EXECUTOR_KIND, wrong)] if wrong else []
    remarks = (*answers.remarks, *([document.fault(EXECUTOR_KIND, odd)] if odd else []))
    declared = (
        None if answers.streams is None else every_stream(answers.streams, answers.agent_streams)
    )
    streams = KnownStreams(declared, devices, is_partial=answers.parameters is None)
    timeline, checks = NO_TIMELINE, ResolvedChecks((), ())
    if not _OF_ACTIONS & broken.keys():
        timeline = resolve_timeline(document, scenario, answers.actions, answers.labels, streams)
    faults += timeline.faults
    if not _OF_DEVICES & broken.keys():
        checks = scenario_checks(scenario, answers, streams, broken.get("checks"))
    faults += [document.fault(("checks", *where), text) for where, text in checks.faults]
    lockstep = not broken and scenario.time.is_lockstep
    if text := unjudged_remark(checks.expectations, is_lockstep=lockstep):
        remarks = (*remarks, document.fault(("checks",), text, at_key=True))
    if broken or answers.parameters is None or faults:
        told = _told_once(faults, document)
        raise InputError(faults=told, omitted=answers.omitted)
    return ScenarioFile(
        path=path,
        document=document,
        root=source.root,
        files=source.files,
        overrides=overrides,
        scenario=scenario,
        parameters=answers.parameters,
        agent_parameters=answers.agent_parameters,
        has_demand=answers.has_demand,
        streams=answers.streams,
        agent_streams=answers.agent_streams,
        labels=answers.labels or NO_LABELS,
        place_uses=answers.place_uses,
        timeline=timeline,
        placeholders=answers.placeholders,
        remarks=remarks,
        expectations=checks.expectations,
    )


def _hardware(
    document: Document, scenario: Scenario, base_directory: Path, answers: PluginAnswers
) -> tuple[list[Fault], tuple[KnownDevice, ...]]:
    """Return what is wrong with devices, or with places that agents in lockstep share, and the devices."""
    faults, devices = hardware_faults(
        document, scenario, base_directory, labels=answers.labels, uses=answers.device_uses
    )
    if scenario.time.is_lockstep:  # all on this computer
        names = scenario.agents.resolved_names()
        faults += [
            fault_found_at(
                document,
                f"{field}: {text}; {cure_of(field, answers.placeholders, has_machines=False)}",
            )
            for field, text in shared_places(answers.place_uses, names)
        ]
    return faults, devices


def _told_once(faults: Sequence[Fault], document: Document) -> list[Fault]:
    """Sort faults, without those that follow from a scalar without a value: that it is missing, or of the wrong type."""
    own = set(document.faults)
    lost = [*document.faults, *(document.fault(path, "") for path in document.without_value)]
    places = {_place(fault) for fault in lost}
    # A rule of checks or of the timeline that has lost its limit, or its time, lacks nothing else.
    rules = {each.path.rpartition(".")[0] for each in lost if each.path.startswith(RULE_LISTS)}
    untimed = {f"{rule}.action" for rule in rules}
    told = (
        fault
        for fault in faults
        if fault in own
        or (
            _place(fault) not in places
            and fault.path not in rules
            and not (fault.path in untimed and fault.text.startswith(NO_TIME))
        )
    )
    files = {label: number for number, label in enumerate(_labels(document))}
    return sorted(
        told,
        key=lambda fault: (
            bool(fault.override),
            files.get(fault.file, len(files)),
            fault.line or 0,
            fault.column or 0,
        ),
    )


def _labels(document: Document) -> list[str]:
    others = (place.source.label for place in document.value_places.values() if place.source)
    return list(dict.fromkeys([document.source.label, *others]))


def _place(fault: Fault) -> tuple[object, ...]:
    return fault.override, fault.file, fault.line, fault.column


def _without(document: Document, key: str) -> Document:
    """Return a document of the same places without a section that has faults of its own."""
    return replace(document, value={k: v for k, v in document.value.items() if k != key})


def _scenario(
    document: Document,
) -> tuple[Scenario, Mapping[str, Sequence[int]], list[Fault]]:
    """
    Return the scenario, its keys with faults of their own, and the faults.

    Such a key stands as a placeholder, or is left out; of checks those that are right remain, whose places come with
    the key.
    """
    try:
        return _validate_scenario(document.value), {}, []
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faults = faults_of(document, errors, Scenario)
        broken: dict[str, Sequence[int]] = {str(item["loc"][0]): () for item in errors}
        rest = {key: value for key, value in document.value.items() if key not in broken}
        spared = {key: value for key, value in _PLACEHOLDERS.items() if key in broken}
        if "checks" in broken:
            broken["checks"] = _right_checks(document, [item["loc"] for item in errors])
            spared["checks"] = [document.value["checks"][place] for place in broken["checks"]]
        return _validate_scenario(rest | spared), broken, faults


def _right_checks(document: Document, locations: Sequence[tuple[str | int, ...]]) -> list[int]:
    """Return places of checks without faults of their own; none if the list itself has one."""
    faulty = [where[1:2] for where in locations if where[0] == "checks"]
    if not faulty or () in faulty:
        return []
    return [place for place in range(len(document.value["checks"])) if (place,) not in faulty]


def _validate_scenario(value: Any) -> Scenario:
    """Validate as JSON and strictly: no text passes for a number, yet a list does for a tuple."""
    return Scenario.model_validate_json(json.dumps(value), strict=True)
