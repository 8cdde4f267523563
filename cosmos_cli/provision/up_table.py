"""What `cosmos up` prints: the plan, differences, a line a machine, the verdict, and the same as JSON. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from cosmos_cli.console import Column
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.names import compact
from cosmos_cli.provision.brought import Brought
from cosmos_cli.provision.step import Change, Step

COLUMNS = (Column("machine"), Column("board"), Column("result"))
FAILURE_CHARACTERS_MAX = 600
"""Of a failure in the table; --json has all of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineResult:
    """One machine's line."""

    machine: str
    brought: Brought
    duration_s: float = 0.0

    @property
    def failure(self) -> MachineFailure | None:
        """Why it failed; None if it did not."""
        return self.brought.failure

    @property
    def status(self) -> Literal["ok", "changed", "failed"]:
        """What became of it."""
        if self.failure is not None:
            return "failed"
        return "changed" if self.brought.changed_count else "ok"

    def row(self, *, is_check: bool) -> tuple[str, str, str]:
        """Return its line of the table."""
        facts = self.brought.facts
        board = "" if facts is None else facts.board.model or facts.board.machine
        return self.machine, board, self._words(is_check=is_check)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        brought = self.brought
        return {
            "machine": self.machine,
            "status": self.status,
            "local": brought.is_local,
            "steps": [done.to_mapping() for done in brought.done],
            "facts": brought.facts.to_mapping() if brought.facts else {},
            "notes": list(brought.notes),
            "failure": self.failure.to_mapping() if self.failure else None,
            "duration_s": round(self.duration_s, 3),
        }

    def _words(self, *, is_check: bool) -> str:
        count = self.brought.changed_count
        if self.failure is not None:
            done = f" after {count} {'change' if count == 1 else 'changes'}" if count else ""
            return f"failed{done}: {_one_line(str(self.failure))}"
        if self.brought.is_local:
            return "ok (local: nothing is installed on this computer)"
        if not count:
            return "ok"
        return f"would change ({count})" if is_check else f"changed ({count})"


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    return (
        line if len(line) <= FAILURE_CHARACTERS_MAX else line[: FAILURE_CHARACTERS_MAX - 3] + "..."
    )


def verdict(results: Sequence[MachineResult], *, is_check: bool, duration_s: float) -> str:
    """Return the last line, such as "24 machines: 0 changed, 24 ok, 0 failed in 1.2 s"."""
    counts = {status: 0 for status in ("changed", "ok", "failed")}
    for result in results:
        counts[result.status] += 1
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
    groups: dict[tuple[str, ...], list[MachineResult]] = {}
    for result in results:
        if result.brought.planned:
            lines = tuple(_step_lines(result.brought.planned, has_diffs=has_diffs))
            groups.setdefault(lines, []).append(result)
    for lines, members in groups.items():
        yield f"{compact(member.machine for member in members)}:"
        yield from lines


def _step_lines(steps: Sequence[Step], *, has_diffs: bool) -> Iterator[str]:
    for step in steps:
        yield f"  {step.title}{' [root]' if step.needs_root else ''}"
        if has_diffs and step.change is not None:
            yield from (f"    {line}" for line in diff_lines(step.change))


def diff_lines(change: Change) -> Iterator[str]:
    """Yield what changes in a file, as `diff -u` would."""
    import difflib

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
    about: dict[str, list[str]] = {}
    for result in results:
        for note in result.brought.notes:
            about.setdefault(note, []).append(result.machine)
    for note, machines in about.items():
        yield f"{compact(machines)}: {note}"
