"""
The inventory: on which machines. A valid Ansible inventory, of which a part is understood.

That part is groups with `hosts`, `children` and `vars`, and numeric ranges such as pi[01:24]. What is not understood (templates, other connections, an unknown cosmos_ variable) is a fault and
never skipped; variables of others are kept.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import Document, did_you_mean, kind_of, read_document
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.yaml_source import read_source

MACHINES_MAX = 5000
MACHINE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
GROUP_KEYS = ("hosts", "children", "vars")
ROOT = "all"

_RANGE = re.compile(r"\[([0-9]+):([0-9]+)(?::([0-9]+))?\]")


class Variables(BaseModel):
    """The variables that COSMoS knows; others pass through untouched."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    ansible_host: Annotated[str, Field(min_length=1)] | None = None
    """Address of the machine; its name if not given."""
    ansible_user: Annotated[str, Field(min_length=1)] | None = None
    """Who to log in as."""
    ansible_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Port of its SSH server."""
    ansible_connection: Literal["local", "ssh"] | None = None
    """local for this computer."""
    ansible_ssh_private_key_file: Annotated[str, Field(min_length=1)] | None = None
    """Key to log in with."""
    cosmos_root: Annotated[str, Field(min_length=1)] | None = None
    """Folder on the machine that belongs to COSMoS."""
    cosmos_cpu_affinity: tuple[Annotated[int, Field(ge=0)], ...] | None = None
    """Processors that agents may use there."""
    cosmos_devices: tuple[str, ...] | None = None
    """Devices attached to it, such as sense_hat."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """One computer of the inventory."""

    name: str
    address: str
    connection: Literal["local", "ssh"] = "ssh"
    groups: tuple[str, ...] = ()
    """Every group it belongs to, the outermost first."""
    variables: Mapping[str, Any] = field(default_factory=dict)
    """All variables: of its groups, the inner winning over the outer, then its own."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "name": self.name,
            "address": self.address,
            "connection": self.connection,
            "groups": list(self.groups),
            "variables": dict(self.variables),
        }


def load_inventory(path: Path) -> tuple[Machine, ...]:
    """
    Read an inventory and return its machines in the order of the file.

    Raises:
        InputError: With every fault found, in the order of the file.
    """
    document = read_document(read_source(path))
    reader = _Reader(document, faults=list(document.faults))
    for name, value in document.value.items():
        reader.group(name, value, (name,), ())
    if not reader.faults and not reader.own:
        reader.faults.append(document.fault((), "expected at least one machine under hosts"))
    if reader.faults:
        raise InputError(faults=sorted(reader.faults, key=lambda f: (f.line or 0, f.column or 0)))
    return tuple(reader.machine(name) for name in reader.own)


