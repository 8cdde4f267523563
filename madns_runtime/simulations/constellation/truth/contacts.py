"""
Contacts: which passes are known so far, told as they begin and end. Pure; times come from the caller.

Truth is looked at a little ahead of time, in long steps. Where it is not known that far ahead, as far
as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.truth.passes import SCAN_STEP_S, PassFinder, Window

LOOK_AHEAD_S = 2.0
"""How far ahead of the time passes are known at least, where truth is: what leaves a station in that time
is handed over before it arrives."""
RETRY_S = 0.1
"""Until the next look where truth was not known yet."""

CONTACT_FIELDS = (
    Field("event", "", "str"),
    Field("agent", "", "str"),
    Field("station", "", "str"),
    Field("rise_s", "s"),
    Field("set_s", "s"),
    Field("elevation_deg_max", "deg"),
)
"""Stream "contacts": one record when a pass begins, one when it ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """A vehicle comes into view of a station, or leaves it."""

    event: Literal["rise", "set"]
    agent: str
    station: str
    rise_s: float
    """When it rose above the mask, s; of one in view from the start, the start."""
    set_s: float | None = None
    """When it set; None at its rise."""
    elevation_deg_max: float | None = None
    """Highest it stood; None at its rise."""

    @property
    def t_s(self) -> float:
        """When this happened."""
        return self.rise_s if self.set_s is None else self.set_s

    def to_record(self) -> tuple[Any, ...]:
        """Return one value for each of CONTACT_FIELDS."""
        return (
            self.event,
            self.agent,
            self.station,
            self.rise_s,
            self.set_s,
            self.elevation_deg_max,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """A stretch of time and who was in view in it."""

    from_s: float
    until_s: float
    windows: list[Window]


class PassWatch:
    """Keeps the passes known ahead of the time, and tells of each as it comes."""

    def __init__(self, finder: PassFinder, agents: Sequence[str], stations: Sequence[str]) -> None:
        self._finder = finder
        self._agents = agents
        self._stations = stations
        self._open: set[tuple[int, int]] = set()
        """Stations and vehicles in contact where the last look ended."""
        self._contacts: list[Contact] = []
        """Known, not told yet: those of the last SCAN_STEP_S."""
        self._next_look_s = -math.inf
        self.passes = 0
        """That have begun, as far as it was told."""
        self.passes_open = 0
        """Of these, those that go on."""

    def look_ahead(self, t_s: float) -> list[Stretch]:
        """Look until LOOK_AHEAD_S after *t_s*, as far as truth is known, and return what is new, in order."""
        stretches: list[Stretch] = []
        while self._stations and self._next_look_s <= t_s:
            stretch = self._look(t_s)
            if stretch is None:
                self._next_look_s = t_s + RETRY_S
                break
            stretches.append(stretch)
            self._next_look_s = stretch.until_s - LOOK_AHEAD_S
        return stretches

    def contacts(self, t_s: float) -> list[Contact]:
        """Return the passes that began or ended until *t_s*, in order; each event once."""
        self._contacts.sort(key=lambda contact: contact.t_s)
        count = sum(contact.t_s <= t_s for contact in self._contacts)
        result, self._contacts = self._contacts[:count], self._contacts[count:]
        begun = sum(contact.event == "rise" for contact in result)
        self.passes += begun
        self.passes_open += 2 * begun - count
        return result

    def next_s(self) -> float:
        """Return when to look, or to ask for contacts, next."""
        return min([self._next_look_s, *(contact.t_s for contact in self._contacts)])

    def _look(self, t_s: float) -> Stretch | None:
        """Look as far as wanted or, where truth is not known so far, at least until now; None: neither."""
        from_s = self._finder.scanned_s
        if from_s is None:
            # From simulated time zero on, or from now if that is forgotten.
            for begin_s in dict.fromkeys((0.0, t_s)):
                windows = self._finder.begin(begin_s)
                if windows is not None:
                    return self._note(windows, begin_s, begin_s)
            return None
        for until_s in (from_s + SCAN_STEP_S, t_s + LOOK_AHEAD_S, t_s):
            windows = self._finder.look(until_s) if until_s > from_s else None
            if windows is not None:
                return self._note(windows, from_s, until_s)
        return None

    def _note(self, windows: list[Window], from_s: float, until_s: float) -> Stretch:
        """Note who rose and who set."""
        for window in windows:
            pair = window.station, window.vehicle
            if pair not in self._open:
                self._open.add(pair)
                self._contacts.append(self._contact("rise", window))
            if window.set_s is not None:
                self._open.remove(pair)
                self._contacts.append(self._contact("set", window))
        return Stretch(from_s=from_s, until_s=until_s, windows=windows)

    def _contact(self, event: Literal["rise", "set"], window: Window) -> Contact:
        is_over = event == "set"
        sine = min(1.0, window.sine_max)
        return Contact(
            event=event,
            agent=self._agents[window.vehicle],
            station=self._stations[window.station],
            rise_s=window.rise_s,
            set_s=window.set_s if is_over else None,
            elevation_deg_max=math.degrees(math.asin(sine)) if is_over else None,
        )
