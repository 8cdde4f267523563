"""
A YAML document as plain values, where every path still knows its line and column.

Values given with --set replace those of the file; their place is the option.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.yaml_source import Node, Source, compose

VALUES_MAX = 200_000
"""Bound of the values that a document may unfold to: aliases of aliases grow without end."""

Path = tuple[str | int, ...]
_STEP = re.compile(r"([^.\[\]]+)|\[([0-9]{1,9})\]")
_INDEX = re.compile(r"[0-9]{1,9}")
_KEY = re.compile(r"[^.\[\]]+(?:\.[^.\[\]]+|\[[0-9]{1,9}\])*")


@dataclass(frozen=True, slots=True)
class Place:
    """Where a value was written: line and column of the file, or the key of --set."""

    line: int = 0
    column: int = 0
    override: str = ""


@dataclass(slots=True)
class Document:
    """Plain values, and the place of each value and key."""

    source: Source
    value: dict[str, Any] = field(default_factory=dict)
    value_places: dict[Path, Place] = field(default_factory=dict)
    key_places: dict[Path, Place] = field(default_factory=dict)
    texts: dict[Path, str] = field(default_factory=dict)
    """Scalars as they are written."""
    faults: list[Fault] = field(default_factory=list)
    """Of single scalars, which are None in `value`: everything else can be checked all the same."""

    def fault(self, path: Path, text: str, *, at_key: bool = False) -> Fault:
        """Return a fault at the place of *path*, or of the nearest parent that was written."""
        place = self._place(path, at_key)
        if place.override:
            return Fault(text=text, path=dotted(path), override=place.override)
        return self.source.fault(text, line=place.line, column=place.column, path=dotted(path))

    def missing(self, path: Path, text: str) -> Fault:
        """Return a fault about a path that was not written: it stands at the key above."""
        place = self._place(path[:-1], True)
        if place.override:
            return Fault(text=text, path=dotted(path), override=place.override)
        return self.source.fault(text, line=place.line, column=place.column, path=dotted(path))

    def _place(self, path: Path, at_key: bool) -> Place:
        for length in range(len(path), 0, -1):
            part = path[:length]
            exact = self.key_places if at_key or length < len(path) else self.value_places
            other = self.value_places if exact is self.key_places else self.key_places
            place = exact.get(part) or other.get(part)
            if place is not None:
                return place
        return Place(1, 1)

    def set(self, key: str, path: Path, value: Any) -> None:
        """Replace the value at *path*; what stood below it is forgotten."""
        parent: Any = self.value
        written: Path = ()
        for step, following in zip(path, path[1:], strict=False):
            parent, written = _descend(parent, (*written, step), key, following)
        written = _assign(parent, (*written, path[-1]), key, value)
        for places in (self.value_places, self.key_places, self.texts):
            _forget(places, written)
        self.value_places[written] = self.key_places[written] = Place(override=key)


def _forget(places: dict[Path, Any], path: Path) -> None:
    for known in [known for known in places if known[: len(path)] == path]:
        del places[known]


def dotted(path: Sequence[str | int]) -> str:
    """Return a path as a person writes it: agents.names[2]."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def read_document(source: Source) -> Document:
    """
    Parse *source*, whose top level must be a mapping.

    Raises:
        InputError: Every fault of syntax, and every duplicate or unsuitable key.

    A scalar without a meaning, such as a number that is not finite, is in the document's `faults`.
    """
    root = compose(source)
    document = Document(source)
    if root is None:
        raise InputError(
            faults=[Fault(text="expected a mapping, got an empty file", file=source.label)]
        )
    builder = _Builder(document)
    value = builder.build(root, ())
    if builder.faults:
        raise InputError(faults=builder.faults + document.faults)
    if document.faults and not isinstance(value, dict):
        raise InputError(faults=document.faults)
    if not isinstance(value, dict):
        text = f"expected a mapping (key: value), got {kind_of(value)}"
        raise InputError(faults=[source.fault(text, line=root.line, column=root.column)])
    document.value = value
    return document


def kind_of(value: Any) -> str:
    """Return what *value* is, for messages: scalars as written, containers by their kind."""
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return repr(value) if len(value) <= 60 else repr(value[:57] + "...")
    return str(value)


