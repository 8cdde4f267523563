"""
Calls of a run's simulation after the run: its figures, its numbers, the comparison that it makes.

Code of a simulation that is not shipped runs in a process of its own with a deadline, as it does before a run: it
may have been changed since, raise, hang or end the process.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import orjson

from cosmos_cli.models.separate_process import SeparateDefect, SeparateFailure, work_separately
from madns_runtime.analysis.plain import from_plain, to_plain
from madns_runtime.analysis.values import Block
from madns_runtime.config import RunConfig
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.plugin.code_places import place_of
from madns_runtime.plugin.isolation import call_plugin, unfolded
from madns_runtime.plugin.registry import is_shipped, load_function, resolve
from madns_runtime.recording.encoding import to_plain as plain_array

Tell = Callable[[str], None]
Part = Literal["figures", "document", "compare"]


def call_simulation(config: RunConfig, part: Part, *arguments: Any) -> tuple[str, Any]:
    """
    Return a simulation's name, and what a function of its descriptor returns; None if it has none.

    Args:
        config: Of the run.
        part: Which function.
        arguments: For it.

    Raises:
        PluginError: It cannot be found, raised, ended its process, did not come to an end, or returned what is no
            value of figures.
    """

    def work(tell: Tell) -> Mapping[str, Any]:
        try:
            return {"value": to_plain(_call(config, part, arguments, tell))}
        except (MadnsError, TypeError) as error:
            return {"fault": str(error)}

    try:
        if is_shipped(config.simulation):
            return _call(config, part, arguments, lambda stage: None)
        found = work_separately(work, limit_s=config.timeouts.loading_s)
    except PluginError:
        raise
    except (MadnsError, SeparateFailure) as error:
        raise PluginError(str(error)) from None
    except SeparateDefect as defect:
        raise PluginError(str(defect).strip().rpartition("\n")[2]) from None
    if "fault" in found:
        raise PluginError(found["fault"])
    try:
        name, value = from_plain(found["value"])
    except ValueError as error:  # it was changed after it had been made
        raise PluginError(f"{part}() of {config.simulation}: {error}") from None
    return name, value


def json_document(told: Any, doing: str) -> dict[str, Any]:
    """
    Return what a simulation tells in numbers as JSON holds it: arrays are lists, and what is not finite is null.

    Args:
        told: By the simulation.
        doing: The call, for the message.

    Raises:
        PluginError: It is no mapping, or holds what JSON does not.
    """
    if not isinstance(told, Mapping):
        raise PluginError(f"{doing} must return a mapping, got {type(told).__name__}")
    try:
        text = orjson.dumps(dict(told), plain_array, orjson.OPT_SERIALIZE_NUMPY)
    except TypeError as error:
        raise PluginError(
            f"{doing} must return plain values: {error.__cause__ or error}"
        ) from error
    document: dict[str, Any] = orjson.loads(text)
    return document


def check_blocks(blocks: Any, doing: str) -> None:
    """
    Refuse what is shown nowhere, such as a mark without its figure.

    Args:
        blocks: Of a section or of a comparison.
        doing: The call, for the message.

    Raises:
        PluginError: It is no list of blocks.
    """
    listed = blocks if isinstance(blocks, list | tuple) else [blocks]
    wrong = [block for block in listed if not isinstance(block, Block)]
    if wrong or listed is not blocks:
        raise PluginError(
            f"{doing} must give blocks as a list of Figure, SpaceFigure, TableBlock and ReportRemark, got"
            f" {type((wrong or [blocks])[0]).__name__}"
        )


def _call(config: RunConfig, part: Part, arguments: tuple[Any, ...], tell: Tell) -> tuple[str, Any]:
    base_directory = Path(config.base_directory)
    tell(f"importing {config.simulation}")
    simulation = resolve(config.simulation, base_directory)
    where = getattr(simulation, part)
    if where is None:
        return simulation.name, None
    function = load_function(where, base_directory)
    tell(f"{part}() of {config.simulation}")
    found = call_plugin(part, function, *arguments, finish=unfolded)
    if found is None:
        raise PluginError(f"{place_of(function)}: {part}() returned nothing: is there no `return`?")
    return simulation.name, found