@dataclass(slots=True)
class _Reader:
    """Walks the groups and collects who is in which, with what variables."""

    document: Document
    faults: list[Fault] = field(default_factory=list)
    group_variables: dict[str, dict[str, Any]] = field(default_factory=dict)
    parents: dict[str, set[str]] = field(default_factory=dict)
    depths: dict[str, int] = field(default_factory=dict)
    members: dict[str, set[str]] = field(default_factory=dict)
    """The groups under whose `hosts` each machine stands."""
    own: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Each machine's own variables."""

    def group(self, name: str, value: Any, path: ValuePath, above: tuple[str, ...]) -> None:
        if name in above:
            self.fault(path, f"group {name} is inside itself")
            return
        outer = above or ((ROOT,) if name != ROOT else ())
        self.parents.setdefault(name, set()).update(outer[-1:])
        self.depths[name] = max(self.depths.get(name, 0), len(outer))
        if not self.is_mapping(value, path):
            return
        for key in value:
            if key not in GROUP_KEYS:
                hint = did_you_mean(key, GROUP_KEYS)
                self.faults.append(
                    self.document.fault((*path, key), f"unknown key{hint}", at_key=True)
                )
        self.hosts(name, value.get("hosts"), (*path, "hosts"))
        variables = self.variables(value.get("vars"), (*path, "vars"))
        self.group_variables.setdefault(name, {}).update(variables)
        children, inner = value.get("children"), (*path, "children")
        if self.is_mapping(children, inner):
            for child, content in children.items():
                self.group(child, content, (*inner, child), (*outer, name))

    def hosts(self, group: str, value: Any, path: ValuePath) -> None:
        if not self.is_mapping(value, path):
            return
        for pattern, content in value.items():
            inner = (*path, pattern)
            variables = self.variables(content, inner)
            try:
                names = expand(pattern)
            except ValueError as error:
                self.faults.append(self.document.fault(inner, str(error), at_key=True))
                continue
            for name in names:
                self.members.setdefault(name, set()).add(group)
                self.own.setdefault(name, {}).update(variables)
        if len(self.own) > MACHINES_MAX:
            raise InputError(
                faults=[self.document.fault(path, f"expected at most {MACHINES_MAX} machines")]
            )

    def variables(self, value: Any, path: ValuePath) -> dict[str, Any]:
        if value is None or not self.is_mapping(value, path):
            return {}
        for key, content in value.items():
            if isinstance(content, str) and "{{" in content:
                self.fault((*path, key), f"templates are not understood, got {content!r}")
            elif key.startswith("cosmos_") and key not in Variables.model_fields:
                known = [name for name in Variables.model_fields if name.startswith("cosmos_")]
                text = f"unknown variable{did_you_mean(key, known)}"
                self.faults.append(self.document.fault((*path, key), text, at_key=True))
        try:
            Variables.model_validate(_with_tuples(value), strict=True)
        except ValidationError as error:
            errors = error.errors(include_url=False)
            self.faults += faults_of(self.document, errors, Variables, below=path)
        return dict(value)

    def is_mapping(self, value: Any, path: ValuePath) -> bool:
        if value is not None and not isinstance(value, dict):
            self.fault(path, f"expected a mapping, got {kind_of(value)}")
        return isinstance(value, dict)

    def fault(self, path: ValuePath, text: str) -> None:
        self.faults.append(self.document.fault(path, text))

    def machine(self, name: str) -> Machine:
        groups = sorted(self.groups_of(name), key=lambda group: (self.depths.get(group, 0), group))
        variables: dict[str, Any] = {}
        for group in groups:
            variables |= self.group_variables.get(group, {})
        variables |= self.own[name]
        return Machine(
            name=name,
            address=variables.get("ansible_host") or name,
            connection=variables.get("ansible_connection") or "ssh",
            groups=tuple(groups),
            variables=variables,
        )

    def groups_of(self, name: str) -> set[str]:
        found: set[str] = set()
        waiting = list(self.members[name])
        while waiting:
            group = waiting.pop()
            if group not in found:
                found.add(group)
                waiting += self.parents.get(group, ())
        return found


def _with_tuples(value: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values with tuples for lists, which is what strict validation takes for a sequence."""
    return {key: tuple(item) if isinstance(item, list) else item for key, item in value.items()}


def expand(pattern: str) -> list[str]:
    """
    Return the machines that a name with ranges means: pi[01:03] is pi01, pi02, pi03, both ends included.

    Raises:
        ValueError: It is no name, or a range is empty, too long, or not of numbers.
    """
    pieces: list[list[str]] = []
    position = 0
    for match in _RANGE.finditer(pattern):
        pieces += [[pattern[position : match.start()]], list(_numbers(match))]
        position = match.end()
    pieces.append([pattern[position:]])
    count = 1
    for piece in pieces:
        count *= len(piece)
    if count > MACHINES_MAX:
        raise ValueError(f"expected at most {MACHINES_MAX} machines, got {count}")
    names = ["".join(parts) for parts in itertools.product(*pieces)]
    for name in names:
        if "[" in name or "]" in name:
            raise ValueError(f"expected a range of numbers such as pi[01:24], got {pattern!r}")
        if not MACHINE_NAME.fullmatch(name) or name == "host":
            text = "expected letters, digits, '.', '_' or '-' (`host` is reserved)"
            raise ValueError(f"{text}, got {name!r}")
    return names


def _numbers(match: re.Match[str]) -> Iterator[str]:
    first, last, step = match.group(1), match.group(2), int(match.group(3) or 1)
    if first.startswith("0") and len(first) != len(last):
        raise ValueError(f"expected ends of the same width, got {match.group(0)}")
    numbers = range(int(first), int(last) + 1, step) if step else range(0)
    if not numbers or len(numbers) > MACHINES_MAX:
        raise ValueError(f"expected a rising range of numbers, got {match.group(0)}")
    width = len(first) if first.startswith("0") else 0
    return (f"{number:0{width}d}" for number in numbers)
