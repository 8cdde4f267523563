"""
A YAML document as plain values, where every path still knows its line and column.

Values given with --set replace those of the file; their place is the option.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.yaml_source import DEPTH_MAX, Node, YamlSource, compose

VALUES_MAX = 200_000
"""Bound of the values that a document may unfold to: aliases of aliases grow without end."""

KEY_CHARACTERS_SHOWN = 60
OVERRIDES_MAX = 1000
GUESSES_MAX = 20_000
"""Words that are compared with what was written, for all faults of a kind together: a third of a second."""
Path = tuple[str | int, ...]
_STEP = re.compile(r"([^.\[\]]+)|\[([0-9]{1,9})\]")
_INDEX = re.compile(r"[0-9]{1,9}")
_KEY = re.compile(r"[^.\[\]]+(?:\.[^.\[\]]+|\[[0-9]{1,9}\])*")


@dataclass(frozen=True, slots=True)
class SourcePlace:
    """Place of a value: line and column of the file, or the key of --set."""

    line: int = 0
    column: int = 0
    override: str = ""


@dataclass(slots=True)
class Document:
    """Plain values, and the place of each value and key."""

    source: YamlSource
    value: dict[str, Any] = field(default_factory=dict)
    value_places: dict[Path, SourcePlace] = field(default_factory=dict)
    key_places: dict[Path, SourcePlace] = field(default_factory=dict)
    texts: dict[Path, str] = field(default_factory=dict)
    """Scalars as they are written."""
    faults: list[Fault] = field(default_factory=list)
    """Of single scalars, which are None in `value`: everything else can be checked all the same."""

    def fault(self, path: Path, text: str, *, at_key: bool = False) -> Fault:
        """Return a fault at the place of *path*; of one that was not written, at the key above."""
        place = self._place(path, at_key)
        if place.override:
            return Fault(text=text, path=dotted(path), override=place.override)
        return self.source.fault(text, line=place.line, column=place.column, path=dotted(path))

    def _place(self, path: Path, at_key: bool) -> SourcePlace:
        for length in range(len(path), 0, -1):
            part = path[:length]
            exact = self.key_places if at_key or length < len(path) else self.value_places
            other = self.value_places if exact is self.key_places else self.key_places
            place = exact.get(part) or other.get(part)
            if place is not None:
                return place
        return SourcePlace(1, 1)

    def set(self, key: str, path: Path, value: Any) -> None:
        """Replace the value at *path*; what stood below it is forgotten."""
        parent: Any = self.value
        written: Path = ()
        for step, following in zip(path, path[1:], strict=False):
            parent, written = _descend(parent, (*written, step), key, following)
        written = _assign(parent, (*written, path[-1]), key, value)
        for places in (self.value_places, self.key_places, self.texts):
            _forget(places, written)
        self.value_places[written] = self.key_places[written] = SourcePlace(override=key)

    def rename(self, path: Path, name: str) -> None:
        """Call the key at *path*, a scalar's, *name*: its value and places stay."""
        new = (*path[:-1], name)
        parent: Any = self.value
        for step in path[:-1]:
            parent = parent[step]
        parent[name] = parent.pop(path[-1])
        maps: tuple[dict[Path, Any], ...] = (self.value_places, self.key_places, self.texts)
        for places in maps:
            if path in places:
                places[new] = places.pop(path)


def _forget(places: dict[Path, Any], path: Path) -> None:
    for known in [known for known in places if known[: len(path)] == path]:
        del places[known]


def dotted(path: Sequence[str | int]) -> str:
    """Return a path as a person writes it: agents.names[2]."""
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def read_document(source: YamlSource, *, has_64_bits: bool = True) -> Document:
    """
    Parse *source*, whose top level must be a mapping.

    Args:
        source: YAML.
        has_64_bits: Whether whole numbers must fit into what messages and JSON hold.

    Raises:
        InputError: Every fault of syntax, and every duplicate or unsuitable key.

    A scalar without a meaning, such as a number that is not finite, is in the document's `faults`.
    """
    root = compose(source, has_64_bits=has_64_bits)
    document = Document(source)
    if root is None:
        empty = Fault(text="expected a mapping, got an empty file", file=source.label)
        raise InputError(faults=[empty])
    builder = _Builder(document)
    value = builder.build(root, ())
    if builder.faults or (document.faults and not isinstance(value, dict)):
        raise InputError(faults=builder.faults + document.faults)
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
        return str(value).lower()
    if isinstance(value, str):
        return repr(value) if len(value) <= 60 else repr(value[:57] + "...")
    return str(value)


