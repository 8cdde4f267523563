"""
Steps that a group of machines declares for itself in `cosmos_provision`: idempotent, of few kinds.

A step says what should be, never how to get there; the plan of `cosmos up` compares it with what is.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict

from cosmos_cli.models.text_forms import (
    NOT_EMPTY,
    FileMode,
    MachinePath,
    NonBlank,
    SystemPackage,
    SystemUser,
    compile_expression,
    like,
)
from madns_runtime.bounded_files import FileRefused, check_regular_file

FILE_BYTES_MAX = 64 * 1024 * 1024  # CONTENT_BYTES_MAX there

StepFault = tuple[tuple[str | int, ...], str]
"""The path within `cosmos_provision`, and what is wrong there."""


class _Declared(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class FileContent(_Declared):
    """A file with a given content."""

    dest: MachinePath
    """Path on the machine."""
    src: NonBlank | None = None
    """The file here, relative to the inventory's folder; of a `Machine` it is absolute."""
    content: str | None = None
    """The content itself, instead of `src`."""
    mode: FileMode | None = None
    """Permissions, octal; as they are, or 0644 for a new file, if not given."""
    owner: SystemUser | None = None
    """Its owner; as it is, or who writes it, if not given."""
    group: SystemUser | None = None
    """Its group."""


class LineInFile(_Declared):
    """One line that a file has, or has not."""

    path: MachinePath
    """The file on the machine."""
    line: Annotated[str, like(r"[^\r\n]*\S[^\r\n]*", "one line of text")] | None = None
    """The whole line, without its end."""
    regexp: NonBlank | None = None
    """Python regular expression: the last line it is found in is replaced; with absent, every one is removed."""
    state: Literal["present", "absent"] = "present"
    """Whether the line is to be there."""
    create: bool = False
    """Whether a file that is missing is made; otherwise that is a failure."""


class SystemdService(_Declared):
    """A unit of systemd."""

    name: Annotated[str, like(r"[A-Za-z0-9_][A-Za-z0-9_.@:\\-]*", "the name of a systemd unit")]
    """Name of the unit; `.service` may be left out."""
    enabled: bool | None = None
    """Whether it starts with the machine; as it is if not given."""
    state: Literal["started", "stopped"] | None = None
    """Whether it runs; as it is if not given."""


class ShellCommand(_Declared):
    """A shell command for what no other kind can say, with a test that tells whether it was done."""

    run: NonBlank
    """Command for /bin/sh."""
    creates: MachinePath | None = None
    """A path that exists once it is done."""
    unless: NonBlank | None = None
    """A shell command that succeeds once it is done; it must change nothing."""


Action = tuple[str, ...] | FileContent | LineInFile | SystemdService | ShellCommand
"""Desired state of a step; a tuple holds the names of system packages."""


class ProvisionStep(_Declared):
    """One step: exactly one kind of action."""

    name: NonBlank | None = None
    """Description for people."""
    become: bool = True
    """Whether it is done as root."""
    packages: Annotated[tuple[SystemPackage, ...], NOT_EMPTY] | None = None
    """System packages that are to be installed."""
    file: FileContent | None = None
    """A file with a given content."""
    line: LineInFile | None = None
    """One line that a file has, or has not."""
    service: SystemdService | None = None
    """A unit of systemd."""
    command: ShellCommand | None = None
    """A shell command with a test that tells whether it was done."""

    @property
    def kind(self) -> str:
        """Kind, one of KINDS."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def action(self) -> Action:
        """Desired state."""
        action: Action = getattr(self, self.kind)
        return action

    def with_source_in(self, folder: Path) -> ProvisionStep:
        """Return the step with the absolute path of its `src`, which is relative to *folder*."""
        if self.file is None or self.file.src is None:
            return self
        source = str(source_path(self.file.src, folder))
        return self.model_copy(update={"file": self.file.model_copy(update={"src": source})})


KINDS = tuple(name for name in ProvisionStep.model_fields if name not in ("name", "become"))
"""Of steps: every field that is an action."""


def source_path(src: str, folder: Path) -> Path:
    """Return the absolute path of a file here that a step names."""
    return (folder / os.path.expanduser(src)).absolute()


def step_faults(steps: Any, folder: Path) -> list[StepFault]:
    """
    Return what no single field of a step can know to be wrong.

    Args:
        steps: The value of `cosmos_provision` as it was written; what the model refuses is left out.
        folder: The inventory's, from which `src` is found.
    """
    return [
        ((index, *path), text)
        for index, step in enumerate(steps if isinstance(steps, list) else ())
        if isinstance(step, Mapping)
        for path, text in _faults_of_step(step, folder)
    ]


def _faults_of_step(step: Mapping[str, Any], folder: Path) -> Iterator[StepFault]:
    kinds = [kind for kind in KINDS if step.get(kind) is not None]
    is_misspelt = any(key not in ProvisionStep.model_fields for key in step)
    if len(kinds) > 1 or not (kinds or is_misspelt):
        got = " and ".join(kinds) or "none of them"
        yield (), f"expected exactly one of {', '.join(KINDS)} in a step, got {got}"
    for kind in kinds:
        if kind in _CHECKS and isinstance(step[kind], Mapping):
            for path, text in _CHECKS[kind](step[kind], folder):
                yield (kind, *path), text


def _file_faults(file: Mapping[str, Any], folder: Path) -> Iterator[StepFault]:
    src = file.get("src")
    given = [key for key in ("src", "content") if file.get(key) is not None]
    if len(given) != 1:
        yield (), f"expected exactly one of src and content, got {' and '.join(given) or 'neither'}"
    if isinstance(src, str) and src.strip():
        problem = _source_problem(source_path(src, folder))
        if problem:
            yield ("src",), problem


def _source_problem(path: Path) -> str:
    try:
        check_regular_file(path, bytes_max=FILE_BYTES_MAX)
    except FileNotFoundError:
        return f"no such file: {path}; it is looked for from the inventory's folder"
    except FileRefused as error:
        return str(error)
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"
    return ""


def _line_faults(line: Mapping[str, Any], folder: Path) -> Iterator[StepFault]:
    text, regexp = line.get("line"), line.get("regexp")
    if line.get("state", "present") == "present" and text is None:
        yield (), "expected line: the line that is to be present"
    if line.get("state") == "absent" and (text is None) == (regexp is None):
        yield (), "expected exactly one of line and regexp with state: absent"
    if not isinstance(regexp, str):
        return
    try:
        found = compile_expression(regexp)
    except ValueError as error:
        yield ("regexp",), str(error)
        return
    is_present = line.get("state", "present") == "present"
    if is_present and isinstance(text, str) and not found.search(text):
        why = "the next `cosmos up` would not find what this one wrote, and write it again"
        yield ("regexp",), f"expected it to be found in the line {text!r}, too: {why}"


def _service_faults(service: Mapping[str, Any], folder: Path) -> Iterator[StepFault]:
    if service.get("enabled") is None and service.get("state") is None:
        yield (), "expected enabled, state or both: nothing is asked of the service"


def _command_faults(command: Mapping[str, Any], folder: Path) -> Iterator[StepFault]:
    given = [key for key in ("creates", "unless") if command.get(key) is not None]
    if len(given) != 1:
        why = "it tells whether the command was done already"
        got = " and ".join(given) or "neither"
        yield (), f"expected exactly one of creates and unless, got {got}: {why}"


_CHECKS: Mapping[str, Callable[[Mapping[str, Any], Path], Iterator[StepFault]]] = {
    "file": _file_faults,
    "line": _line_faults,
    "service": _service_faults,
    "command": _command_faults,
}
