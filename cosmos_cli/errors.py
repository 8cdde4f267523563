"""
The operator's error tree. Each error knows its exit code; only `cosmos_cli.app.main` turns one into text.

Exit codes: 0 ok, 1 run failed, 2 bad input, 3 machines unreachable or failed, 4 real-time budget or
a check broken, 5 data incomplete, 130 interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
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


class ExitCode(IntEnum):
    """What a script can rely on."""

    OK = 0
    RUN_FAILED = 1
    BAD_INPUT = 2
    MACHINES = 3
    BUDGET_BROKEN = 4
    DATA_INCOMPLETE = 5
    INTERRUPTED = 130


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing wrong with what a person wrote, and where it stands."""

    text: str
    """What was expected and what came."""
    path: str = ""
    """Dotted path, such as agents.count; empty when the whole file is meant."""
    file: str = ""
    line: int | None = None
    """Counted from 1, as is `column`; None when no single place is to blame."""
    column: int | None = None
    source: str = ""
    """The line of the file, for the caret."""
    override: str = ""
    """KEY when the value came from --set KEY=VALUE."""

    def render(self) -> str:
        """Return `file:line:col: path: text`, with the source line and a caret under it where there is one."""
        parts = [self._where(), self._shown_path(), self.text]
        head = ": ".join(part for part in parts if part)
        if not self.source or self.column is None:
            return head
        source, caret = _clip(self.source, self.column - 1)
        return f"{head}\n    {source}\n    {' ' * caret}^"

    def to_mapping(self) -> dict[str, Any]:
        """Return the fault for --json."""
        return {
            "file": self.file or None,
            "line": self.line,
            "column": self.column,
            "path": self.path or None,
            "override": self.override or None,
            "message": self.text,
        }

    def _where(self) -> str:
        if self.override:
            return f"--set {self.override}"
        if self.line is None:
            return self.file
        return f"{self.file}:{self.line}:{self.column}"

    def _shown_path(self) -> str:
        return "" if self.override and self.path == self.override else self.path


def _clip(source: str, index: int) -> tuple[str, int]:
    """Return a window of *source* that fits a terminal, and where *index* stands in it."""
    text = source.replace("\t", " ").rstrip()
    if len(text) <= SOURCE_CHARACTERS_MAX:
        return text, index
    start = max(0, min(index - SOURCE_CHARACTERS_MAX // 2, len(text) - SOURCE_CHARACTERS_MAX))
    window = text[start : start + SOURCE_CHARACTERS_MAX]
    left, right = ("..." if start else ""), ("..." if start + len(window) < len(text) else "")
    return f"{left}{window}{right}", index - start + len(left)


class CosmosError(Exception):
    """Any failure that the command line foresees."""

    exit_code: ExitCode = ExitCode.RUN_FAILED
    kind = "error"

    def details(self) -> Mapping[str, Any]:
        """Return what --json shows beside kind and message."""
        return {}


class RunFailedError(CosmosError):
    """The run did not come to its end; the message says who is to blame."""

    kind = "run_failed"


class InputError(CosmosError):
    """Something a person wrote is wrong: a file, an option. Carries every fault found."""

    exit_code = ExitCode.BAD_INPUT
    kind = "input"

    def __init__(self, message: str = "", *, faults: Sequence[Fault] = ()) -> None:
        self.faults = tuple(faults)
        super().__init__(message or "\n".join(fault.render() for fault in self.faults))

    def details(self) -> Mapping[str, Any]:
        """Return the faults."""
        return {"faults": [fault.to_mapping() for fault in self.faults]}


class MachinesError(CosmosError):
    """Machines are unreachable or failed; the message names each and its last words."""

    exit_code = ExitCode.MACHINES
    kind = "machines"


class BudgetError(CosmosError):
    """The real-time budget or a check is broken."""

    exit_code = ExitCode.BUDGET_BROKEN
    kind = "budget"


class DataIncompleteError(CosmosError):
    """A run's data is missing or cut; the message names whose."""

    exit_code = ExitCode.DATA_INCOMPLETE
    kind = "data_incomplete"


class InterruptedRun(CosmosError):
    """The operator ended the run; what was recorded is kept."""

    exit_code = ExitCode.INTERRUPTED
    kind = "interrupted"


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
