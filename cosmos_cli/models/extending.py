"""
A scenario that `extends` others, as one document in which every value knows its file.

Mappings merge; lists and scalars replace, and so does a mapping whose `kind` is another. All files lie in or below the
scenario's root, the folder that travels to machines and into a run's copy, and from which relative files are found:
its own folder, or what `root: ..` names.
"""

from __future__ import annotations

import dataclasses
import os.path
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, SourcePlace, kind_of, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.yaml_source import read_source
from madns_runtime.bounded_files import real_path

FILES_MAX: Final = 8
"""Of one chain, the scenario with it."""
ROOTS: Final = (".", "..", "../..")
OF_THE_FILE: Final = ("extends", "root")
"""Keys that say how files belong together; --set cannot."""
_KIND: Final = "kind"


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioSource:
    """A scenario with all that it extends."""

    document: Document
    """Of all files together, without `extends` and `root`."""
    root: Path
    """The folder that travels, absolute."""
    files: tuple[str, ...]
    """As they are shown, the scenario first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _File:
    label: str
    path: Path
    document: Document
    extends: str | None
    extends_place: SourcePlace
    root: str | None
    root_place: SourcePlace

    def fault(self, key: str, text: str) -> Fault:
        place = self.extends_place if key == "extends" else self.root_place
        source = self.document.source
        return source.fault(text, line=place.line, column=place.column, path=key)


def read_scenario_source(path: Path) -> ScenarioSource:
    """
    Read a scenario and what it extends.

    Raises:
        InputError: A file cannot be read, lies outside of the root, or extends itself.
    """
    chain = _chain(path)
    root = _root(chain)
    by = next((file for file in chain if file.root is not None), chain[0])
    for file, above in zip(chain[1:], chain, strict=False):
        if not file.path.is_relative_to(root):
            text = f"{file.label} lies outside of {root}, the root of the scenario, which travels with it"
            raise InputError(faults=[above.fault("extends", f"{text}{_cure(file, chain[0])}")])
    document = chain[0].document
    for file in chain[1:]:
        merge_below(document, file.document)
    if by.root is not None:
        place = dataclasses.replace(by.root_place, source=by.document.source)
        document.value_places["root",] = place
    return ScenarioSource(document=document, root=root, files=tuple(file.label for file in chain))


def _chain(path: Path) -> list[_File]:
    """Return the scenario and its bases, each followed by what it extends."""
    chain = [_read(str(path), real_path(path))]
    while (extends := chain[-1].extends) is not None:
        last = chain[-1]
        faults = [fault for file in chain for fault in file.document.faults]
        wrong = _extends_fault(extends, last, chain)
        if wrong:
            raise InputError(faults=[*faults, last.fault("extends", wrong)])
        target = real_path(last.path.parent / extends)
        label = os.path.normpath(Path(last.label).parent / extends)
        if real_path(Path(label)) != target:  # a link on the way
            label = str(target)
        try:
            chain.append(_read(label, target))
        except InputError as error:
            whole = [fault for fault in error.all_faults if fault.line is None]
            told = [
                last.fault("extends", f"{f.file}: {f.text}" if f.file else f.text) for f in whole
            ]
            told += [fault for fault in error.faults if fault.line is not None]
            raise InputError(faults=[*faults, *told], omitted=error.omitted) from None
    return chain


def _extends_fault(extends: str, last: _File, chain: Sequence[_File]) -> str:
    if "${" in extends:
        return f"expected a file's name, got {extends!r}: files are read before variables are known"
    if Path(extends).is_absolute() or not extends.strip() or not extends.isprintable():
        return f"expected the path of a scenario from this file's folder, got {extends!r}"
    if len(chain) == FILES_MAX:
        return f"expected at most {FILES_MAX} files that extend each other"
    target = real_path(last.path.parent / extends)
    for number, file in enumerate(chain):
        if file.path == target:
            names = [each.label for each in chain[number:]]
            return f"expected a chain that ends, got {' -> '.join([*names, file.label])}"
    return ""


def _read(label: str, path: Path) -> _File:
    document = read_document(read_source(Path(label)))
    found: dict[str, Any] = {}
    places: dict[str, SourcePlace] = {}
    for key in OF_THE_FILE:
        places[key] = document.place((key,))
        found[key] = document.value.get(key)
        if key in document.value and not isinstance(found[key], str):
            text = f"expected the path of a file, got {kind_of(found[key])}"
            if key == "root":
                text = f"expected {', '.join(ROOTS)}, got {kind_of(found[key])}"
            raise InputError(faults=[*document.faults, document.fault((key,), text)])
        document.value.pop(key, None)
    return _File(
        label=label,
        path=path,
        document=document,
        extends=found["extends"],
        extends_place=places["extends"],
        root=found["root"],
        root_place=places["root"],
    )


def _root(chain: Sequence[_File]) -> Path:
    """Return the root that the first file of the chain names which names one; else the scenario's folder."""
    folder = chain[0].path.parent
    for file in chain:
        if file.root is None:
            continue
        if file.root.rstrip("/") not in ROOTS:
            expected = (
                f"expected {', '.join(ROOTS)}: this file's folder, or one of the two above it"
            )
            raise InputError(faults=[file.fault("root", f"{expected}; got {file.root!r}")])
        root = real_path(file.path.parent / file.root)
        if root.parent == root:
            text = "expected a folder of one's own, got that of all files: a root travels whole"
            raise InputError(faults=[file.fault("root", text)])
        if root not in (folder, *folder.parents[:2]):
            text = (
                f"expected the folder of {chain[0].label} or one of the two above it, got {root};"
                f" say root in {chain[0].label}, which comes first"
            )
            raise InputError(faults=[file.fault("root", text)])
        return root
    return folder


