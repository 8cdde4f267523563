"""
Answers of a scenario's simulation: whether its code can be imported, its parameters, its faults, its demands.

Code that is not shipped with COSMoS is imported and asked in a process of its own: it may hang, or end the process.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.document import Document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.overrides import parse_override
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.plugin_values import changed, is_same, not_sendable
from cosmos_cli.models.separate_process import (
    SeparateDefect,
    SeparateFailure,
    work_separately,
)
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.variables import judge_open_texts
from madns_runtime import errors as runtime_errors
from madns_runtime.config import Agents, Timeouts, from_mapping, to_mapping
from madns_runtime.errors import ConfigurationError, MadnsError, MissingExtraError, PluginError
from madns_runtime.plugin.api import DeclaredStream, Demand, DeviceUse, PlaceUse, Simulation
from madns_runtime.plugin.code_places import blame, place_of
from madns_runtime.plugin.columns import unknown_columns
from madns_runtime.plugin.isolation import said
from madns_runtime.plugin.queries import (
    ask_check,
    ask_demand,
    ask_device_uses,
    ask_labels,
    ask_place_uses,
    ask_streams,
)
from madns_runtime.plugin.registry import (
    is_file,
    is_shipped,
    parse_parameters,
    part_faults,
    resolve,
)
from madns_runtime.plugin.time_limit import PluginStopped, hold

_CODE = re.compile(r"[\w./~-]+:[A-Za-z_]\w*")
"""Form in which a parameter names code of one's own: guidance.py:Guidance, package.module:Class."""

Tell = Callable[[str], None]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PluginAnswers:
    """Answers of the simulation."""

    faults: tuple[Fault, ...]
    parameters: dict[str, Any] | None
    """Parameters as a plain mapping, defaults filled in; None if they are faulty or nobody could be asked."""
    has_demand: bool = False
    streams: tuple[DeclaredStream, ...] | None = None
    """Streams as it declares them; None if it declares none, or nobody could be asked."""
    labels: AgentLabels | None = NO_LABELS
    """Second names of agents; None if the simulation could not be asked for those it gives."""
    device_uses: tuple[DeviceUse, ...] = ()
    """Channels of devices that the parameters name; empty if nobody could be asked."""
    place_uses: tuple[PlaceUse, ...] = ()
    """What each agent takes of its machine for itself; empty if nobody could be asked."""
    placeholders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Words that it replaces itself, by field."""
    omitted: int = 0
    """Number of further faults."""


def ask_plugin(
    document: Document, agents: Agents | None, base_directory: Path, *, duration_s: float = 0.0
) -> PluginAnswers:
    """
    Return what the simulation that a scenario names says to its parameters.

    Args:
        document: The scenario.
        agents: Its agents; None if they are faulty, and then `check` is not asked.
        base_directory: Folder of the scenario.
        duration_s: Simulated, of the run.

    Raises:
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    spec = document.value.get("simulation")
    if not isinstance(spec, str) or not spec:
        return PluginAnswers(faults=(), parameters=None)  # the model has said so already

    def work(tell: Tell) -> PluginAnswers:
        return _Asking(document, agents, base_directory, tell).answers(spec, duration_s)

    try:
        return _do(work, PluginAnswers, document, spec)
    except SeparateFailure as failure:
        fault = document.fault(("simulation",), str(failure))
        return PluginAnswers(faults=(fault,), parameters=None)


def ask_plugin_demand(
    document: Document, parameters: Mapping[str, Any], agents: Agents, base_directory: Path
) -> Demand:
    """
    Return what the simulation asks of host and network.

    Args:
        document: The scenario.
        parameters: As `ask_plugin` returned them.
        agents: Of the scenario.
        base_directory: Its folder.

    Raises:
        PluginError: It raised, returned no proper Demand, or did not come to an end.
        MissingExtraError: It needs an optional dependency that is not installed.
    """
    spec = str(document.value["simulation"])

    def work(tell: Tell) -> Demand:
        tell(f"importing {spec}")
        simulation = resolve(spec, base_directory)
        tell(f"demand() of {spec}")
        return ask_demand(
            str(simulation.demand),
            base_directory,
            parameters=parse_parameters(simulation, parameters),
            agents=agents.count,
            tick_hz=agents.tick_hz,
        )

    try:
        return _do(work, Demand, document, spec)
    except SeparateFailure as failure:
        raise PluginError(str(failure)) from None


