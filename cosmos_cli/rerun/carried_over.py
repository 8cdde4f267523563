"""
Checks and timeline of a recorded run's scenario, as a rerun in lockstep can have them.

Taken from scenario.yaml in the run's directory. What does not fit is named: faults of devices are in the samples that are
played back, and a run in real time that ended early ends again with the tick that was its last, one in lockstep that was
interrupted where it was.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from cosmos_cli.errors import InputError
from cosmos_cli.models.document import read_document
from cosmos_cli.models.variables import substitute_variables
from cosmos_cli.models.yaml_source import read_source
from cosmos_cli.rerun.recorded_run import FlownRun
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.timeline.fault_kinds import LOSSES
from madns_runtime.timeline.kinds import ANNOTATE, DEVICE_FAULT, STOP, TEXT_CHARACTERS_MAX

ATTEMPTS_MAX: Final = 20
"""At leaving out what is refused: a check may come after one that was left out."""
TIMES: Final = ("at_s", "every_s", "rate_per_h", "from_s", "to_s", "for_s")
IN_SAMPLES: Final = "is in the samples on record, and not inserted again"
ALTERS_NOTHING: Final[Mapping[str, Any]] = {"fault": "drop", "value": 0}
STANDS_FOR: Final = "on record:"
_PLACE: Final = re.compile(r"(timeline|checks)\[(\d+)\]")
Item = dict[str, Any]


@dataclass(slots=True)
class CarriedOver:
    """Entries and checks as they are written, by their places on record; a remark stands for an entry that is left out."""

    timeline: dict[int, Item] = field(default_factory=dict)
    checks: dict[int, Item] = field(default_factory=dict)
    ends: tuple[Item, ...] = ()
    """Of a run that ended early: the entry that has the rerun end so."""
    remarks: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """Words of the actions that are left out."""

    def values(self) -> dict[str, Any]:
        """Return both keys of the rerun's scenario."""
        return {
            "timeline": [*self.timeline.values(), *self.ends],
            "checks": list(self.checks.values()),
        }

    @property
    def loses_agents(self) -> bool:
        """Whether agents are lost by it on purpose."""
        return any(entry.get("action") in LOSSES for entry in self.timeline.values())

    def leave_out(self, refused: InputError) -> bool:
        """Leave out what a refusal is about, and tell whether that was all of it."""
        found = [(_PLACE.match(fault.path), fault.text) for fault in refused.faults]
        if not all(match for match, _ in found):
            return False
        gone: dict[tuple[str, int], str] = {}
        for match, text in found:
            assert match is not None
            gone.setdefault((match[1], int(match[2])), text)
        for (key, place), text in gone.items():
            items = self.timeline if key == "timeline" else self.checks
            if place >= len(items):
                return False  # the end that was added here
            number = list(items)[place]
            if key == "timeline" and _is_stand_in_entry(items[number]):
                continue  # what it stands for is told
            self.remarks.append(f"{_told(key, number, items[number])}: left out: {text}")
            if key == "timeline":
                self.left_out.append(str(items[number].get("action")))
        for number in [n for place, n in enumerate(self.timeline) if ("timeline", place) in gone]:
            entry = self.timeline.pop(number)
            if not _is_stand_in_entry(entry) or "when" in entry:
                self.timeline[number] = _without_condition(_stand_in(entry))
        self.timeline = dict(sorted(self.timeline.items()))
        for number in [n for place, n in enumerate(self.checks) if ("checks", place) in gone]:
            del self.checks[number]
        return True


def carried_over(recorded: FlownRun) -> CarriedOver:
    """Return what can be carried over; nothing, and a remark, of a run whose scenario cannot be read."""
    found = CarriedOver()
    path = recorded.run.path / "scenario.yaml"
    try:
        document = read_document(read_source(path))
    except InputError as error:
        found.remarks.append(f"no checks and no timeline: {clean_line(error.all_faults[0].text)}")
        return found
    substitute_variables(document)
    found.timeline = _items(document.value, "timeline")
    found.checks = _items(document.value, "checks")
    _replace_device_faults(found, is_lockstep=recorded.config.time.is_lockstep)
    if not recorded.config.time.is_lockstep or recorded.cut_s is not None:
        _end_as_recorded(found, recorded)
    return found