class _Builder:
    """Nodes to plain values. Faults are collected, so that all are shown at once."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.faults: list[Fault] = []
        self.values = 0
        self.told: set[tuple[int, int]] = set()
        """Places of scalars without a value."""

    def build(self, node: Node, path: Path) -> Any:
        self._count(node, path)
        if len(path) > DEPTH_MAX:  # aliases nest deeper than what is written
            text = f"expected at most {DEPTH_MAX} levels of nesting, aliases unfolded"
            raise InputError(faults=[self._at(node, text, path)])
        self.document.value_places[path] = SourcePlace(node.line, node.column)
        if node.is_mapping:
            return self.mapping(node, path)
        if isinstance(node.value, list):
            items: Any = node.value
            return [self.build(item, (*path, index)) for index, item in enumerate(items)]
        place = (node.line, node.column)
        if node.fault and place not in self.told:  # an alias stands for what was told already
            self.told.add(place)
            self.document.faults.append(self._at(node, node.fault, path))
        if node.is_plain:
            self.document.texts[path] = node.text
        return node.value

    def _count(self, node: Node, path: Path) -> None:
        self.values += 1
        if self.values > VALUES_MAX:
            text = f"expected at most {VALUES_MAX} values, aliases unfolded"
            raise InputError(faults=[self._at(node, text, path)])

    def mapping(
        self, node: Node, path: Path, taken: AbstractSet[str] = frozenset(), merges: int = 0
    ) -> dict[str, Any]:
        """Return a mapping, which *merges* others were taken over into, without keys that are *taken* by them."""
        pairs: Any = node.value
        merged = [value for key, value in pairs if _is_merge(key)]
        written = [(key, value) for key, value in pairs if not _is_merge(key)]
        result: dict[str, Any] = {}
        if merged:
            stronger = set(taken)
            stronger.update(key.value for key, _ in written if isinstance(key.value, str))
            for value in merged:
                self.merge(value, path, result, stronger, merges + 1)
        seen: dict[str, Node] = {}
        for key, value in written:
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
            if name in taken:
                self._count(key, inner)
            else:
                self.document.key_places[inner] = SourcePlace(key.line, key.column)
                result[name] = self.build(value, inner)
        return result

    def merge(
        self, node: Node, path: Path, result: dict[str, Any], stronger: set[str], merges: int
    ) -> None:
        """Take over the keys of `<<: *anchor`, or of a list of them, the earlier the stronger."""
        nodes: Any = [node] if node.is_mapping else node.value
        if not isinstance(nodes, list) or not all(item.is_mapping for item in nodes):
            text = "expected a mapping or a list of mappings after <<"
            self.faults.append(self._at(node, text, path))
            return
        if merges > DEPTH_MAX:
            text = f"expected at most {DEPTH_MAX} mappings that are taken over into each other"
            raise InputError(faults=[self._at(node, text, path)])
        for item in nodes:
            self._count(item, path)
            found = self.mapping(item, path, stronger, merges)
            stronger.update(found)
            result.update(found)

    def _at(self, node: Node, text: str, path: Path) -> Fault:
        return self.document.source.fault(
            text, line=node.line, column=node.column, path=dotted(path)
        )


def _is_merge(key: Node) -> bool:
    return key.is_plain and key.text == "<<"


def apply_overrides(document: Document, overrides: Sequence[str]) -> list[Fault]:
    """Apply every KEY=VALUE of --set, in order; return the faults of those that are malformed or have no place."""
    faults: list[Fault] = []
    seen: dict[tuple[str, ...], str] = {}
    if len(overrides) > OVERRIDES_MAX:
        text = f"expected at most {OVERRIDES_MAX} of --set, got {len(overrides)}; write a file"
        return [Fault(text=text, override=overrides[OVERRIDES_MAX].partition("=")[0])]
    for override in overrides:
        try:
            key, path, value = parse_override(override)
            _refuse_replacing(key, path, seen)
            document.set(key, path, value)
        except InputError as error:
            faults += error.faults
    return faults


def _refuse_replacing(key: str, path: Path, seen: dict[tuple[str, ...], str]) -> None:
    """
    Enter a key of --set, unless it would replace what an earlier one said.

    Raises:
        InputError: It would, in silence.
    """
    steps = tuple(map(str, path))
    for other, other_key in seen.items():
        if other == steps:
            also = " (--duration sets it, too)" if key == "time.duration_s" else ""
            raise _override_error(key, f"is given twice, and only one could count{also}")
        if other[: len(steps)] == steps:
            raise _override_error(key, f"would replace what --set {other_key} says; give it first")
    seen[steps] = key


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
    if len(_STEP.findall(key)) > DEPTH_MAX:
        text = f"expected at most {DEPTH_MAX} levels of nesting"
        raise _override_error(f"{key[:KEY_CHARACTERS_SHOWN]}...", text)
    path = tuple(
        int(index) if index else int(name) if _INDEX.fullmatch(name) else name
        for name, index in _STEP.findall(key)
    )
    source = YamlSource.of("", text)
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


def may_guess(faults: int, known: int) -> bool:
    """Tell whether a fault after so many others may be given a guess among so many words: each word is compared."""
    return faults < FAULTS_SHOWN_MAX and faults * known < GUESSES_MAX


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return `, did you mean X?` or the list of what is known."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    if close:
        return f", did you mean {close[0]}?"
    return f"; known here: {', '.join(known)}" if known else ""
