"""
Files of an inventory as documents, and what Ansible would read differently in them.

Ansible reads YAML by the older rules of YAML 1.1, where `no` is false, 0644 is 420 and 1e3 a text.
An inventory must not mean two things, so a scalar that the two readings differ on is a fault.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, dotted, kind_of, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.yaml_source import Node, Source, compose, read_source, resolve_scalar

EXTENSIONS = (".yml", ".yaml", ".json")
"""What Ansible takes for YAML, beside names without an extension."""
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
        text = f"expected a name that ends in {', '.join(EXTENSIONS)} or has no ending"
        raise _refused(path, f"{text}: Ansible reads no YAML from others, got {path.name!r}")
    source = read_source(path)
    _refuse_other_kinds(source)
    try:
        document = read_document(source)
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
    source = read_source(path)
    _refuse_other_kinds(source)
    return None if compose(source) is None else _with_readings(read_document(source))


def _refused(path: Path, text: str) -> InputError:
    return InputError(faults=[Fault(text=text, file=str(path))])


def _refuse_other_kinds(source: Source) -> None:
    text = ""
    if source.text.startswith(_VAULT):
        text = (
            "files of ansible-vault are not understood: an inventory needs no secret, as machines are"
            " reached with a key or the ssh agent; write this one in plain YAML"
        )
    elif source.text.startswith("#!"):
        text = f"scripts that print an inventory are not run; write what it prints to a file: {CONVERT}"
    if text:
        raise InputError(faults=[source.fault(text, line=1, column=1)])


def _ini_fault(source: Source) -> Fault | None:
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
    root = compose(document.source)
    if root is not None:
        document.faults += _reading_faults(document.source, root)
    if not document.faults:
        document.faults += _loading_faults(document.source)
    return document


def _loading_faults(source: Source) -> list[Fault]:
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


def _reading_faults(source: Source, root: Node) -> Iterator[Fault]:
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
    ours = resolve_scalar(node.text)
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