class _Builder:
    """Nodes to plain values. Faults are collected, so that all are shown at once."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.faults: list[Fault] = []
        self.values = 0

    def build(self, node: Node, path: Path) -> Any:
        self.values += 1
        if self.values > VALUES_MAX:
            text = f"expected at most {VALUES_MAX} values, aliases unfolded"
            raise InputError(faults=[self._at(node, text, path)])
        self.document.value_places[path] = Place(node.line, node.column)
        if node.is_mapping:
            return self.mapping(node, path)
        if isinstance(node.value, list):
            items: Any = node.value
            return [self.build(item, (*path, index)) for index, item in enumerate(items)]
        if node.fault:
            fault = self._at(node, node.fault, path)
            if all((f.line, f.column) != (node.line, node.column) for f in self.document.faults):
                self.document.faults.append(fault)  # an alias stands for what was told already
        if node.is_plain:
            self.document.texts[path] = node.text
        return node.value

    def mapping(self, node: Node, path: Path) -> dict[str, Any]:
        pairs: Any = node.value
        result: dict[str, Any] = {}
        for key, value in pairs:
            if key.is_plain and key.text == "<<":
                self.merge(value, path, result)
        seen: dict[str, Node] = {}
        for key, value in pairs:
            if key.is_plain and key.text == "<<":
                continue
            name = key.value
            if not isinstance(name, str):
                text = f"expected a text as key, got {key.text or kind_of(name)}"
                self.faults.append(
                    self._at(key, text + (": put it in quotes" if key.text else ""), path)
                )
                continue
            inner = (*path, name)
            if name in seen:
                text = f"duplicate key; the first stands in line {seen[name].line}"
                self.faults.append(self._at(key, text, inner))
                continue
            seen[name] = key
            self.forget(inner)
            self.document.key_places[inner] = Place(key.line, key.column)
            result[name] = self.build(value, inner)
        return result

    def merge(self, node: Node, path: Path, result: dict[str, Any]) -> None:
        """Take over the keys of `<<: *anchor`, or of a list of them, the earlier the stronger."""
        nodes: Any = [node] if node.is_mapping else node.value
        if not isinstance(nodes, list) or not all(item.is_mapping for item in nodes):
            self.faults.append(
                self._at(node, "expected a mapping or a list of mappings after <<", path)
            )
            return
        for item in reversed(nodes):
            result.update(self.mapping(item, path))

    def forget(self, path: Path) -> None:
        """Drop the places that a merged mapping left under a key that is written out."""
        if path not in self.document.value_places:
            return
        for places in (self.document.value_places, self.document.key_places, self.document.texts):
            _forget(places, path)

    def _at(self, node: Node, text: str, path: Path) -> Fault:
        return self.document.source.fault(
            text, line=node.line, column=node.column, path=dotted(path)
        )


def apply_overrides(document: Document, overrides: Sequence[str]) -> list[Fault]:
    """Apply every KEY=VALUE of --set, in order; return the faults of those that are malformed or have no place."""
    faults: list[Fault] = []
    for override in overrides:
        try:
            key, path, value = parse_override(override)
            document.set(key, path, value)
        except InputError as error:
            faults += error.faults
    return faults


def parse_override(override: str) -> tuple[str, Path, Any]:
    """
    Split KEY=VALUE; the value is read as YAML.

    Raises:
        InputError: There is no '=', the key is no dotted path, or the value no YAML.
    """
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals:
        raise _override_error(override, "expected KEY=VALUE, such as agents.count=5")
    if not _KEY.fullmatch(key):
        raise _override_error(key or override, "expected a dotted path, such as agents.names[0]")
    path = tuple(
        int(index) if index else int(name) if _INDEX.fullmatch(name) else name
        for name, index in _STEP.findall(key)
    )
    source = Source.of("", text)
    try:
        root = compose(source)
        builder = _Builder(Document(source))
        value = builder.build(root, ()) if root else None
    except InputError as error:
        raise _override_error(key, error.faults[0].text) from None
    faults = builder.faults + builder.document.faults
    if faults:
        raise _override_error(key, faults[0].text)
    return key, path, value


def _override_error(key: str, text: str) -> InputError:
    return InputError(faults=[Fault(text=text, override=key)])


def _descend(parent: Any, path: Path, key: str, following: str | int) -> tuple[Any, Path]:
    """Return the container at *path*, made if it is not there, and the path in its own terms."""
    fresh: Any = [] if isinstance(following, int) else {}
    path = _checked_step(parent, path, key)
    if isinstance(parent, list):
        index = int(path[-1])
        if index == len(parent):
            parent.append(fresh)
        child = parent[index]
    else:
        child = parent.get(path[-1])
        if child is None:
            child = parent[path[-1]] = fresh
    if not isinstance(child, dict | list):
        raise _override_error(key, f"{dotted(path)} is {kind_of(child)} and has nothing inside")
    return child, path


def _assign(parent: Any, path: Path, key: str, value: Any) -> Path:
    path = _checked_step(parent, path, key)
    if isinstance(parent, list) and path[-1] == len(parent):
        parent.append(value)
    else:
        parent[path[-1]] = value
    return path


def _checked_step(parent: Any, path: Path, key: str) -> Path:
    """Return *path* with its last step as *parent* knows it: an index in a list, else a key."""
    step, above = path[-1], dotted(path[:-1])
    if not isinstance(parent, list):
        return (*path[:-1], str(step))
    if not isinstance(step, int):
        raise _override_error(key, f"{above} is a list: expected an index, got {step}")
    if step > len(parent):
        raise _override_error(key, f"{above} has {len(parent)} items: got the index {step}")
    return path


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return `, did you mean X?` or the list of what is known."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if close:
        return f", did you mean {close[0]}?"
    return f"; known here: {', '.join(known)}" if known else ""