def _cure(file: _File, scenario: _File) -> str:
    folder = scenario.path.parent
    for root, above in zip(ROOTS, (folder, *folder.parents[:2]), strict=False):
        if file.path.is_relative_to(above):
            return f": say root: {root} in {scenario.label}"
    return "; a root is at most two folders above the scenario"


def merge_below(document: Document, base: Document) -> None:
    """Put *base* below *document*: what that says stays, and of mappings what it does not say comes from *base*."""
    merge_mapping(document, base, base.value, ())
    document.faults += [fault for fault in base.faults if fault not in document.faults]


def merge_mapping(
    document: Document, base: Document, lower: dict[str, Any], path: ValuePath
) -> None:
    """Put *lower*, which has its places at *path* of *base*, below the mapping at *path* of *document*."""
    upper: Any = document.value
    for step in path:
        upper = upper[step]
    _Merge(document, base).mapping(upper, lower, path)


@dataclass(frozen=True, slots=True)
class _Merge:
    document: Document
    base: Document

    def mapping(self, upper: dict[str, Any], lower: dict[str, Any], path: ValuePath) -> None:
        own = list(upper.items())
        for key, value in lower.items():
            inner = (*path, key)
            if key not in upper:
                upper[key] = value
                self.take(value, inner)
            elif _merges(upper[key], value):
                self.mapping(upper[key], value, inner)
        # In the order of the lowest file, so that what belongs together stays so.
        order = {key: upper[key] for key in (*lower, *(key for key, _ in own))}
        upper.clear()
        upper.update(order)

    def take(self, value: Any, path: ValuePath) -> None:
        """Take over the places of a value and of all in it."""
        pairs = (
            (self.document.value_places, self.base.value_places),
            (self.document.key_places, self.base.key_places),
        )
        for places, found in pairs:
            if path in found:
                place = found[path]
                source = place.source or self.base.source
                places[path] = dataclasses.replace(place, source=source)
        if path in self.base.texts:
            self.document.texts[path] = self.base.texts[path]
        if isinstance(value, dict):
            for key, item in value.items():
                self.take(item, (*path, key))
        elif isinstance(value, list):
            for index, item in enumerate(value):
                self.take(item, (*path, index))


def _merges(upper: Any, lower: Any) -> bool:
    """Tell whether two values merge: mappings of the same kind of thing."""
    if not (isinstance(upper, dict) and isinstance(lower, dict)):
        return False
    return _KIND not in upper or upper[_KIND] == lower.get(_KIND)
