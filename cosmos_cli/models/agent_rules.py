"""Rules that give some agents parameters of their own: whom they find, and what results of each."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from cosmos_cli.errors import Fault
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.document import Document, Path, did_you_mean, dotted, may_guess
from cosmos_cli.models.extending import merge_mapping
from madns_runtime.plugin.api import Simulation

RULES: Final = "agent_parameters"


def select_agents(
    document: Document, names: Sequence[str], labels: AgentLabels | None
) -> tuple[list[tuple[str, ...]], list[Fault]]:
    """
    Return the agents of each rule, of which the first that finds an agent holds for it, and the faults.

    Args:
        document: The scenario, its rules of the right form.
        names: Of all agents.
        labels: Their second names; None if they are not known, and then no rule holds.
    """
    rules: Sequence[Mapping[str, Any]] = document.value.get(RULES) or ()
    if not rules or labels is None:
        return [() for _ in rules], []
    faults: list[Fault] = []
    taken: dict[str, int] = {}
    chosen = []
    for index, rule in enumerate(rules):
        fitting: dict[str, None] = {}
        for place, pattern in enumerate(rule["agents"]):
            found = labels.like(pattern, names)
            fitting |= dict.fromkeys(found)
            if not found:
                known = (*names, *labels.names.values())
                hint = did_you_mean(pattern, known) if may_guess(len(faults), len(known)) else ""
                like = "like" if any(character in pattern for character in "*?[") else "named"
                text = f"no agent is {like} {pattern}{hint if hint.endswith('?') else ''}"
                faults.append(document.fault((RULES, index, "agents", place), text))
        own = tuple(name for name in names if name in fitting and name not in taken)
        if fitting and not own:
            first = taken[next(iter(fitting))]
            text = f"expected agents that no rule above finds, got those of {RULES}[{first}]: the first that fits holds"
            faults.append(document.fault((RULES, index, "agents"), text))
        taken |= dict.fromkeys(own, index)
        chosen.append(own)
    return chosen, faults


def faults_in_rules(document: Document, faults: Sequence[Fault]) -> list[Fault]:
    """Return the faults of values and keys that rules themselves write: others are of the parameters of all."""
    places = (*document.value_places, *document.key_places)
    written = {dotted(path) for path in places if path[:1] == (RULES,)}
    return [fault for fault in faults if fault.path in written]


def refused_parameters(
    document: Document,
    index: int,
    simulation: Simulation,
    *,
    found: Mapping[str, Any],
    of_all: Mapping[str, Any],
) -> Iterator[Fault]:
    """
    Yield a fault for each parameter that a rule gives another value, and the simulation lets none.

    Args:
        document: The scenario.
        index: Of the rule.
        simulation: Its descriptor.
        found: The parameters that result of the rule.
        of_all: Those of all.
    """
    allowed = simulation.agent_parameters
    if allowed is None:
        return
    cure = f"per agent are {', '.join(allowed)}"
    if not allowed:
        cure = "rules for agents, where it has them, are among its parameters"
    for name in document.value[RULES][index]["parameters"]:
        if name not in allowed and found.get(name) != of_all.get(name):
            text = f"holds for all agents of {simulation.name}: {cure}"
            yield document.fault((RULES, index, "parameters", name), text, at_key=True)


def rule_document(document: Document, index: int) -> Document:
    """Return a document whose `parameters` are those of the rule at *index*, over those of all, with their places."""
    above: Path = (RULES, index, "parameters")
    value = {
        **document.value,
        "parameters": copy.deepcopy(document.value[RULES][index]["parameters"]),
    }
    own = Document(document.source, value=value)
    for target, places in (
        (own.value_places, document.value_places),
        (own.key_places, document.key_places),
    ):
        for path, place in places.items():
            if path[: len(above)] == above:
                inner: Path = ("parameters", *path[len(above) :])
                target[inner] = dataclasses.replace(place, path=place.path or path)
            elif path[:1] != ("parameters",):
                target[path] = place
    for path, text in document.texts.items():
        if path[: len(above)] == above:
            own.texts[("parameters", *path[len(above) :])] = text
    if (
        "parameters",
    ) not in own.value_places:  # of --set, which knows the place of the whole alone
        place = document.place(above)
        own.value_places["parameters",] = dataclasses.replace(place, path=place.path or above)
    lower = copy.deepcopy(document.value.get("parameters") or {})
    merge_mapping(own, document, lower, ("parameters",))
    return own
