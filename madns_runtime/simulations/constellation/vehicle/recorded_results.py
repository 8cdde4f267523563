"""
Results of commands and refusals of messages in a rerun, each held until the tick in which the recorded run told it.

In lockstep a result comes in the first tick that can know it. In real time the host's turn and the network may bring it
a tick later; or a tick that woke up late hears of what was over after its nominal time: the host of a rerun tells what
is over a tick ahead, see `LEAD_TICKS`. Flight software that is told in the recorded tick sees the same as then. A
result's revision counts the changes of truth in the order in which the host heard of them, and is as on record, too; so is
how late a command came, which its reason tells, and what the tank held when it was over, which the host of a rerun reads
before it has heard the commands of the tick between.
Where today's commands are no longer those on record, from the first one that is given in another tick on, results are
told as they would come.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Generic, NamedTuple, TypeVar

from madns_runtime.errors import BlamedError
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.messages import (
    LEAD_TICKS,
    TOO_LATE,
    CommandResult,
    TransmissionRefusal,
)

HELD_MAX: Final = 4096
"""Results that are held, and refusals; further ones are told as they come, and counted."""
NEVER: Final = 1 << 62
AT_ONCE: Final = (-1, 0)
News = TypeVar("News")


class _Told(NamedTuple):
    """Record of a result."""

    due: tuple[int, int]
    """Tick, and place among all results."""
    revision: int
    propellant_kg: float | None
    reason: str

    def over(self, result: CommandResult) -> CommandResult:
        """Return a result with what is its record's to tell."""
        left_kg = self.propellant_kg if result.status == "executed" else None
        return replace(
            result,
            revision=self.revision,
            propellant_kg=result.propellant_kg if left_kg is None else left_kg,
            reason=_as_late(result.reason, self.reason),
        )


class HeldNews(Generic[News]):
    """Results that have come and wait for their tick, in the order on record."""

    def __init__(self) -> None:
        self._held: list[tuple[tuple[int, int], News]] = []
        self.overflown = 0
        """Told as it came since too much was held."""

    def hold(self, due: tuple[int, int], news: News) -> None:
        """Take what has come, with tick and place at which it is due."""
        if len(self._held) >= HELD_MAX and due != AT_ONCE:
            self.overflown += 1
            due = AT_ONCE
        self._held.append((due, news))

    def take(self, tick: int) -> list[News]:
        """Return what is due by a tick."""
        ready = sorted((one for one in self._held if one[0][0] <= tick), key=lambda one: one[0])
        self._held = [one for one in self._held if one[0][0] > tick]
        return [news for _, news in ready]


class RecordedResults:
    """
    The ticks at which one agent was told what became of its commands and messages, and what waits for them.

    Args:
        folder: Of the agent's records.

    Raises:
        BlamedError: Its commands or their results are not on record.
    """

    def __init__(self, folder: Path) -> None:
        self.results: HeldNews[CommandResult] = HeldNews()
        self.refusals: HeldNews[TransmissionRefusal] = HeldNews()
        self._given = {row["number"]: row["tick"] for row in _rows(folder / "commands.jsonl")}
        self._told: dict[tuple[int, bool], _Told] = {}
        """By number and whether it is that of the execution."""
        self._refused: set[int] = set()
        for place, row in enumerate(_rows(folder / "command_results.jsonl")):
            number, status = row["number"], row["status"]
            left_kg, reason = row.get("propellant_kg"), row.get("reason") or ""
            told = _Told((row["tick"], place), row["revision"], left_kg, reason)
            self._told.setdefault((number, status == "executed"), told)
            if status == "refused":
                self._refused.add(number)
        path = folder / "refusals.jsonl"  # only of a run in which a message was refused
        self._refusals = {
            (row["number"], row["to"], row["sent_s"]): (row["tick"], place)
            for place, row in enumerate(_rows(path) if path.is_file() else ())
        }
        self._tick = -1
        self._checked = 0
        self._differs_from = NEVER

    def commanded(self, tick: int, count: int) -> None:
        """Take that flight software has given *count* commands by the end of a tick, numbered from 0."""
        for number in range(self._checked, count):
            if self._given.get(number) != tick:
                self._differs_from = min(self._differs_from, number)
        self._checked = count

    @property
    def overflown(self) -> int:
        """Count what was told as it came since too much was held."""
        return self.results.overflown + self.refusals.overflown

    def hold_result(self, result: CommandResult) -> None:
        """Take a result that has come."""
        number, is_executed = result.number, result.status == "executed"
        is_on_record = number < self._differs_from and number in self._given
        if not is_on_record or (is_executed and number in self._refused):
            next_tick = self._tick + 1
            due = (next_tick + LEAD_TICKS, -1) if is_executed else AT_ONCE
            self.results.hold(due, result)
            return
        # Without a record the run had ended before its agent heard of it.
        told = self._told.get((number, is_executed))
        if told is None:
            self.results.hold((NEVER, 0), result)
        else:
            self.results.hold(told.due, told.over(result))

    def take_results(self, tick: int) -> list[CommandResult]:
        """Return the results of a tick."""
        self._tick = tick
        return self.results.take(tick)

    def hold_refusal(self, refusal: TransmissionRefusal) -> None:
        """Take a refusal that has come; one that is not on record is told at once."""
        key = (refusal.number, refusal.to, refusal.sent_s)
        self.refusals.hold(self._refusals.get(key, AT_ONCE), refusal)


def _as_late(reason: str, recorded: str) -> str:
    """Return a reason with the lateness on record, where both name one and say the same besides."""
    late, _, others = reason.partition("; ")
    late_then, _, others_then = recorded.partition("; ")
    both_late = late.endswith(TOO_LATE) and late_then.endswith(TOO_LATE)
    return recorded if both_late and others == others_then else reason


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    if not path.is_file():
        raise BlamedError(f"{path}: expected what the recorded run told of commands, found none")
    stream = read_stream(path)
    names = stream.field_names
    for values in stream.records():
        yield dict(zip(names, values, strict=True))
