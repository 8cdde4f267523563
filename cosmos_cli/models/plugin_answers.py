"""
Answers of a scenario's simulation: whether its code can be imported, its parameters, its faults, its demands.

Code that is not shipped with COSMoS is imported and asked in a process of its own: it may hang, or end the process.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault
from cosmos_cli.models.agent_labels import NO_LABELS, AgentLabels
from cosmos_cli.models.agent_rules import (
    RULES,
    faults_in_rules,
    refused_parameters,
    rule_document,
    select_agents,
)
from cosmos_cli.models.declared_streams import AgentStreams, every_stream
from cosmos_cli.models.document import Document
from cosmos_cli.models.fault_place import fault_found_at
from cosmos_cli.models.parameter_answers import ParameterAnswers, of_all_agents
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.plugin_process import Tell, ask_apart
from cosmos_cli.models.plugin_values import changed, is_same, not_sendable
from cosmos_cli.models.separate_process import SeparateFailure
from cosmos_cli.models.timeline_actions import (
    FRAMEWORK_ONLY,
    ActionAnswers,
    WrittenAction,
    ask_actions,
)
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.variables import judge_open_texts
from cosmos_cli.ui.plural import counted
from madns_runtime.agent_parameters import AgentParameters
from madns_runtime.config import Agents, to_mapping
from madns_runtime.errors import ConfigurationError, MadnsError, PluginError
from madns_runtime.plugin.api import DeclaredStream, DeviceUse, PlaceUse, Simulation
from madns_runtime.plugin.code_places import blame, place_of_class
from madns_runtime.plugin.columns import label_column_remarks, unknown_columns
from madns_runtime.plugin.isolation import is_interruption, said
from madns_runtime.plugin.queries import (
    ask_check,
    ask_check_actions,
    ask_device_uses,
    ask_labels,
    ask_place_uses,
    ask_streams,
)
from madns_runtime.plugin.registry import (
    is_file,
    parse_parameters,
    part_faults,
    resolve,
)
from madns_runtime.plugin.time_limit import hold

T = TypeVar("T")
REMARK = "remark: "
"""With this a text of `check` begins that tells of no fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PluginAnswers:
    """Answers of the simulation."""

    faults: tuple[Fault, ...]
    parameters: dict[str, Any] | None
    """Parameters as a plain mapping, defaults filled in; None if they are faulty or nobody could be asked."""
    has_demand: bool = False
    agent_parameters: tuple[AgentParameters, ...] = ()
    """Whole parameters of agents for which others hold."""
    streams: tuple[DeclaredStream, ...] | None = None
    """Streams as it declares them; None if it declares none, or nobody could be asked."""
    agent_streams: tuple[AgentStreams, ...] = ()
    """Streams of agents for which it declares others."""
    labels: AgentLabels | None = None
    """Second names of agents; None if the simulation could not be asked for those it gives."""
    device_uses: tuple[DeviceUse, ...] = ()
    """Channels of devices that the parameters name; empty if nobody could be asked."""
    place_uses: tuple[PlaceUse, ...] = ()
    """Places of its machine that each agent takes for itself; empty if nobody could be asked."""
    placeholders: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Words that it replaces itself, by field."""
    actions: ActionAnswers = FRAMEWORK_ONLY
    """Actions that a timeline may name, and the parameters of the entries of this one."""
    omitted: int = 0
    """Number of further faults."""
    remarks: tuple[Fault, ...] = ()
    """Remarks of its check on what is odd, and no fault."""


def ask_plugin(
    document: Document, agents: Agents | None, base_directory: Path, *, duration_s: float
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
        return ask_apart(work, PluginAnswers, document, spec)
    except SeparateFailure as failure:
        fault = document.fault(("simulation",), str(failure))
        return PluginAnswers(faults=(fault,), parameters=None)


class _Asking:
    """Asks, here and now."""

    def __init__(
        self, document: Document, agents: Agents | None, base_directory: Path, tell: Tell
    ) -> None:
        self._document, self._agents = document, agents
        self._base_directory, self._tell = base_directory, tell
        self._faults: list[Fault] = []
        self._remarks: list[Fault] = []
        self._omitted = 0

    def answers(self, spec: str, duration_s: float) -> PluginAnswers:
        """Return faults, parameters and whether there is a `demand`."""
        simulation = self._simulation(spec)
        actions, own_actions, faults = ask_actions(
            self._document, None if simulation is None else simulation.actions
        )
        self._faults += faults
        if simulation is None:
            return self._told(PluginAnswers(faults=(), parameters=None, actions=actions))
        opened = judge_open_texts(self._document, simulation.placeholders)
        self._faults += opened
        parameters = self._parameters(simulation, opened)
        found = PluginAnswers(
            faults=(),
            parameters=None if parameters is None else to_mapping(parameters),
            has_demand=simulation.demand is not None,
            labels=NO_LABELS if simulation.labels is None else None,
            placeholders=simulation.placeholders,
            actions=actions,
        )
        if self._agents is not None and parameters is None:
            self._rules(simulation, self._agents, found, duration_s)
        elif self._agents is not None:
            own = self._of(simulation, parameters, self._agents, duration_s)
            found = replace(found, labels=self._labels(simulation, parameters, self._agents))
            rules = self._rules(simulation, self._agents, found, duration_s)
            found = replace(found, **of_all_agents(own, rules))
            streams = every_stream(found.streams or (), found.agent_streams)
            # What could not be asked is told already.
            if simulation.streams is None or None not in [each.streams for each in (own, *rules)]:
                self._blame(*unknown_columns(simulation.columns, streams))
            if simulation.labels is not None:
                taken = dict.fromkeys(label_column_remarks(simulation.label_column, streams))
                self._remarks += [self._document.fault(("simulation",), text) for text in taken]
            self._check_actions(simulation, parameters, own_actions, found.labels)
        return self._told(found)

    def _told(self, found: PluginAnswers) -> PluginAnswers:
        first = self._faults[:FAULTS_SHOWN_MAX]
        omitted = self._omitted + len(self._faults) - len(first)
        return replace(
            found,
            faults=tuple(fault.clipped() for fault in first),
            omitted=omitted,
            remarks=tuple(remark.clipped() for remark in self._remarks),
        )

    def _of(
        self, simulation: Simulation, parameters: Any, agents: Agents, duration_s: float
    ) -> ParameterAnswers:
        """Ask all that follows from one set of parameters."""
        # Before anybody is asked: lists and mappings of it can be changed.
        plain = to_mapping(parameters)
        self._check(simulation, parameters, agents, duration_s)
        return ParameterAnswers(
            parameters=plain,
            streams=self._streams(simulation, parameters, agents),
            device_uses=self._uses(ask_device_uses, simulation.device_uses, parameters, agents),
            place_uses=self._uses(ask_place_uses, simulation.place_uses, parameters, agents),
        )

    def _rules(
        self, simulation: Simulation, agents: Agents, of_all: PluginAnswers, duration_s: float
    ) -> list[ParameterAnswers]:
        """Ask the same of the parameters that rules give some agents; of faulty ones for all, what is written in rules."""
        given = self._document.value.get(RULES) or ()
        names = agents.resolved_names()
        chosen, faults = select_agents(self._document, names, of_all.labels)
        self._faults += faults
        found = []
        for index in range(len(given)):
            document = rule_document(self._document, index)
            asking = _Asking(document, agents, self._base_directory, self._tell)
            parameters = asking._parameters(simulation, ())
            if of_all.parameters is None:  # nor is it known what more the rule's would have to fit
                asking._faults = faults_in_rules(self._document, asking._faults)
            elif parameters is not None:
                one = asking._of(simulation, parameters, agents, duration_s)
                found.append(replace(one, agents=chosen[index]))
                self._faults += refused_parameters(
                    self._document,
                    index,
                    simulation,
                    found=one.parameters,
                    of_all=of_all.parameters or {},
                )
            self._faults += [fault for fault in asking._faults if fault not in self._faults]
            self._remarks += [each for each in asking._remarks if each not in self._remarks]
            self._omitted += asking._omitted
        return found

    def _blame(self, *texts: str) -> None:
        """Enter faults of the simulation itself."""
        self._faults += [self._document.fault(("simulation",), text) for text in texts]

    def _blame_texts(self, texts: Sequence[str], section: str = "parameters") -> None:
        """Enter faults that the simulation itself finds; those that are not shown are counted."""
        first = texts[:FAULTS_SHOWN_MAX]
        self._omitted += len(texts) - len(first)
        self._faults += [fault_found_at(self._document, text, section=section) for text in first]

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

    def _parameters(self, simulation: Simulation, opened: Sequence[Fault]) -> Any:
        """Return the parameters; None if they have faults, and *opened* are those that are told already."""
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
            texts = [f"{place_of_class(kind)}.{told}; a default must be of its field's type"]
        except MadnsError as error:
            texts = [str(error)]
        except BaseException as error:  # a plug-in's class may raise anything
            if is_interruption(error):
                raise
            texts = [f"{blame(error, kind)}: {kind.__name__}: {said(error)}"]
        else:
            made = to_mapping(parameters)
            wrong = list(not_sendable(made, ()))
            if not wrong and not is_same(made, found):
                wrong = [changed(made, found)]
            texts = [f"{place_of_class(kind)}: {text}" for text in wrong]
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
            self._blame_texts([text for text in texts if not text.startswith(REMARK)])
            remarks = [text.removeprefix(REMARK) for text in texts if text.startswith(REMARK)]
            if (more := len(remarks) - FAULTS_SHOWN_MAX) > 0:
                remarks[FAULTS_SHOWN_MAX:] = [f"{counted(more, 'more remark')}"]
            self._remarks += [fault_found_at(self._document, text) for text in remarks]

    def _check_actions(
        self,
        simulation: Simulation,
        parameters: Any,
        written: Sequence[WrittenAction],
        labels: AgentLabels | None,
    ) -> None:
        """Ask the simulation what is wrong with its own actions of the timeline, among agents that are known."""
        where = simulation.check_actions
        if where is None or labels is None or self._agents is None or not written:
            return
        names = self._agents.resolved_names()
        self._tell(f"check_actions() of {simulation.name}")
        try:
            texts = ask_check_actions(
                where,
                self._base_directory,
                parameters=parameters,
                actions=tuple(
                    each.planned(tuple(labels.like_any(each.agents, names))) for each in written
                ),
                agents=names,
            )
        except PluginError as error:
            self._blame(str(error))
        else:
            self._blame_texts(texts, section="timeline")

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
            # A check that could not choose what labels are made of has said why.
            if not self._faults:
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


def _is_lockstep(document: Document) -> bool:
    """Return whether a scenario without faults of its own runs in lockstep."""
    time = document.value.get("time")
    return isinstance(time, Mapping) and time.get("mode") == "lockstep"