def is_stand_in(word: str, parameters: Mapping[str, Any]) -> bool:
    """Tell whether an action is a remark in the place of one on record."""
    return word == ANNOTATE.word and str(parameters.get("text")).startswith(STANDS_FOR)


def _is_stand_in_entry(entry: Item) -> bool:
    return is_stand_in(str(entry.get("action")), entry)


def _items(value: Mapping[str, Any], key: str) -> dict[int, Item]:
    given = value.get(key)
    listed: Iterable[Any] = given if isinstance(given, list) else ()
    return {number: dict(item) for number, item in enumerate(listed) if isinstance(item, Mapping)}


def _replace_device_faults(found: CarriedOver, *, is_lockstep: bool) -> None:
    """
    Put remarks in the place of faults of devices: those behind them keep their numbers, by which chance is drawn.

    That one is unplugged no sample tells: of lockstep, which knows when that was, it takes place again; so does what clears it.
    What `delay` held back is on record as it came, though the device was closed by then: such a device is left open.
    """
    entries = {n: e for n, e in found.timeline.items() if e.get("action") == DEVICE_FAULT.word}
    faults = [(e.get("device"), e.get("fault")) for e in entries.values()] if is_lockstep else []
    for number, entry in entries.items():
        device = entry.get("device")
        is_unplugged = (device, "disconnect") in faults and (device, "delay") not in faults
        if is_unplugged and entry.get("fault") in ("disconnect", "clear"):
            continue
        found.remarks.append(
            f"{_told('timeline', number, entry)}: {DEVICE_FAULT.word} {IN_SAMPLES}"
        )
        # Its end clears the others, too.
        found.timeline[number] = {**entry, **ALTERS_NOTHING} if is_unplugged else _stand_in(entry)


def _stand_in(entry: Item) -> Item:
    """Return a remark in the place of an entry, at its times: those behind it keep their places, by which chance is drawn."""
    if _is_stand_in_entry(entry):
        return entry
    kept = {key: entry[key] for key in (*TIMES, "when") if entry.get(key) is not None}
    words = [str(entry[key]) for key in ("action", "device", "fault") if key in entry]
    text = f"{STANDS_FOR} {' '.join(words)}"
    return {**kept, "action": ANNOTATE.word, "text": text[:TEXT_CHARACTERS_MAX]}


def _without_condition(entry: Item) -> Item:
    """Return an entry that waits for no condition: what it would look at may not be recorded."""
    return {"at_s": 0.0, **entry} if entry.pop("when", None) is not None else entry


def _end_as_recorded(found: CarriedOver, recorded: FlownRun) -> None:
    """Have a rerun end with the last tick on record, or where one in lockstep was cut off, whatever ended the run."""
    for number, entry in found.timeline.items():
        if entry.get("action") == STOP.word:
            found.timeline[number] = _stand_in(entry)
    for check in found.checks.values():
        if check.get("stop_when_broken"):
            check["stop_when_broken"] = False
    period_s = 1.0 / recorded.config.agents.tick_hz
    if recorded.cut_s is not None:  # agents may have taken the step that was under way
        end_s = recorded.cut_s + 0.5 * period_s
        if end_s < recorded.config.time.duration_s:
            found.ends = ({"at_s": end_s, "action": STOP.word},)
        found.remarks.append(
            f"it was cut off at {recorded.cut_s:g} s: the rerun ends there, too, and what it alone has of the last ticks"
            " is not compared"
        )
        return
    last_s = max(agent.last_s for agent in recorded.agents.values())
    end_s = last_s + 0.5 * period_s
    if last_s + 1.5 * period_s < recorded.config.time.duration_s:
        found.ends = ({"at_s": end_s, "action": STOP.word},)
        told = recorded.run.read_json(recorded.run.run_json) or {}
        is_whole = told.get("duration_s") == recorded.config.time.duration_s
        found.remarks.append(
            f"its last ticks were missed: the rerun ends with that of {last_s:g} s, too"
            if is_whole and told.get("status") == "complete"
            else f"it ended early: so does the rerun, with the tick of {last_s:g} s"
        )


def _told(key: str, number: int, item: Item) -> str:
    name = item.get("name" if key == "checks" else "action")
    return clean_line(f"{key}[{number}] ({name})")
