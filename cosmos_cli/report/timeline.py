"""A run's timeline in its report: a table of the actions, and a band for each in figures over simulated time."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, BinaryIO, Final

import orjson

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import is_linked
from cosmos_cli.evidence.timeline_remarks import told_events
from madns_runtime.analysis.tables import RecordedTable
from madns_runtime.analysis.values import (
    SIMULATED_TIME,
    Block,
    EventBand,
    Figure,
    Heading,
    Section,
    TableBlock,
)
from madns_runtime.bounded_files import open_regular_file
from madns_runtime.plain_values import first_few
from madns_runtime.timeline.dispatcher import BEGAN, ENDED, REFUSED
from madns_runtime.units import conversion

BANDS_MAX: Final = 40
ROWS_MAX: Final = 100
EVENTS_MAX: Final = 50_000
"""Of actions that are read: more than a timeline, and whoever orders live, can begin and end."""
AGENTS_TOLD_MAX: Final = 6
LINE_BYTES_MAX: Final = 1 << 20
INSTANT_SHARE: Final = 0.002
"""Width of the band of an action that does not last, as a share of the run."""


@dataclass(slots=True)
class ActionTold:
    """One action as the events tell of it."""

    number: int
    begin_s: float
    word: str
    agents: Sequence[str]
    parameters: Mapping[str, Any]
    delay_s: float | None
    lasts: bool = False
    end_s: float | None = None
    refusal: str = ""
    refused_by: str = ""
    """Agents that could not carry out their part, and the first one's reason."""

    @property
    def what(self) -> str:
        """The action and its parameters, in words."""
        given = [f"{key}={value}" for key, value in self.parameters.items() if value is not None]
        return " ".join((self.word, *given))

    @property
    def whom(self) -> str:
        """Its agents."""
        return first_few([str(agent) for agent in self.agents], AGENTS_TOLD_MAX)


def read_actions(run: RunDirectory) -> list[ActionTold]:
    """Return the actions that a run's host recorded, in order; none where its events cannot be read."""
    found: dict[Any, ActionTold] = {}
    for event in _events(run):
        number, t_s = event.get("number"), event.get("t_s")
        if not isinstance(t_s, int | float) or not isinstance(number, int):
            continue
        if event.get("event") == ENDED and number in found:
            found[number].end_s = float(t_s)
        elif event.get("event") in (BEGAN, REFUSED) and number not in found:
            agents, parameters = event.get("agents"), event.get("parameters")
            found[number] = ActionTold(
                number=number,
                begin_s=float(t_s),
                word=str(event.get("action")),
                agents=agents if isinstance(agents, list) else (),
                parameters=parameters if isinstance(parameters, dict) else {},
                delay_s=event.get("delay_s"),
                lasts=bool(event.get("lasts")),
                refusal=str(event.get("reason", "")),
            )
    return list(found.values())


def note_agents_refusals(actions: Sequence[ActionTold], events: RecordedTable | None) -> None:
    """Note in each action which of its agents refused it, as the table of the agents' events tells."""
    if not actions:
        return
    refused: dict[int, dict[str, str]] = {}
    for agent, event in told_events(events, REFUSED):
        if isinstance(number := event.get("number"), int):
            refused.setdefault(number, {}).setdefault(agent, str(event.get("reason")))
    for action in actions:
        by = refused.get(action.number, {})
        for agent, reason in list(by.items())[:1]:
            more = f" and {len(by) - 1} more" if len(by) > 1 else ""
            action.refused_by = f"by {agent}{more}: {reason}"


def _events(run: RunDirectory) -> Iterator[Mapping[str, Any]]:
    path = run.path / "host" / "events.jsonl"
    if is_linked(path, run.path):
        return
    try:
        with os.fdopen(open_regular_file(path), "rb") as file:
            yield from itertools.islice(_events_of_actions(file), EVENTS_MAX)
    except OSError:
        return


def _events_of_actions(file: BinaryIO) -> Iterator[Mapping[str, Any]]:
    while line := file.readline(LINE_BYTES_MAX):
        if b'"action_' not in line:
            continue
        try:
            event = orjson.loads(line)
        except ValueError:
            continue
        if isinstance(event, dict):
            yield event


def with_bands(
    sections: Sequence[Section], actions: Sequence[ActionTold], reached_s: float
) -> list[Section]:
    """Return sections whose figures over simulated time, up to *reached_s*, show when actions were in force."""
    bands = [
        EventBand(start=each.begin_s, end=_end_s(each, reached_s), name=each.what)
        for each in actions
        if not each.refusal
    ][:BANDS_MAX]
    if not bands:
        return list(sections)
    return [
        replace(section, blocks=[_with_bands(block, bands) for block in section.blocks])
        for section in sections
    ]


def _with_bands(block: Block, bands_s: Sequence[EventBand]) -> Block:
    """Return a figure over simulated time of whatever kind, in whatever unit, with bands; any other block as it is."""
    if not isinstance(block, Figure) or not block.x.quantity.endswith(SIMULATED_TIME.quantity):
        return block
    factor = conversion(SIMULATED_TIME.unit, block.x.unit)
    if factor is None or block.x.is_logarithmic:
        return block
    bands = [replace(band, start=band.start * factor, end=band.end * factor) for band in bands_s]
    return replace(block, events=(*block.events, *bands))


def timeline_sections(actions: Sequence[ActionTold]) -> list[Section]:
    """Return the chapter of a run's timeline; none where nothing was to happen."""
    if not actions:
        return []
    heads = ("begin, s", "action", "agents", "end, s", "delay, s", "refused")
    table = TableBlock(
        title="Actions",
        headings=[Heading(text=text, is_number=text.endswith(", s")) for text in heads],
        rows=[
            [
                each.begin_s,
                each.what,
                each.whom,
                each.end_s,
                each.delay_s,
                each.refusal or each.refused_by,
            ]
            for each in actions[:ROWS_MAX]
        ],
        note=_note(len(actions)),
    )
    return [Section(title="Timeline", blocks=[table])]


def _note(count: int) -> str:
    texts = []
    if count > ROWS_MAX:
        texts.append(f"The first {ROWS_MAX} of {count}.")
    if count > BANDS_MAX:
        texts.append(f"Figures show bands of the first {BANDS_MAX}.")
    return " ".join(texts)


def _end_s(action: ActionTold, reached_s: float) -> float:
    if action.end_s is not None:
        return action.end_s
    if action.lasts:
        return max(reached_s, action.begin_s)
    return action.begin_s + INSTANT_SHARE * reached_s
