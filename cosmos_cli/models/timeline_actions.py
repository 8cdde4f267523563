"""
Actions that a scenario's timeline may name, and the parameters that its entries give them.

Asked where the simulation is asked: the classes of the parameters are its own code.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from cosmos_cli.errors import Fault
from cosmos_cli.models.document import Document, did_you_mean
from cosmos_cli.models.parameters import adapter_of
from cosmos_cli.models.plugin_values import changed, is_same, not_sendable
from cosmos_cli.models.timeline_rules import ENTRIES_MAX, RULE_KEYS, parameters_in
from cosmos_cli.models.translate import faults_of
from madns_runtime.config import from_mapping, to_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.isolation import is_interruption, said
from madns_runtime.plugin.time_limit import hold
from madns_runtime.timeline.action import ActionKind, Lasting, PlannedAction
from madns_runtime.timeline.kinds import FRAMEWORK_ACTIONS, kinds_by_word


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownAction:
    """A kind of action, without its code."""

    word: str
    summary: str
    takes_agents: bool
    lasting: Lasting
    modes: tuple[str, ...]
    parameters: tuple[str, ...]
    """Names of its parameters."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionAnswers:
    """Knowledge of actions and of an entry's parameters."""

    known: tuple[KnownAction, ...]
    is_complete: bool
    """Whether there are no others: the simulation could be asked for its own."""
    parameters: tuple[dict[str, Any] | None, ...] = ()
    """Of each entry, defaults filled in; None if they are faulty, or the action is not known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenAction:
    """An entry of the simulation's own actions whose parameters are right."""

    place: int
    word: str
    agents: tuple[str, ...]
    """As they are written: names, labels and globs."""
    parameters: Any
    """An instance of its kind's class."""

    def planned(self, agents: tuple[str, ...]) -> PlannedAction:
        """Return it as the simulation is asked about it, with the agents that are meant."""
        return PlannedAction(
            place=f"timeline[{self.place}]",
            word=self.word,
            agents=agents,
            parameters=self.parameters,
        )


FRAMEWORK_ONLY = ActionAnswers(known=(), is_complete=False)


def known_action(kind: ActionKind) -> KnownAction:
    """Return what may travel of a kind."""
    return KnownAction(
        word=kind.word,
        summary=kind.summary,
        takes_agents=kind.takes_agents,
        lasting=kind.lasting,
        modes=kind.modes,
        parameters=tuple(field.name for field in dataclasses.fields(kind.parameters)),
    )


def ask_actions(
    document: Document, declared: Sequence[ActionKind] | None
) -> tuple[ActionAnswers, tuple[WrittenAction, ...], list[Fault]]:
    """
    Validate the parameters of a timeline's entries; return what is known, the simulation's own entries, and the faults.

    Args:
        document: The scenario.
        declared: Actions of its simulation; None if it could not be asked.
    """
    kinds = kinds_by_word(declared or ())
    faults: list[Fault] = []
    parameters = []
    own: list[WrittenAction] = []
    for place, entry in entries_of(document):
        kind = None if entry is None else kinds.get(str(entry.get("action")))
        made: Any = None
        if entry is not None and kind is not None:
            made = _validated(document, place, parameters_in(entry), kind)
            if isinstance(made, list):
                faults += made
                made = None
            elif kind not in FRAMEWORK_ACTIONS:
                agents = _texts(entry.get("agents"))
                own.append(
                    WrittenAction(place=place, word=kind.word, agents=agents, parameters=made)
                )
        parameters.append(None if made is None else to_mapping(made))
    known = [*FRAMEWORK_ACTIONS, *(declared or ())]
    answers = ActionAnswers(
        known=tuple(map(known_action, known)),
        is_complete=declared is not None,
        parameters=tuple(parameters),
    )
    return answers, tuple(own), faults


def entries_of(document: Document) -> Iterator[tuple[int, Mapping[str, Any] | None]]:
    """Yield the entries of a timeline with their places; None for what is no mapping."""
    written = document.value.get("timeline")
    for place, entry in enumerate(written if isinstance(written, list) else ()):
        if place < ENTRIES_MAX:
            yield place, entry if isinstance(entry, dict) else None


def _validated(document: Document, place: int, given: Mapping[str, Any], kind: ActionKind) -> Any:
    """Return an instance of an action's parameters, or a list of the faults of what is given."""
    own = [field.name for field in dataclasses.fields(kind.parameters)]
    unknown = [key for key in given if key not in own]
    faults = [
        document.fault(
            ("timeline", place, key),
            f"unknown key{did_you_mean(key, (*own, *RULE_KEYS))}",
            at_key=True,
        )
        for key in unknown
    ]
    rest = {key: value for key, value in given.items() if key in own}
    made: Any = None
    texts: list[str] = []
    try:
        with hold():
            made = adapter_of(kind.parameters).validate_json(json.dumps(rest), strict=True)
            texts = _faults_of_defaults(kind.parameters, to_mapping(made))
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faults += faults_of(document, errors, kind.parameters, below=("timeline", place))
    except BaseException as error:  # a plug-in's class may raise anything
        if is_interruption(error):
            raise
        texts = [said(error)]
    if texts:  # the file is read for it
        where = f"{place_of(kind.parameters)}: {kind.parameters.__name__}"
        action = ("timeline", place, "action")
        faults += [document.fault(action, f"{where}: {text}") for text in texts]
    return faults or made


def _faults_of_defaults(kind: type, plain: Mapping[str, Any]) -> list[str]:
    """Say what keeps parameters from being made anew where the action takes place: what the scenario gives was looked at."""
    if texts := list(not_sendable(plain, ())):
        return texts
    try:
        found = to_mapping(from_mapping(kind, plain, kind.__name__))
    except ConfigurationError as error:
        told = str(error).removeprefix(f"{kind.__name__}.")
        return [f"{told}; a default must be of its field's type"]
    return [] if is_same(found, plain) else [changed(found, plain)]


def _texts(given: Any) -> tuple[str, ...]:
    return tuple(each for each in given if isinstance(each, str)) if isinstance(given, list) else ()
