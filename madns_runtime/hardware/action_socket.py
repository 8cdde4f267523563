"""
Actions ordered while a run goes on, by the words of its timeline: `cosmos inject` connects to a socket of the host.

The socket lies in the run directory and is this user's alone. What is ordered is checked here as a scenario is before a run.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, get_type_hints

import orjson

from madns_runtime.config import RunConfig
from madns_runtime.declared_bounds import bound_faults
from madns_runtime.errors import ConfigurationError, MadnsError
from madns_runtime.hardware.fault_actions import check_fault
from madns_runtime.hardware.order_socket import TOO_DEEP, LineSocket, Readers
from madns_runtime.plain_values import from_mapping, is_real, shown, to_mapping
from madns_runtime.similar_words import did_you_mean
from madns_runtime.timeline.action import ActionKind
from madns_runtime.timeline.kinds import DEVICE_FAULT, DeviceFault
from madns_runtime.timeline.runner import OrderedAction, TimelineRunner

SOCKET_NAME: Final = ".actions.sock"
IN_FORCE_TOLD_MAX: Final = 100
AGENTS_TOLD_MAX: Final = 20
IN_FORCE_BYTES_MAX: Final = 65_536
"""Bytes of all actions in force that are told: a socket takes more at once, by default 160 KiB on a small board."""
_PLAIN: Final = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
}
"""Python's kinds of values as a scenario's faults call them."""
_KIND_EXPECTED: Final = re.compile(rf"\bexpected ({'|'.join(_PLAIN)}),")
WHOLE_RUN: Final = "run"
"""Target of an action that acts on no agents."""

Begin = Callable[[OrderedAction], str]
"""Begins an action and returns why it is refused, "" if it takes place."""


def open_action_socket(  # noqa: PLR0913 - both time modes give what is theirs, all but two keyword-only
    folder: Path,
    loop: Readers,
    *,
    config: RunConfig,
    kinds: Mapping[str, ActionKind],
    runner: TimelineRunner,
    begin: Begin,
    say: Callable[[str, str], None],
    is_immediate: bool = True,
) -> ActionSocket | None:
    """
    Return the socket through which actions of a run are ordered; None, and a warning, where it cannot be made.

    Args:
        folder: The run directory.
        loop: Of the host.
        config: The run's.
        kinds: Actions that this run carries out, by word.
        runner: Knows what is in force.
        begin: Called with what is ordered.
        say: Takes the level and the text of the warning.
        is_immediate: As of `ActionSocket`.
    """
    try:
        return ActionSocket(
            folder,
            loop,
            kinds=kinds,
            agents=config.agents.resolved_names(),
            devices=config.hardware.names,
            begin=begin,
            in_force=runner.told_in_force,
            is_immediate=is_immediate,
        )
    except OSError as error:
        say("warning", f"no action can be ordered in this run: {error}")
        return None


class ActionSocket:
    """
    The socket of one run.

    Args:
        folder: The run directory.
        loop: Of the host.
        kinds: Actions that this run carries out, by word.
        agents: Names of all agents.
        devices: Names by which agents know their devices.
        begin: Called with what is ordered.
        in_force: Returns what is in force, in plain values.
        is_immediate: Whether orders are carried out when they come; otherwise `carry_out` does it.

    Raises:
        OSError: It cannot be made there.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        folder: Path,
        loop: Readers,
        *,
        kinds: Mapping[str, ActionKind],
        agents: Sequence[str],
        devices: Sequence[str],
        begin: Begin,
        in_force: Callable[[], Sequence[Mapping[str, Any]]],
        is_immediate: bool = True,
    ) -> None:
        self._kinds = kinds
        self._agents = agents
        self._devices = devices
        self._begin = begin
        self._in_force = in_force
        self._is_immediate = is_immediate
        self._waiting: list[tuple[int, OrderedAction]] = []
        self._socket = LineSocket(folder, SOCKET_NAME, loop=loop, on_line=self._heard)

    def carry_out(self) -> None:
        """Carry out what was ordered since the last call."""
        waiting, self._waiting = self._waiting, []
        for number, order in waiting:
            self._socket.tell(number, {"refusal": self._begin(order)})

    def close(self) -> None:
        """Refuse what waits, and take no more orders."""
        for number, _ in self._waiting:
            self._socket.tell(number, {"refusal": "the run is over"})
        self._waiting.clear()
        self._socket.close()

    def _heard(self, number: int, line: bytes) -> None:
        try:
            order = orjson.loads(line)
            if not isinstance(order, dict):
                raise ConfigurationError("no order")
            if order.get("list"):
                self._socket.tell(number, self._listed())
                return
            self._waiting.append((number, self._parsed(order)))
        except RecursionError:
            self._socket.tell(number, {"refusal": TOO_DEEP})
            return
        except (ValueError, TypeError, MadnsError) as error:
            self._socket.tell(number, {"refusal": str(error)})
            return
        if self._is_immediate:
            self.carry_out()

    def _listed(self) -> dict[str, Any]:
        actions = [
            {
                "action": kind.word,
                "summary": kind.summary,
                "takes_agents": kind.takes_agents,
                "parameters": [field.name for field in dataclasses.fields(kind.parameters)],
                "for_s": kind.lasting,
            }
            for kind in self._kinds.values()
        ]
        in_force = list(self._in_force())
        return {
            "refusal": "",
            "actions": actions,
            "in_force": _first_of(in_force),
            "in_force_count": len(in_force),
        }

    def _parsed(self, order: Mapping[str, Any]) -> OrderedAction:
        """
        Return what is ordered.

        Raises:
            ConfigurationError: It is no action of this run, or its target, parameters or length do not fit.
        """
        word, target = str(order.get("action")), str(order.get("target"))
        kind = self._kinds.get(word)
        if kind is None:
            hint = did_you_mean(word, self._kinds) or f"; there are {', '.join(self._kinds)}"
            raise ConfigurationError(f"no action {word!r} in this run{hint}")
        parameters = order.get("parameters")
        given = dict(parameters) if isinstance(parameters, dict) else {}
        _take_texts(kind, given, order.get("texts"))
        made = _made(kind, given)
        if faults := bound_faults(made, word):
            raise ConfigurationError("; ".join(faults))
        agents = self._chosen(kind, target, order.get("agents"))
        if kind is DEVICE_FAULT:
            self._check_device_fault(made)
        return OrderedAction(
            word=word,
            agents=agents,
            parameters=_told(kind, made),
            for_s=_length_s(kind, order.get("for_s")),
        )

    def _check_device_fault(self, fault: DeviceFault) -> None:
        """
        Refuse a fault of a device that no agent would carry out.

        Raises:
            ConfigurationError: There is no such device, or the fault's value is none.
        """
        check_fault(fault.fault, fault.value)
        if fault.device not in self._devices:
            shown = ", ".join(self._devices[:AGENTS_TOLD_MAX]) or "none"
            raise ConfigurationError(
                f"no agent knows a device {fault.device!r:.80}; there are {shown}"
            )

    def _chosen(self, kind: ActionKind, target: str, others: Any) -> tuple[str, ...]:
        """
        Return the agents that a target finds by name, and those of *others*, whom it finds by what is not known here.

        Raises:
            ConfigurationError: There is none, or the action acts on no agents.
        """
        if not kind.takes_agents:
            if target != WHOLE_RUN:
                raise ConfigurationError(
                    f"{kind.word} acts on the whole run: expected {WHOLE_RUN!r}, got {target!r}"
                )
            return ()
        found = {*fnmatch.filter(self._agents, target), *(others if _is_names(others) else ())}
        chosen = tuple(agent for agent in self._agents if agent in found)
        if not chosen:
            shown = ", ".join(self._agents[:AGENTS_TOLD_MAX])
            raise ConfigurationError(f"no agent is named {target}; there are {shown}")
        return chosen


