"""Output of `cosmos up`: the plan, differences, one line per machine, the verdict, and the same as JSON. Pure."""

from __future__ import annotations

import dataclasses
import difflib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.ui.console import Column
from cosmos_cli.ui.name_ranges import compact, names_by

if TYPE_CHECKING:  # what plans is imported while machines are logged in at
    from cosmos_cli.models.machine_facts import MachineFacts
    from cosmos_cli.provision.step import Change, Done, Step

COLUMNS = (Column("machine"), Column("board"), Column("result"))
FAILURE_CHARACTERS_MAX = 600
"""Characters of a failure in the table; --json has all of it."""
FAILURE_BEGIN_CHARACTERS = 150
"""Characters from the beginning of one that is longer: which step it was. The end, which is a program's last words and
what to do, has the rest."""


@dataclass(slots=True, kw_only=True)
class MachineResult:
    """Result of one machine; filled while it is worked on, so that a failure hides nothing."""

    machine: str
    facts: MachineFacts | None = None
    planned: tuple[Step, ...] = ()
    done: Sequence[Done] = ()
    notes: list[str] = field(default_factory=list)
    failure: MachineFailure | None = None
    is_local: bool = False
    duration_s: float = 0.0

    @property
    def changed_count(self) -> int:
        """Number of steps that changed something, or would."""
        return sum(done.changed for done in self.done)

    @property
    def status(self) -> Literal["ok", "changed", "failed"]:
        """Status of the machine."""
        if self.failure is not None:
            return "failed"
        return "changed" if self.changed_count else "ok"

    def row(self, *, is_check: bool) -> tuple[str, str, str]:
        """Return its line of the table."""
        board = "" if self.facts is None else self.facts.board.model or self.facts.board.machine
        return self.machine, board, self.words(is_check=is_check)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "machine": self.machine,
            "status": self.status,
            "local": self.is_local,
            "steps": [done.to_mapping() for done in self.done],
            "facts": self.facts.to_mapping() if self.facts else {},
            "notes": list(self.notes),
            "failure": self.failure.to_mapping() if self.failure else None,
            "duration_s": round(self.duration_s, 3),
        }

    def words(self, *, is_check: bool) -> str:
        """Return what became of it in one line."""
        count = self.changed_count
        if self.failure is not None:
            done = f" after {count} {'change' if count == 1 else 'changes'}" if count else ""
            return f"failed{done}: {_one_line(str(self.failure))}"
        if self.is_local:
            return "ok (local: nothing is installed on this computer)"
        if not count:
            return "ok"
        return f"would change ({count})" if is_check else f"changed ({count})"


def result_of(outcome: Outcome[MachineResult | None]) -> MachineResult:
    """Return what became of one machine; this computer, which is left alone, has no value."""
    result = outcome.value or MachineResult(
        machine=outcome.machine, failure=outcome.failure, is_local=outcome.failure is None
    )
    return dataclasses.replace(result, duration_s=outcome.duration_s)


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    if len(line) <= FAILURE_CHARACTERS_MAX:
        return line
    begin = line[:FAILURE_BEGIN_CHARACTERS] + " ... "
    return begin + line[len(begin) - FAILURE_CHARACTERS_MAX :]


def verdict(results: Sequence[MachineResult], *, is_check: bool, duration_s: float) -> str:
    """Return the last line, such as "24 machines: 0 changed, 24 ok, 0 failed in 1.2 s"."""
    counts = Counter(result.status for result in results)
    machines = "1 machine" if len(results) == 1 else f"{len(results)} machines"
    changed = "would change" if is_check else "changed"
    return (
        f"{machines}: {counts['changed']} {changed}, {counts['ok']} ok, {counts['failed']} failed"
        f" in {duration_s:.1f} s"
    )


def document(results: Sequence[MachineResult], *, is_check: bool) -> dict[str, Any]:
    """Return what --json prints."""
    return {
        "machines": [result.to_mapping() for result in results],
        "check": is_check,
        "changed": sum(result.status == "changed" for result in results),
        "failed": sum(result.status == "failed" for result in results),
    }


def plan_lines(results: Sequence[MachineResult], *, has_diffs: bool) -> Iterator[str]:
    """Yield the plans, machines with the same one together, with what changes in files if asked for."""
    groups = names_by(
        (tuple(_step_lines(result.planned, has_diffs=has_diffs)), result.machine)
        for result in results
        if result.planned
    )
    for lines, machines in groups.items():
        yield f"{compact(machines)}:"
        yield from lines


def _step_lines(steps: Sequence[Step], *, has_diffs: bool) -> Iterator[str]:
    for step in steps:
        yield f"  {step.title}{' [root]' if step.needs_root else ''}"
        if has_diffs and step.change is not None:
            yield from (f"    {line}" for line in diff_lines(step.change))


def diff_lines(change: Change) -> Iterator[str]:
    """Yield what changes in a file, as `diff -u` would."""
    before, after = _shown(change.before), _shown(change.after)
    if "\0" in before or "\0" in after:
        yield "a content that is no text"
        return
    names = (
        f"{change.path} {'(missing)' if change.before is None else '(now)'}",
        f"{change.path} {'(removed)' if change.after is None else '(then)'}",
    )
    yield from difflib.unified_diff(
        before.splitlines(), after.splitlines(), *names, n=2, lineterm=""
    )


def _shown(text: str | None) -> str:
    return (text or "").encode(errors="replace").decode()


def note_lines(results: Sequence[MachineResult]) -> Iterator[str]:
    """Yield each note once, with the machines that it is about."""
    about = names_by((note, result.machine) for result in results for note in result.notes)
    for note, machines in about.items():
        yield f"{compact(machines)}: {note}"
