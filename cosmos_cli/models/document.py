"""
A YAML document as plain values, where every path still knows its line and column.

What other modules put into it keeps the place where it was written: another file, or --set (`overrides`).
"""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Any

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault, InputError
from cosmos_cli.models.yaml_source import DEPTH_MAX, Node, YamlSource, compose
from madns_runtime import similar_words

VALUES_MAX = 200_000
"""Bound of the values that a document may unfold to: aliases of aliases grow without end."""

GUESSES_MAX = 20_000
"""Words that are compared with what was written, for all faults of a kind together: a third of a second."""
Path = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class SourcePlace:
    """Place of a value: line and column of its file, or the key of --set."""

    line: int = 0
    column: int = 0
    override: str = ""
    source: YamlSource | None = None
    """The file, if it is another than the document's own."""
    path: Path | None = None
    """Where it is written, if that is elsewhere than where it counts."""
    variables: tuple[str, ...] = ()
    """Names of the variables that it is made of."""


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
    variables: tuple[str, ...] = ()
    """Names of the scenario's variables."""
    without_value: list[Path] = field(default_factory=list)
    """Values that have a fault told elsewhere, such as at their variable; None in `value`."""
    open_texts: list[Path] = field(default_factory=list)
    """Texts of a plug-in's settings that still hold ${...}: only the plug-in knows what words it replaces itself."""

    def fault(self, path: Path, text: str, *, at_key: bool = False) -> Fault:
        """Return a fault at the place of *path*; of one that was not written, at the key above."""
        place, known = self._found(path, at_key)
        name = dotted(path if place.path is None else (*place.path, *path[len(known) :]))
        text += self._variables_of(place)
        if place.override:
            return Fault(text=text, path=name, override=place.override)
        source = place.source or self.source
        return source.fault(text, line=place.line, column=place.column, path=name)

    def _variables_of(self, place: SourcePlace) -> str:
        """Return the variables that a value is made of, with their places: what is wrong may be there."""
        told = []
        for name in dict.fromkeys(place.variables):
            own = self.place(("vars", name))
            where = f"{(own.source or self.source).label}:{own.line}"
            told.append(f"${{{name}}} of {f'--set {own.override}' if own.override else where}")
        return f" ({', '.join(told)})" if told else ""

    def place(self, path: Path, *, at_key: bool = False) -> SourcePlace:
        """Return the place of *path*; of one that was not written, of the key above."""
        return self._found(path, at_key)[0]

    def _found(self, path: Path, at_key: bool) -> tuple[SourcePlace, Path]:
        """Return the place, and the path that it is of."""
        for length in range(len(path), 0, -1):
            part = path[:length]
            exact = self.key_places if at_key or length < len(path) else self.value_places
            other = self.value_places if exact is self.key_places else self.key_places
            place = exact.get(part) or other.get(part)
            if place is not None:
                return place, part
        return SourcePlace(1, 1), ()

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


def read_value(source: YamlSource) -> tuple[Any, str, list[Fault]]:
    """
    Return what a text means that is any value, the scalar as it is written if it is a plain one, and its faults.

    Raises:
        InputError: It is no YAML.
    """
    root = compose(source)
    builder = _Builder(Document(source))
    value = builder.build(root, ()) if root else None
    return value, builder.document.texts.get((), ""), builder.faults + builder.document.faults


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


def may_guess(faults: int, known: int) -> bool:
    """Tell whether a fault after so many others may be given a guess among so many words: each word is compared."""
    return faults < FAULTS_SHOWN_MAX and faults * known < GUESSES_MAX


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """Return `, did you mean X?` or the list of what is known."""
    guess = similar_words.did_you_mean(word, known)
    return guess or (f"; known here: {', '.join(known)}" if known else "")
