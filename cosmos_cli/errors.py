"""
The operator's error tree. Each error knows its exit code; only `cosmos_cli.app.main` turns one into text.

Exit codes: 0 ok, 1 run failed, 2 bad input, 3 machines unreachable or failed, 4 real-time budget or
a check broken, 5 data incomplete, 130 interrupted.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

from madns_runtime.errors import (
    ConfigurationError,
    MachineError,
    MadnsError,
    MessageTooLarge,
    MissingExtraError,
    PluginError,
)

SOURCE_CHARACTERS_MAX = 100
PART_CHARACTERS_MAX = 2000
FAULTS_SHOWN_MAX = 100
"""Of one error; nobody mends more at a time, and a file can hold a hundred thousand."""


class ExitCode(IntEnum):
    """Exit codes that a script can rely on."""

    OK = 0
    RUN_FAILED = 1
    BAD_INPUT = 2
    MACHINES = 3
    BUDGET_BROKEN = 4
    DATA_INCOMPLETE = 5
    INTERRUPTED = 130


FAILED_RUNS = (ExitCode.RUN_FAILED, ExitCode.MACHINES, ExitCode.INTERRUPTED)
"""Exit codes of runs that went wrong, whatever their checks say."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing wrong with what a person wrote, and where it stands."""

    text: str
    """The expectation, and the value that came."""
    path: str = ""
    """Dotted path, such as agents.count; empty when the whole file is meant."""
    file: str = ""
    line: int | None = None
    """Counted from 1, as is `column`; None when no single place is to blame."""
    column: int | None = None
    source: str = ""
    """The line of the file, for the caret."""
    caret: int | None = None
    """Position of `column` in `source`, from 0, if that is only a part of the line."""
    override: str = ""
    """KEY when the value came from --set KEY=VALUE."""
    option: str = ""
    """The option that was typed instead of that --set, such as --duration."""

    def render(self) -> str:
        """
        Return `file:line:col: path: text`, with the source line and a caret under it where there is one.

        Of what somebody wrote no line begins where a fault does: ends of lines are told, and those of a text indented.
        """
        path = "" if self.path == self.override else in_one_line(self.path)
        parts = [self._where(), _cut(path), _cut(self.text).replace("\n", "\n    ")]
        head = ": ".join(part for part in parts if part)
        if not self.source or self.column is None:
            return head
        shown = self.clipped()
        source = shown.source.replace("\n", " ")
        return f"{head}\n    {source}\n    {' ' * (shown.caret or 0)}^"

    def clipped(self) -> Fault:
        """Return the fault with no more of its line than is shown."""
        if not self.source or self.column is None or self.caret is not None:
            return self
        source, caret = _clip(self.source, self.column - 1)
        return replace(self, source=source, caret=caret)

    def to_mapping(self) -> dict[str, Any]:
        """Return the fault for --json."""
        return {
            "file": self.file or None,
            "line": self.line,
            "column": self.column,
            "path": _cut(self.path) or None,
            "override": self.override or None,
            "message": _cut(self.text),
        }

    def _where(self) -> str:
        if self.option:
            return self.option
        if self.override:
            return f"--set {in_one_line(self.override)}"
        file = in_one_line(self.file)
        return file if self.line is None else f"{file}:{self.line}:{self.column}"


def in_one_line(text: str) -> str:
    r"""Return a text with its ends of lines told, as `\n`: a name that holds some must not look like two messages."""
    return text.replace("\n", "\\n").replace("\r", "\\r")


def _cut(text: str) -> str:
    """Return a text of a length that somebody reads: keys and numbers in a file may be of megabytes."""
    if len(text) <= PART_CHARACTERS_MAX:
        return text
    half = PART_CHARACTERS_MAX // 2
    return f"{text[:half]} ... ({len(text)} characters) ... {text[-half:]}"


