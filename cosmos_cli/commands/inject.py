"""`cosmos inject`: an action of a timeline, or a fault around a device, in a living run."""

from __future__ import annotations

import fnmatch
import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml

from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.launch.order_socket import order_action, order_fault
from cosmos_cli.models.overrides import parse_override
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.fault_actions import check_fault

FOR_S = "for_s"
WHOLE_RUN = "run"
CONTEXT_SETTINGS = {"ignore_unknown_options": True}
"""A value below zero is none; what else looks like one is refused by `_refuse_options`."""


TargetArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="[TARGET]",
        help="An agent or a glob of agents, by name or second name, run for the whole run, or a device's full name such as pi22/imu.",
    ),
]
ActionArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="[ACTION]",
        help="A word of the timeline; of a device freeze, bias, noise, drop, delay, disconnect or clear.",
    ),
]
ValuesArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[KEY=VALUE]...",
        help="The action's parameters, and for_s; of a device the one value of bias, noise, drop (0 to 1) or delay (s).",
    ),
]
ListOption = Annotated[
    bool, typer.Option("--list", help="What may be ordered of this run, and what is in force.")
]


def inject(
    run: RunArgument,
    target: TargetArgument = None,
    action: ActionArgument = None,
    values: ValuesArgument = None,
    listed: ListOption = False,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Have an action take place in a living run, by the same words as in a timeline, or insert a fault around a device.

    A device's fault freezes what it measures, biases it, makes it noisy, drops it or delays it, or unplugs it; the
    device itself knows nothing of it. Recorded in the run. Ends with 1 when the run refuses.
    """
    instead = None if listed else "the exit code tells whether the run refused"
    console = Console(json=as_json, quiet=quiet, instead=instead)
    _refuse_options([run, target or "", action or "", *(values or ())])
    found = find_run(runs_root(folder), run)
    if listed:
        if target is not None:
            raise InputError("--list lists all: leave out TARGET")
        return _list(console, found.path, found.name)
    if target is None or action is None:
        raise InputError(
            "expected TARGET and ACTION, such as agent-07 device_fault device=imu fault=freeze;"
            " --list tells what there is"
        )
    value: float | None = None
    parameters: dict[str, Any] = {}
    became = "in force"
    second_named = _second_named(found, target)
    if "/" in target and not second_named:
        value = _value(action, values or ())
        refusal = order_fault(found.path, found.name, (target, action, value))
    else:
        parameters = _parameters(values or ())
        for_s = parameters.pop(FOR_S, None)
        order = {"target": target, "action": action, "parameters": parameters, FOR_S: for_s}
        order["texts"] = _texts(values or (), parameters)
        order["agents"] = second_named
        refusal = clean_line(str(order_action(found.path, found.name, order)["refusal"]))
        became = "begun"  # it may last for no time, and an agent may refuse its part
        if not refusal and target != WHOLE_RUN:
            console.say("an agent that cannot carry out its part tells so in its own events")
    code = ExitCode.RUN_FAILED if refusal else ExitCode.OK
    console.data(f"{target} {action}: {f'refused: {refusal}' if refusal else became}")
    console.print_json(
        {
            "run": found.name,
            "target": target,
            "action": action,
            "value": value,
            "parameters": parameters,
            "refusal": refusal or None,
            "exit_code": int(code),
        }
    )
    return int(code)


def _second_named(run: RunDirectory, target: str) -> list[str]:
    """Return the agents that a target finds by their second names alone: the run's host knows none."""
    found = run_labels(run).labelled((target,))
    return [agent for agent in found if not fnmatch.fnmatchcase(agent, target)]


def _refuse_options(words: Sequence[str]) -> None:
    """
    Refuse words that are no options of the command, and no numbers either.

    Raises:
        InputError: One is.
    """
    for word in words:
        try:
            float(word)
        except ValueError:
            if word.startswith("-"):
                raise InputError(f"no such option: {word}; see `cosmos inject --help`") from None


def _value(action: str, values: Sequence[str]) -> float | None:
    """Return the value of a device's fault."""
    if len(values) > 1:
        raise InputError(f"expected one value of {action} at most, got {' '.join(values)}")
    try:
        value = float(values[0]) if values else None
    except ValueError:
        raise InputError(f"expected a number as value of {action}, got {values[0]!r}") from None
    if value is not None and not math.isfinite(value):
        raise InputError(f"expected a finite number as value of {action}, got {values[0]!r}")
    try:
        check_fault(action, value)
    except ConfigurationError as error:
        raise InputError(str(error)) from None
    return value


def _parameters(values: Sequence[str]) -> dict[str, Any]:
    """Return KEY=VALUE pairs as a mapping; values are read as YAML, and as texts if they are none."""
    found: dict[str, Any] = {}
    for each in values:
        if "=" not in each:
            raise InputError(f"expected KEY=VALUE, such as for_s=20, got {each!r}")
        try:
            key, path, value = parse_override(_as_yaml(each))
        except InputError as error:  # there is no --set here
            raise InputError(str(error).removeprefix("--set ")) from None
        if len(path) > 1 or key in found:
            raise InputError(f"expected each parameter once, and no dots, got {each!r}")
        found[key] = value
    return found


def _as_yaml(given: str) -> str:
    """Return KEY=VALUE, the value in quotes if it is no YAML, as [ok] done and @home are: it is a text."""
    key, _, text = given.partition("=")
    try:
        deque(yaml.parse(text, Loader=yaml.SafeLoader), maxlen=0)
    except yaml.YAMLError:
        return f"{key}={json.dumps(text)}"
    return given


def _texts(values: Sequence[str], parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return as they were written the values that YAML took for something else: an action may want a text."""
    written = (each.partition("=") for each in values)
    return {
        key.strip(): text
        for key, _, text in written
        if not isinstance(parameters.get(key.strip(), ""), str)
    }


def _list(console: Console, path: Path, name: str) -> int:
    """Print what may be ordered of a run, and what is in force."""
    answer = order_action(path, name, {"list": True})
    for each in _mappings(answer.get("actions")):
        given = [f"{key}=..." for key in each.get("parameters", ())]
        given += ["for_s=..."] if each.get(FOR_S) != "never" else []
        target = "AGENT" if each.get("takes_agents") else "run"
        console.data(clean_line(f"{target} {each.get('action')} {' '.join(given)}".rstrip()))
    for each in _mappings(answer.get("in_force")):
        agents = ", ".join(_agents_of(each)) or "run"
        since = f"since {each.get('since_s'):g} s" if each.get("since_s") is not None else ""
        console.data(clean_line(f"in force: {each.get('action')} of {agents} {since}".rstrip()))
    count = answer.get("in_force_count")
    rest = count - len(_mappings(answer.get("in_force"))) if isinstance(count, int) else 0
    if rest > 0:
        console.data(f"in force: {rest} more")
    console.print_json(
        {
            "run": name,
            "actions": answer.get("actions"),
            "in_force": answer.get("in_force"),
            "in_force_count": count,
            "exit_code": 0,
        }
    )
    return int(ExitCode.OK)


def _agents_of(in_force: Mapping[str, Any]) -> list[str]:
    """Return the agents that are told of an action in force, and how many there are besides."""
    names, count = list(map(str, in_force.get("agents", ()))), in_force.get("agents_count")
    rest = count - len(names) if isinstance(count, int) else 0
    return [*names, f"and {rest} more"] if rest > 0 else names


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []
