"""
Files of an inventory: which there are, as Ansible finds them; as documents; and what Ansible would read differently.

Ansible reads YAML by the older rules of YAML 1.1, where `no` is false, 0644 is 420 and 1e3 a text.
An inventory must not mean two things, so a scalar that the two readings differ on is a fault.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import yaml

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, dotted, kind_of, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.yaml_source import Node, YamlSource, compose, read_source, resolve_scalar

EXTENSIONS = (".yml", ".yaml", ".json")
"""Extensions that Ansible takes for YAML, beside names without one."""
DEPTH_MAX = 16
FILES_MAX = 10_000
IGNORED_ENDINGS = (
    *(".pyc", ".pyo", ".swp", ".bak", "~", ".rpm", ".md", ".txt", ".rst"),
    *(".orig", ".cfg", ".retry"),
)
"""Files that Ansible passes over in a folder of inventories."""
SPECIAL_FOLDERS = ("group_vars", "host_vars", "vars_plugins")
CONVERT = "ansible-inventory -i FILE --list --yaml --output NEW.yaml"

_VAULT = "$ANSIBLE_VAULT"
_INI_LINE = re.compile(r"\[[\w.:-]+\]\s*(?:[#;].*)?|[\w.\[\]:-]+(?:\s+\w+=\S*)+\s*")
_PLAIN_TAGS = frozenset(f"tag:yaml.org,2002:{name}" for name in ("bool", "float", "int", "null"))
_TEXT_TAG = "tag:yaml.org,2002:str"


def read_inventory_document(path: Path) -> Document:
    """
    Read a file of groups.

    Raises:
        InputError: It cannot be read as YAML, or is an inventory of another kind.
    """
    if path.suffix and path.suffix not in EXTENSIONS:
        if hint := _ini_fault(_read_plain(path)):
            raise InputError(faults=[hint])
        text = f"expected a name that ends in {', '.join(EXTENSIONS)} or has no ending"
        raise _refused(path, f"{text}: Ansible reads no YAML from others, got {path.name!r}")
    source = _read_plain(path)
    try:
        document = read_document(source, has_64_bits=False)
    except InputError as error:
        hint = _ini_fault(source)
        raise InputError(faults=[hint]) if hint else error from None
    return _with_readings(document)


def read_variables_document(path: Path) -> Document | None:
    """
    Read a file of group_vars or host_vars; None if nothing is in it.

    Raises:
        InputError: It cannot be read as YAML, or is encrypted.
    """
    source = _read_plain(path)
    if compose(source, has_64_bits=False) is None:
        return None
    return _with_readings(read_document(source, has_64_bits=False))


def _refused(path: Path, text: str) -> InputError:
    return InputError(faults=[Fault(text=text, file=str(path))])


def _read_plain(path: Path) -> YamlSource:
    """
    Read a file that is meant to be YAML.

    Raises:
        InputError: It cannot be read, is encrypted, or is a program.
    """
    source, text = read_source(path), ""
    if source.text.startswith(_VAULT):
        text = (
            "files of ansible-vault are not understood: an inventory needs no secret, as machines are"
            " reached with a key or the ssh agent; write this one in plain YAML"
        )
    elif source.text.startswith("#!"):
        text = f"scripts that print an inventory are not run; write what it prints to a file: {CONVERT}"
    if text:
        raise InputError(faults=[source.fault(text, line=1, column=1)])
    return source


def _ini_fault(source: YamlSource) -> Fault | None:
    """Return a fault if the first line that says something is one of an INI file."""
    for number, line in enumerate(source.lines, start=1):
        text = line.strip()
        if text and text[0] not in "#;":
            if not _INI_LINE.fullmatch(text):
                return None
            told = f"expected YAML, got an inventory in INI form; convert it: {CONVERT}"
            return source.fault(told, line=number, column=len(line) - len(line.lstrip()) + 1)
    return None


def _with_readings(document: Document) -> Document:
    root = compose(document.source, has_64_bits=False)
    if root is not None:
        document.faults += _reading_faults(document.source, root)
    if not document.faults:
        document.faults += _loading_faults(document.source)
    return document


def _loading_faults(source: YamlSource) -> list[Fault]:
    """Return what PyYAML, with which Ansible reads, refuses: an anchor that is defined twice, and the like."""
    try:
        yaml.load(source.text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        text = f"Ansible cannot read this: {error.problem or error.context}"
        if "duplicate anchor" in f"{error.context} {error.problem}":
            text = "expected each anchor once, which is all that Ansible reads; rename this one"
        return [source.fault(text, line=line, column=column)]
    except (ValueError, yaml.YAMLError) as error:
        return [source.fault(f"Ansible cannot read this file: {error}", line=1, column=1)]
    return []


def _reading_faults(source: YamlSource, root: Node) -> Iterator[Fault]:
    seen: set[int] = set()
    waiting: list[tuple[Node, ValuePath]] = [(root, ())]
    while waiting:
        node, path = waiting.pop()
        if id(node) in seen:
            continue  # an alias stands for what was told already
        seen.add(id(node))
        content: Any = node.value
        if node.is_mapping:
            for key, value in content:
                inner = (*path, key.text)
                waiting += [(key, inner), (value, inner)]
        elif isinstance(content, list):
            waiting += [(item, (*path, index)) for index, item in enumerate(content)]
        else:
            text = _difference(node)
            if text:
                yield source.fault(text, line=node.line, column=node.column, path=dotted(path))


def _difference(node: Node) -> str:
    """Say what Ansible would read a scalar as, if it is not what is read here."""
    if not node.is_plain or node.fault or node.text == "<<":
        return ""
    ours = resolve_scalar(node.text, has_64_bits=False)
    if (type(ours), ours) != (type(node.value), node.value):
        return ""  # a tag such as !!str has said what is meant, to both
    try:
        theirs = _reading_of_ansible(node.text)
    except (ValueError, yaml.YAMLError):
        return f"Ansible cannot read {node.text}: put it in quotes"
    if (type(ours), ours) == (type(theirs), theirs):
        return ""
    if isinstance(theirs, bool):
        word = kind_of(theirs)
        return f"Ansible reads {node.text} as {word}: write {word}, or put a text in quotes"
    shown = f"the text {theirs!r}" if isinstance(theirs, str) else str(theirs)
    expected = (
        f"expected a text in quotes{'' if isinstance(ours, str) else f', or the number {ours}'}"
    )
    return f"{expected}, got {node.text}, which Ansible reads as {shown}"


@functools.lru_cache(maxsize=4096)
def _reading_of_ansible(text: str) -> Any:
    """Return what YAML 1.1 makes of an unquoted scalar, as PyYAML reads it; dates come back as they are shown."""
    resolver: Any = yaml.resolver.Resolver()  # untyped in the stubs
    tag = resolver.resolve(yaml.ScalarNode, text, (True, False))
    if tag == _TEXT_TAG:
        return text
    value = yaml.constructor.SafeConstructor().construct_object(yaml.ScalarNode(tag, text))
    return value if tag in _PLAIN_TAGS else _Other(f"the {type(value).__name__} {value}")


class _Other:
    """A value of a type that JSON has not, such as a date."""

    def __init__(self, shown: str) -> None:
        self.shown = shown

    def __str__(self) -> str:
        return self.shown


def inventory_files(path: Path) -> list[Path]:
    """
    Return the files of groups: *path* itself, or all in it and below it, by name, if it is a folder.

    Raises:
        InputError: The folder holds none, or cannot be read.
    """

    def is_taken(inner: Path) -> bool:
        return inner.name not in SPECIAL_FOLDERS and not inner.name.endswith(IGNORED_ENDINGS)

    found = _files_at(path, is_taken)
    if not found:
        raise _refused(
            path, f"expected an inventory file in this folder, such as {path / 'tower.yaml'}"
        )
    return found


def variable_files(folder: Path, names: Iterable[str]) -> tuple[dict[str, list[Path]], list[Fault]]:
    """
    Return the files of variables of each name that has any, in the order they are read, and faults.

    Ansible finds them as group_vars/NAME.yml, host_vars/NAME/* and more.

    Args:
        folder: group_vars or host_vars; need not be there.
        names: Of groups, or of machines.
    """
    if not os.path.isdir(folder):
        return {}, []
    there = set(_names_in(folder, 0))
    found: dict[str, list[Path]] = {}
    faults: list[Fault] = []
    for name in names:
        given = [name + ending for ending in ("", *EXTENSIONS) if name + ending in there]
        if given:
            found[name] = _files_at(folder / given[0], _may_hold_variables)
        for other in given[1:]:
            text = f"Ansible reads only {given[0]!r}, which stands beside it: put both into one"
            faults.append(Fault(text=text, file=str(folder / other)))
    return found, faults


def _may_hold_variables(path: Path) -> bool:
    ending = os.path.splitext(path.name)[1]
    is_known = not ending or (ending in EXTENSIONS and not os.path.isdir(path))
    return is_known and not path.name.endswith("~")


def _files_at(path: Path, is_taken: Callable[[Path], bool]) -> list[Path]:
    """Return *path* itself, or, if it is a folder, all files in it and below it that are taken, by name."""
    found: list[Path] = []
    for file in _walk(path, is_taken, 0):
        if len(found) >= FILES_MAX:
            raise _refused(file.parent, f"expected at most {FILES_MAX} files")
        found.append(file)
    return found


def _walk(path: Path, is_taken: Callable[[Path], bool], depth: int) -> Iterator[Path]:
    if not os.path.isdir(path):
        yield path
        return
    for name in _names_in(path, depth):
        if not name.startswith(".") and is_taken(path / name):
            yield from _walk(path / name, is_taken, depth + 1)


def _names_in(folder: Path, depth: int) -> list[str]:
    if depth > DEPTH_MAX:
        raise _refused(folder, f"expected at most {DEPTH_MAX} folders inside each other")
    try:
        return sorted(os.listdir(folder))
    except OSError as error:
        raise _refused(folder, f"cannot be read: {error.strerror}") from error