def _do(work: Callable[[Tell], T], kind: type[T], document: Document, spec: str) -> T:
    """Return what *work* does: here if the simulation is shipped, else in a process of its own."""
    if is_shipped(spec) and not _names_code(document.value.get("parameters")):
        return work(lambda doing: None)

    def guarded(tell: Tell) -> Mapping[str, Any]:
        try:
            return {"value": to_mapping(work(tell))}
        except MissingExtraError as error:
            return {"missing": [error.module, error.extra]}
        except MadnsError as error:
            return {"raised": [type(error).__name__, str(error)]}

    try:
        answer = work_separately(guarded, limit_s=_limit_s(document))
    except SeparateDefect as defect:
        raise RuntimeError(str(defect)) from None
    if "missing" in answer:
        raise MissingExtraError(*answer["missing"])
    if "raised" in answer:
        name, text = answer["raised"]
        raise getattr(runtime_errors, name, PluginError)(text)
    return from_mapping(kind, answer["value"])


def _limit_s(document: Document) -> float:
    """Return what the scenario gives its plug-in, as far as that can be told yet."""
    timeouts = document.value.get("timeouts")
    value = timeouts.get("loading_s") if isinstance(timeouts, dict) else None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and 0 < value <= 3600 else Timeouts().loading_s  # type: ignore[operator,arg-type]


def _names_code(value: Any) -> bool:
    if isinstance(value, str):
        return _CODE.fullmatch(value) is not None
    if isinstance(value, dict):
        return any(map(_names_code, value.values()))
    return isinstance(value, list) and any(map(_names_code, value))


