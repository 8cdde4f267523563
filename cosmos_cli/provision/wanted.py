"""What a machine should be like: from its entry in the inventory, the scenarios, and what was built for it. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosmos_cli.fleet.layout import Layout
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.provision_steps import Command, FileContent, LineInFile, ProvisionStep
from cosmos_cli.provision.facts import condition_key

MEMORY_FILE = "settings.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """Where a machine's system keeps its settings; tests point them elsewhere."""

    etc: str = "/etc"
    sys: str = "/sys"
    proc: str = "/proc"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The settings of a tower; None leaves the machine's own, and puts it back where it was set."""

    receive_buffer_bytes: int | None = None
    realtime_priority: int | None = None
    cpu_governor: str | None = None
    wifi: bool | None = None
    bluetooth: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """What a file is to hold."""

    data: bytes = field(repr=False)
    sha256: str

    @classmethod
    def of(cls, data: bytes) -> Content:
        """Return bytes with their hash."""
        return cls(data=data, sha256=hashlib.sha256(data).hexdigest())


@dataclass(frozen=True, slots=True, kw_only=True)
class Declared:
    """A step of `cosmos_provision`, with its file's content; paths have no ~ any more."""

    step: ProvisionStep
    path: str | None = None
    """Of the file, or of the one that the line is in."""
    condition: Mapping[str, Any] | None = None
    """Of a command: what the machine is asked to learn whether it is done."""
    content: Content | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """All that a machine should have and be."""

    layout: Layout
    """Its root has no ~ any more."""
    paths: Paths = field(default_factory=Paths)
    may_become_root: bool = True
    """False when the inventory says ansible_become: false."""
    packages: tuple[str, ...] = ()
    """System packages: the inventory's, then those of the environment."""
    declared: tuple[Declared, ...] = ()
    settings: Settings = field(default_factory=Settings)
    environments: tuple[Any, ...] = ()
    """Of `provision.wheelhouse.Environment`: one for each scenario, or one for the runtime alone."""
    trees: tuple[Any, ...] = ()
    """Of `provision.trees.Tree`."""

    @property
    def directories(self) -> tuple[str, ...]:
        """Folders that are to be there."""
        layout = self.layout
        return (
            layout.root,
            layout.state,
            layout.trees,
            layout.environments,
            layout.wheels,
            layout.runs,
        )

    @property
    def memory_path(self) -> str:
        """The file there that remembers what settings were before."""
        return f"{self.layout.state}/{MEMORY_FILE}"

    @property
    def distinct_environments(self) -> tuple[Any, ...]:
        """Each environment once; most scenarios share one."""
        return tuple({each.key: each for each in self.environments}.values())

    @property
    def all_packages(self) -> tuple[str, ...]:
        """Every system package that any part of it names."""
        names = [*self.packages]
        for declared in self.declared:
            names += declared.step.packages or ()
        return tuple(dict.fromkeys(names))


def wanted_of(
    machine: Machine,
    *,
    home: str,
    read_file: Callable[[Path], Content],
    environments: tuple[Any, ...] = (),
    trees: tuple[Any, ...] = (),
) -> Wanted:
    """
    Return what a machine should be like.

    Args:
        machine: Its entry in the inventory.
        home: Of who logs in there.
        read_file: Gives the content of a file here.
        environments: Built for it.
        trees: Code and scenarios.
    """
    distribution = [name for built in environments for name in built.distribution_packages]
    return Wanted(
        layout=Layout(at_home(machine.root, home)),
        may_become_root=machine.may_become_root,
        packages=tuple(dict.fromkeys([*machine.packages, *distribution])),
        declared=tuple(_declared(step, machine, home, read_file) for step in machine.provision),
        settings=Settings(
            receive_buffer_bytes=machine.receive_buffer_bytes,
            realtime_priority=machine.realtime_priority,
            cpu_governor=machine.cpu_governor,
            wifi=machine.wifi,
            bluetooth=machine.bluetooth,
        ),
        environments=environments,
        trees=trees,
    )


def at_home(path: str, home: str) -> str:
    """Return a path of a machine without ~, which root would take for its own."""
    return home + path[1:] if path == "~" or path.startswith("~/") else path


def _declared(
    step: ProvisionStep, machine: Machine, home: str, read_file: Callable[[Path], Content]
) -> Declared:
    match step.action:
        case FileContent(dest=dest, src=src, content=content):
            data = read_file(Path(src)) if src is not None else Content.of((content or "").encode())
            return Declared(step=step, path=at_home(dest, home), content=data)
        case LineInFile(path=path):
            return Declared(step=step, path=at_home(path, home))
        case Command() as command:
            as_root = step.become and machine.may_become_root
            return Declared(step=step, condition=_condition(command, home=home, as_root=as_root))
        case _:
            return Declared(step=step)


def _condition(command: Command, *, home: str, as_root: bool) -> dict[str, Any]:
    if command.creates is not None:
        return {"creates": at_home(command.creates, home)}
    return {"unless": command.unless, "root": as_root}


def questions(
    wanted: Wanted, *, setting_files: Sequence[str], has_texts: bool = False
) -> dict[str, Any]:
    """
    Return the arguments of the verb "facts": what the plan needs to know.

    Args:
        wanted: What the machine should be like.
        setting_files: Files that settings are written to.
        has_texts: Whether contents of files are wanted too, for --diff.
    """
    paths = wanted.paths
    return {
        "root": wanted.layout.root,
        "etc": paths.etc,
        "sys": paths.sys,
        "proc": paths.proc,
        "files": dict(_files(wanted, setting_files, has_texts)),
        "packages": list(wanted.all_packages),
        "services": sorted(
            {d.step.service.name for d in wanted.declared if d.step.service is not None}
        ),
        "conditions": {
            condition_key(d.condition): d.condition
            for d in wanted.declared
            if d.condition is not None
        },
    }


def _files(
    wanted: Wanted, setting_files: Sequence[str], has_texts: bool
) -> Iterator[tuple[str, str]]:
    yield from ((path, "look") for path in wanted.directories)
    yield from ((path, "text") for path in (*setting_files, wanted.memory_path))
    files = [declared for declared in wanted.declared if declared.path is not None]
    for declared in files:
        if declared.content is not None:
            yield str(declared.path), "text" if has_texts else "hash"
    for declared in files:  # later ones win: a line needs the text
        if declared.content is None:
            yield str(declared.path), "text"