def _is_names(others: Any) -> bool:
    return isinstance(others, list) and all(isinstance(other, str) for other in others)


def _take_texts(kind: ActionKind, given: dict[str, Any], texts: Any) -> None:
    """Take values as they were written on a command line, such as `text=5`, where the action wants a text."""
    wanted = get_type_hints(kind.parameters)
    for name, text in texts.items() if isinstance(texts, dict) else ():
        if wanted.get(name) is str and name in given and isinstance(text, str):
            given[name] = text


def _made(kind: ActionKind, given: Mapping[str, Any]) -> Any:
    """
    Return an instance of an action's parameters.

    Raises:
        ConfigurationError: They do not fit, or their class, which may be a plug-in's, refuses them.
    """
    try:
        return from_mapping(kind.parameters, given, kind.word)
    except ConfigurationError as error:
        told = _KIND_EXPECTED.sub(lambda found: f"expected {_PLAIN[found[1]]},", str(error))
        raise ConfigurationError(told) from error
    except MadnsError:
        raise
    except Exception as error:  # its own __post_init__ may raise anything
        raise ConfigurationError(
            f"{kind.word}: {kind.parameters.__name__} cannot be made: {shown(error)}"
        ) from error


def _told(kind: ActionKind, made: Any) -> dict[str, Any]:
    """
    Return an action's parameters as events and agents are told them.

    Raises:
        ConfigurationError: A default is no value that can be told; in a timeline it is found before the run.
    """
    plain = to_mapping(made)
    try:
        orjson.dumps(plain)
    except TypeError as error:
        raise ConfigurationError(f"{kind.word}: its parameters cannot be told: {error}") from error
    return plain


def _first_of(in_force: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the first IN_FORCE_TOLD_MAX actions in force, or as many as fit an answer."""
    told: list[dict[str, Any]] = []
    size_bytes = 0
    for each in map(_shortened, in_force[:IN_FORCE_TOLD_MAX]):
        size_bytes += len(orjson.dumps(each))
        if size_bytes > IN_FORCE_BYTES_MAX:
            break
        told.append(each)
    return told


def _shortened(in_force: Mapping[str, Any]) -> dict[str, Any]:
    """Return an action in force with the first of its agents and their number."""
    agents = list(in_force.get("agents", ()))
    return {**in_force, "agents": agents[:AGENTS_TOLD_MAX], "agents_count": len(agents)}


def _length_s(kind: ActionKind, for_s: Any) -> float | None:
    if for_s is None:
        if kind.lasting == "must":
            raise ConfigurationError(f"{kind.word} needs for_s: how long it lasts, s")
        return None
    if not is_real(for_s) or not math.isfinite(for_s) or for_s <= 0:
        raise ConfigurationError(f"for_s: expected more than 0 s, got {for_s!r:.80}")
    if kind.lasting == "never":
        raise ConfigurationError(f"{kind.word} has no end: leave out for_s")
    return float(for_s)
