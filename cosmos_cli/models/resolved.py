"""Values that result of a scenario, and where each came from: a file and line, --set, or a default."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from cosmos_cli.models.document import Document, Path, SourcePlace, dotted
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.variables import SECTION
from madns_runtime.bounded_files import real_path

DEFAULT: Final = "default"
COMMENT_COLUMN: Final = 44
_RULES: Final = "agent_parameters"


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where a value came from."""

    file: str = ""
    line: int = 0
    column: int = 0
    override: str = ""
    """KEY of --set KEY=VALUE."""
    variables: tuple[tuple[str, Origin], ...] = ()
    """Variables that it is made of, and where each of them came from."""

    def __str__(self) -> str:
        if self.override:
            text = f"--set {self.override}"
        else:
            text = f"{self.file}:{self.line}" if self.file else DEFAULT
        own = (f"${{{name}}} of {origin}" for name, origin in self.variables)
        return ", ".join([text, *own])

    def to_mapping(self) -> dict[str, Any]:
        """Return it for --json."""
        found: dict[str, Any] = {
            "file": self.file or None,
            "line": self.line or None,
            "column": self.column or None,
            "override": self.override or None,
            "default": not (self.file or self.override),
        }
        if self.variables:
            found["variables"] = {name: origin.to_mapping() for name, origin in self.variables}
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedValue:
    """One value of what results: a scalar, or a list or mapping without anything inside that has a place of its own."""

    path: Path
    value: Any
    origin: Origin


def resolved_values(scenario: ScenarioFile) -> list[ResolvedValue]:
    """Return all values of a scenario in the order of its sections."""
    return list(_leaves(scenario.document, scenario.to_written(), ()))


def resolved_lines(scenario: ScenarioFile) -> Iterator[str]:
    """Yield what results as YAML, which beside the file is a scenario again, with the origin behind each value."""
    document, root = scenario.document, relative_root(scenario)
    if root != os.curdir:
        yield _line("root: ", root, _origin_at(document, document.place(("root",))))
    yield from _lines(document, scenario.to_written(), (), "")


def relative_root(scenario: ScenarioFile) -> str:
    """Return the folder that travels with a scenario, from the scenario's own."""
    return os.path.relpath(scenario.root, real_path(scenario.path).parent)


def origins(scenario: ScenarioFile) -> dict[str, Any]:
    """Return the origins of all values by dotted path, for --json."""
    return {dotted(one.path): one.origin.to_mapping() for one in resolved_values(scenario)}


def _is_leaf(document: Document, value: Any, path: Path) -> bool:
    """Tell whether a value stands in one line: all in it came from where it itself did."""
    if isinstance(value, dict):
        return not value
    if not isinstance(value, list):
        return True
    return not any(
        isinstance(item, dict | list) or _has_own_origin(document, (*path, index))
        for index, item in enumerate(value)
    )


def _has_own_origin(document: Document, path: Path) -> bool:
    """Tell whether an item of a list is of --set or made of variables, which its list is not."""
    place = document.value_places.get(path)
    above = document.place(path[:-1])
    return place is not None and bool(place.variables or place.override != above.override)


def _leaves(document: Document, value: Any, path: Path) -> Iterator[ResolvedValue]:
    if path and _is_leaf(document, value, path):
        yield ResolvedValue(path=path, value=value, origin=_origin(document, path))
        return
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for step, item in items:
        yield from _leaves(document, item, (*path, step))


def _lines(document: Document, value: Any, path: Path, indent: str) -> Iterator[str]:
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for step, item in items:
        inner = (*path, step)
        head = f"{indent}- " if isinstance(step, int) else f"{indent}{_key(step)}: "
        if _is_leaf(document, item, inner):
            yield _line(head, item, _origin(document, inner))
        else:
            yield head.rstrip()
            yield from _lines(document, item, inner, f"{indent}  ")


def _line(head: str, value: Any, origin: Origin) -> str:
    return f"{f'{head}{json.dumps(value, ensure_ascii=False)}':<{COMMENT_COLUMN}}  # {origin}"


def _key(key: str) -> str:
    return key if key.replace("_", "").isalnum() and not key[0].isdigit() else json.dumps(key)


def _origin(document: Document, path: Path) -> Origin:
    if _is_written(document, path):
        return _origin_at(document, document.place(path))
    # Of all agents, as the rule says nothing.
    if path[0] == _RULES and path[2:3] == ("parameters",):
        return _origin(document, path[2:])
    if path[:2] == ("test", "set"):  # of a variable that the test sets
        return _origin_at(document, document.place(path[:2]))
    return Origin()


def _origin_at(document: Document, place: SourcePlace) -> Origin:
    names = dict.fromkeys(place.variables)
    variables = tuple((name, _origin_at(document, _plain(document, name))) for name in names)
    if place.override:
        return Origin(override=place.override, variables=variables)
    source = place.source or document.source
    return Origin(file=source.label, line=place.line, column=place.column, variables=variables)


def _plain(document: Document, name: str) -> SourcePlace:
    return document.place((SECTION, name))


def _is_written(document: Document, path: Path) -> bool:
    value: Any = document.value
    for step in path:
        if isinstance(value, list):
            if not isinstance(step, int) or step >= len(value):
                return False
        elif not isinstance(value, dict) or step not in value:
            return False
        value = value[step]
    return True