def _clip(source: str, index: int) -> tuple[str, int]:
    """Return a window of *source* that fits a terminal, and where *index* stands in it."""
    size = len(source)
    while size and source[size - 1].isspace():
        size -= 1
    if size <= SOURCE_CHARACTERS_MAX:
        return source[:size].replace("\t", " "), index
    start = max(0, min(index - SOURCE_CHARACTERS_MAX // 2, size - SOURCE_CHARACTERS_MAX))
    window = source[start : start + SOURCE_CHARACTERS_MAX].replace("\t", " ")
    left, right = ("..." if start else ""), ("..." if start + len(window) < size else "")
    return f"{left}{window}{right}", index - start + len(left)


class CosmosError(Exception):
    """Any failure that the command line foresees."""

    exit_code: ExitCode = ExitCode.RUN_FAILED
    kind = "error"

    def details(self) -> Mapping[str, Any]:
        """Return what --json shows beside kind and message."""
        return {}


class RunFailedError(CosmosError):
    """
    The run did not come to its end; the message says who is to blame.

    Args:
        message: Of a run that was judged, its verdict.
        exit_code: Its own, where it has one.
        run: Its directory, where its evidence can be looked at.
    """

    kind = "run_failed"

    def __init__(
        self, message: str, *, exit_code: ExitCode = ExitCode.RUN_FAILED, run: Path | None = None
    ) -> None:
        self.exit_code = exit_code
        self.run = run
        super().__init__(message)

    def details(self) -> Mapping[str, Any]:
        """Return the run's directory, if it is known."""
        return {} if self.run is None else {"run": str(self.run)}


class InputError(CosmosError):
    """Something a person wrote is wrong: a file, an option. Carries the first faults found, and how many more there are."""

    exit_code = ExitCode.BAD_INPUT
    kind = "input"

    def __init__(
        self, message: str = "", *, faults: Sequence[Fault] = (), omitted: int = 0
    ) -> None:
        self.faults = tuple(faults[:FAULTS_SHOWN_MAX])
        self.omitted = omitted + max(0, len(faults) - FAULTS_SHOWN_MAX)
        """Number of further faults."""
        lines = [fault.render() for fault in self.faults]
        if self.omitted:
            lines.append(f"and {self.omitted} more fault{'' if self.omitted == 1 else 's'}")
        super().__init__(message or "\n".join(lines))

    @property
    def all_faults(self) -> tuple[Fault, ...]:
        """The faults, or the message as one: who collects those of many files must lose none."""
        return self.faults or (Fault(text=str(self)),)

    def details(self) -> Mapping[str, Any]:
        """Return the faults."""
        return {
            "faults": [fault.to_mapping() for fault in self.faults],
            "faults_omitted": self.omitted,
        }


def check_path_is_text(path: Path) -> None:
    """
    Refuse a path that cannot be written into records and sent to machines, all of which are UTF-8.

    Raises:
        InputError: Its name, or that of a folder above it, is none.
    """
    real = os.path.realpath(path)
    try:
        real.encode()
    except UnicodeEncodeError:
        text = "expected a path in UTF-8; rename the folder or file"
        raise InputError(faults=[Fault(text=text, file=real)]) from None


class MachinesError(CosmosError):
    """Machines are unreachable or failed; the message names each and its last words."""

    exit_code = ExitCode.MACHINES
    kind = "machines"


def exit_code_of(error: CosmosError | MadnsError) -> ExitCode:
    """Return the exit code of any foreseen error."""
    if isinstance(error, CosmosError):
        return error.exit_code
    if isinstance(error, ConfigurationError | PluginError | MissingExtraError | MessageTooLarge):
        return ExitCode.BAD_INPUT
    if isinstance(error, MachineError):
        return ExitCode.MACHINES
    return ExitCode.RUN_FAILED


def describe(error: CosmosError | MadnsError) -> dict[str, Any]:
    """Return an error as --json prints it."""
    kind = error.kind if isinstance(error, CosmosError) else type(error).__name__
    details = dict(error.details()) if isinstance(error, CosmosError) else {}
    return {
        "error": {"kind": kind, "message": str(error), **details},
        "exit_code": int(exit_code_of(error)),
    }