class _Asking:
    """Asks, here and now."""

    def __init__(
        self, document: Document, agents: Agents | None, base_directory: Path, tell: Tell
    ) -> None:
        self._document, self._agents = document, agents
        self._base_directory, self._tell = base_directory, tell
        self._faults: list[Fault] = []

    def answers(self, spec: str, duration_s: float) -> PluginAnswers:
        """Return faults, parameters and whether there is a `demand`."""
        simulation = self._simulation(spec)
        parameters = None if simulation is None else self._parameters(simulation)
        streams: tuple[DeclaredStream, ...] | None = None
        labels: AgentLabels | None = NO_LABELS
        uses: tuple[DeviceUse, ...] = ()
        places: tuple[PlaceUse, ...] = ()
        if simulation is not None and parameters is not None and self._agents is not None:
            self._check(simulation, parameters, self._agents, duration_s)
            streams = self._streams(simulation, parameters, self._agents)
            labels = self._labels(simulation, parameters, self._agents)
            uses = self._uses(ask_device_uses, simulation.device_uses, parameters, self._agents)
            places = self._uses(ask_place_uses, simulation.place_uses, parameters, self._agents)
        elif simulation is not None and simulation.labels is not None:
            labels = None
        first = self._faults[:FAULTS_SHOWN_MAX]
        return PluginAnswers(
            faults=tuple(fault.clipped() for fault in first),
            omitted=len(self._faults) - len(first),
            parameters=None if parameters is None else to_mapping(parameters),
            has_demand=simulation is not None and simulation.demand is not None,
            streams=streams,
            labels=labels,
            device_uses=uses,
            place_uses=places,
            placeholders={} if simulation is None else simulation.placeholders,
        )

    def _blame(self, *texts: str) -> None:
        """Enter faults of the simulation itself."""
        self._faults += [self._document.fault(("simulation",), text) for text in texts]

    def _simulation(self, spec: str) -> Simulation | None:
        self._tell(f"importing {spec}")
        try:
            simulation = resolve(spec, self._base_directory)
        except MadnsError as error:
            self._blame(str(error))
            return None
        except OSError as error:  # such as a name that is too long for a file
            self._blame(f"not to be found: {error.strerror}")
            return None
        # Whoever writes a file wants to hear of all its slips; an installed simulation's halves stay unloaded.
        self._tell(f"importing the parts of {spec}")
        self._blame(*(part_faults(simulation, self._base_directory) if is_file(spec) else ()))
        return simulation

    def _parameters(self, simulation: Simulation) -> Any:
        opened = judge_open_texts(self._document, simulation.placeholders)
        self._faults += opened
        value = self._document.value.get("parameters", {})
        if not isinstance(value, Mapping):
            return None  # the model has said so already
        kind = simulation.parameters
        self._tell(f"making the parameters ({kind.__name__}) of {simulation.name}")
        try:
            with hold():
                adapter = adapter_of(kind)
                found = to_mapping(adapter.validate_json(json.dumps(value), strict=True))
                # As agents make them: what is asked here is asked of the same object.
                parameters = parse_parameters(simulation, found)
        except ValidationError as error:
            self._document.value.setdefault("parameters", {})
            errors = error.errors(include_url=False)
            places = {(fault.file, fault.line, fault.column) for fault in opened}
            found_faults = faults_of(self._document, errors, kind, below=("parameters",))
            self._faults += [f for f in found_faults if (f.file, f.line, f.column) not in places]
            return None
        except ConfigurationError as error:  # what the scenario gives was found right above
            told = str(error).removeprefix("parameters.")
            texts = [f"{_place(kind)}.{told}; a default must be of its field's type"]
        except MadnsError as error:
            texts = [str(error)]
        except (Exception, SystemExit, PluginStopped) as error:  # noqa: BLE001 - a plug-in's class may raise anything
            texts = [f"{blame(error, kind)}: {kind.__name__}: {said(error)}"]
        else:
            made = to_mapping(parameters)
            wrong = list(not_sendable(made, ()))
            if not wrong and not is_same(made, found):
                wrong = [changed(made, found)]
            texts = [f"{_place(kind)}: {text}" for text in wrong]
        self._blame(*texts)
        return None if texts or opened else parameters

    def _check(
        self, simulation: Simulation, parameters: Any, agents: Agents, duration_s: float
    ) -> None:
        """Ask the simulation itself: it knows of missing files and of what fits together."""
        if simulation.check is None:
            return
        self._tell(f"check() of {simulation.name}")
        try:
            texts = ask_check(
                simulation.check,
                self._base_directory,
                parameters=parameters,
                agents=agents.count,
                names=agents.resolved_names(),
                duration_s=duration_s,
                is_lockstep=_is_lockstep(self._document),
                tick_hz=agents.tick_hz,
            )
        except PluginError as error:
            self._blame(str(error))
        else:
            self._faults += [fault_found_at(self._document, text) for text in texts]

    def _streams(
        self, simulation: Simulation, parameters: Any, agents: Agents
    ) -> tuple[DeclaredStream, ...] | None:
        found: tuple[DeclaredStream, ...] | None = None
        where, names = simulation.streams, agents.resolved_names()
        if where is not None:
            self._tell(f"streams() of {simulation.name}")
            try:
                found = ask_streams(
                    where, self._base_directory, parameters=parameters, agents=names
                )
            except PluginError as error:
                self._blame(str(error))
                return None
        self._blame(*unknown_columns(simulation.columns, found or ()))
        return found

    def _labels(
        self, simulation: Simulation, parameters: Any, agents: Agents
    ) -> AgentLabels | None:
        if simulation.labels is None:
            return NO_LABELS
        self._tell(f"labels() of {simulation.name}")
        where, names = simulation.labels, agents.resolved_names()
        try:
            found = ask_labels(where, self._base_directory, parameters=parameters, agents=names)
        except MadnsError as error:
            if (
                not self._faults
            ):  # a check that could not choose what labels are made of has said why
                self._blame(str(error))
            return None
        return AgentLabels(column=simulation.label_column, names=found)

    def _uses(
        self, ask: Callable[..., tuple[T, ...]], where: str | None, parameters: Any, agents: Agents
    ) -> tuple[T, ...]:
        """Ask what the parameters make agents use: channels of devices, or places of their machines."""
        if where is None or self._faults:  # what is faulty names nothing that can be looked for
            return ()
        self._tell(f"{where}()")
        names = agents.resolved_names()
        try:
            return ask(where, self._base_directory, parameters=parameters, agents=names)
        except MadnsError as error:
            self._blame(str(error))
            return ()


def _place(kind: type) -> str:
    """Return where a class of parameters stands, and its name: for a fault alone, as its file is read for it."""
    return f"{place_of(kind)}: {kind.__name__}"


def fault_found_at(document: Document, text: str) -> Fault:
    """Return a fault at the place of `dotted.name: what is wrong`; the name may leave out `parameters.`."""
    name, colon, message = text.partition(":")
    path: ValuePath = ("parameters",)
    if not colon or " " in name:
        return document.fault(path, text, at_key=True)
    try:
        steps = parse_override(f"{name}=")[1]
    except InputError:
        return document.fault(path, text, at_key=True)
    path = steps if steps[:1] == path else path + steps
    return document.fault(path, message.strip())


def _is_lockstep(document: Document) -> bool:
    """Return whether a scenario without faults of its own runs in lockstep."""
    time = document.value.get("time")
    return isinstance(time, Mapping) and time.get("mode") == "lockstep"
