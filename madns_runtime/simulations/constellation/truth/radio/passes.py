"""
Passes of vehicles over places on the ground, found as truth becomes known, told as they begin and end. Pure.

All pairs are looked at together every SCAN_STEP_S; only where one of them rises, sets or culminates in
between is the time sought, on truth itself. A pass between two looks is not missed: there the elevation
rises at the first and falls at the second. Truth is looked at a little ahead of time, or as far as it is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.earth import (
    days_since_j2000,
    fixed_to_teme,
    geodetic_to_fixed,
    gmst_rad,
    gmst_rate_rad_s,
)
from madns_runtime.simulations.constellation.orbit.interpolation import interpolate
from madns_runtime.simulations.constellation.orbit.visibility import sines_of_elevation
from madns_runtime.simulations.constellation.parameters import GroundStation
from madns_runtime.simulations.constellation.truth.radio.channel import Truth

SCAN_STEP_S = 10.0
"""Time between two looks at all pairs, s: in it no elevation over a place turns round twice."""
ROOT_TOLERANCE_S = 1e-4
"""A tenth of the millisecond to which rise and set are promised."""
ROOT_STEPS_MAX = 60

Pairs = NDArray[np.float64]
"""A value for each station and vehicle, shape (S, N)."""

LOOK_AHEAD_S = 2.0
"""How far ahead of the time passes are known at least, where truth is: what leaves a station in that time
is handed over before it arrives."""
RETRY_S = 0.1
"""Until the next look where truth was not known yet."""


class Sites:
    """Stations on the turning Earth."""

    def __init__(self, stations: Sequence[GroundStation], epoch_utc: datetime) -> None:
        latitude, longitude, altitude_m, mask = (
            np.array([getattr(station, name) for station in stations], dtype=np.float64)
            for name in ("latitude_deg", "longitude_deg", "altitude_m", "elevation_deg_min")
        )
        fixed = geodetic_to_fixed(np.radians(latitude), np.radians(longitude), altitude_m)
        self._fixed = np.stack(fixed)
        self._epoch = epoch_utc
        self.turn_rad_s = gmst_rate_rad_s(days_since_j2000(epoch_utc))
        self.mask_sines: NDArray[np.float64] = np.sin(np.radians(mask))

    def at(self, t_s: float) -> NDArray[np.float64]:
        """Return positions, m, and zeniths at a time, TEME, shape (2, S, 3)."""
        return fixed_to_teme(self._fixed, gmst_rad(days_since_j2000(self._epoch, t_s)))

    def clearances(
        self, states: NDArray[np.float64], t_s: float, only: slice = slice(None)
    ) -> tuple[Pairs, Pairs]:
        """
        Return the sines of elevations less those of the masks, and their rates, 1/s.

        Args:
            states: Of vehicles, shape (N, 6), m and m/s, TEME.
            t_s: Their time.
            only: Which stations.
        """
        r_m, up = self.at(t_s)[:, only]
        sines, rates = sines_of_elevation(r_m, up, states, self.turn_rad_s)
        return sines - self.mask_sines[only, None], rates


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """A stretch of a pass within the stretch of time looked at last; the whole pass if it ended there."""

    station: int
    vehicle: int
    rise_s: float
    """Begin of the pass, s, which may be long ago."""
    set_s: float | None
    """End of the pass, s; None if it goes on."""
    sine_max: float
    """Of the highest elevation so far."""


class PassFinder:
    """Looks at every stretch of time once, in order, and tells who is in view in it."""

    def __init__(self, sites: Sites, truth: Truth) -> None:
        self._sites = sites
        self._truth = truth
        self.scanned_s: float | None = None
        """Until when passes are known; None before the first look."""
        self._ends: NDArray[np.float64] = np.empty((0, 0, 6))
        """States at both ends of the stretch looked at."""
        self._now: tuple[Pairs, Pairs] = (np.empty((0, 0)), np.empty((0, 0)))
        self._span = (0.0, 0.0)
        self._rise_s: Pairs = np.empty((0, 0))
        """Begin of the pass that goes on, s; NaN where none does."""
        self._sine_max: Pairs = np.empty((0, 0))

    def begin(self, t_s: float) -> list[Window] | None:
        """Look for the first time; who is in view has risen now. None: truth is not known yet."""
        states = self._truth.states(t_s)
        if states is None:
            return None
        clear, _ = self._now = self._sites.clearances(states, t_s)
        self._ends = np.stack((states, states))
        self.scanned_s = t_s
        self._rise_s = np.where(clear >= 0.0, t_s, np.nan)
        self._sine_max = clear + self._sites.mask_sines[:, None]
        return [self._window(*pair) for pair in _pairs(clear >= 0.0)]

    def look(self, until_s: float) -> list[Window] | None:
        """
        Look at the time from `scanned_s` to *until_s* and return who is in view in it.

        Returns:
            Passes that go on and passes that ended, by station and vehicle; None if truth is not known
            until then.
        """
        assert self.scanned_s is not None
        states = self._truth.states(until_s)
        if states is None:
            return None
        from_s, (clear0, rates0) = self.scanned_s, self._now
        clear1, rates1 = self._now = self._sites.clearances(states, until_s)
        self._ends = np.stack((self._ends[1], states))
        self._span = (from_s, until_s)
        is_up0, is_up1 = clear0 >= 0.0, clear1 >= 0.0
        turns = (rates0 > 0.0) & (rates1 <= 0.0)
        peaks = turns & (
            is_up0 | is_up1 | (_tangents_meet(self._span, clear0, rates0, *self._now) >= 0.0)
        )
        self.scanned_s = until_s
        found = [
            self._pass(pair, bool(is_up0[pair]), bool(is_up1[pair]), bool(peaks[pair]))
            for pair in _pairs(is_up0 | is_up1 | peaks)
        ]
        return [window for window in found if window is not None]

    def _pass(
        self, pair: tuple[int, int], is_up0: bool, is_up1: bool, has_peak: bool
    ) -> Window | None:
        """Return what one pair sees of each other in the stretch: a pass, a part of one, or nothing."""
        from_s, until_s = self._span
        peak_s, highest = until_s, float(self._now[0][pair])
        if has_peak:
            peak_s = _root(lambda t_s: self._at(pair, t_s)[1], from_s, until_s)
            highest = max(highest, self._at(pair, peak_s)[0])
            if not is_up0 and highest < 0.0:
                return None

        def clearance(t_s: float) -> float:
            return self._at(pair, t_s)[0]

        if not is_up0:
            self._rise_s[pair] = _root(clearance, from_s, until_s if is_up1 else peak_s)
            self._sine_max[pair] = -1.0
        highest += float(self._sites.mask_sines[pair[0]])
        self._sine_max[pair] = max(self._sine_max[pair], highest)
        if is_up1:
            return self._window(*pair)
        window = self._window(*pair, set_s=_root(clearance, from_s if is_up0 else peak_s, until_s))
        self._rise_s[pair] = math.nan
        return window

    def _window(self, station: int, vehicle: int, set_s: float | None = None) -> Window:
        return Window(
            station=station,
            vehicle=vehicle,
            rise_s=float(self._rise_s[station, vehicle]),
            set_s=set_s,
            sine_max=float(self._sine_max[station, vehicle]),
        )

    def _at(self, pair: tuple[int, int], t_s: float) -> tuple[float, float]:
        """Return a pair's clearance and its rate within the stretch."""
        station, vehicle = pair
        known = self._truth.state(vehicle, t_s)
        if known is None:
            # Forgotten meanwhile, because the host fell behind: 0.2 mm off for a stretch of 10 s.
            from_s, until_s = self._span
            ends = self._ends[:, vehicle : vehicle + 1].swapaxes(0, 1)
            times = np.array([t_s])
            state = interpolate(ends, times, t0_s=from_s, knot_s=until_s - from_s)[:, 0]
        else:
            state = np.array((known,))
        clear, rate = self._sites.clearances(state, t_s, slice(station, station + 1))
        return float(clear[0, 0]), float(rate[0, 0])


def _pairs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    return [(station, vehicle) for station, vehicle in np.argwhere(mask).tolist()]


def _tangents_meet(
    span: tuple[float, float], clear0: Pairs, rates0: Pairs, clear1: Pairs, rates1: Pairs
) -> Pairs:
    """Return the height at which the tangents of both ends meet: a bump between them stays below."""
    length_s = span[1] - span[0]
    bend = np.where(rates0 > rates1, rates0 - rates1, np.inf)
    meets_s = (clear1 - clear0 - rates1 * length_s) / bend
    return clear0 + rates0 * meets_s


def _root(function: Callable[[float], float], low_s: float, high_s: float) -> float:
    """
    Return where a function changes sign between two times, to ROOT_TOLERANCE_S.

    Where it does not, the end that is nearer to doing so: a pass that touches the mask.
    Source: Chandrupatla, Advances in Engineering Software 28 (1997), 145; as in Scherer,
    Computational Physics, 2nd ed., section 6.1.7.
    """
    a, b = high_s, low_s
    fa, fb = function(a), function(b)
    if fa == 0.0 or fb == 0.0 or (fa < 0.0) == (fb < 0.0):
        return a if abs(fa) < abs(fb) else b
    share = 0.5
    for _ in range(ROOT_STEPS_MAX):
        x = a + share * (b - a)
        fx = function(x)
        if (fx < 0.0) == (fa < 0.0):
            c, fc = a, fa
        else:
            c, b, fc, fb = b, a, fb, fa
        a, fa = x, fx
        share_min = ROOT_TOLERANCE_S / abs(b - a) if b != a else 1.0
        if fa == 0.0 or share_min > 0.5:
            break
        # Inverse quadratic interpolation where the three points allow it, else bisection.
        xi, phi = (a - b) / (c - b), (fa - fb) / (fc - fb)
        share = 0.5
        if phi * phi < xi and (1.0 - phi) ** 2 < 1.0 - xi:
            share = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (
                fc - fb
            )
        share = min(1.0 - share_min, max(share_min, share))
    return a if abs(fa) < abs(fb) else b


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """A vehicle comes into view of a station, or leaves it."""

    event: Literal["rise", "set"]
    agent: str
    station: str
    rise_s: float
    """Time at which it rose above the mask, s; of one in view from the start, the start."""
    set_s: float | None = None
    """Time at which it set, s; None at its rise."""
    elevation_deg_max: float | None = None
    """Highest it stood; None at its rise."""

    @property
    def t_s(self) -> float:
        """Time of the event, s."""
        return self.rise_s if self.set_s is None else self.set_s

    def to_record(self) -> tuple[Any, ...]:
        """Return one value per field of streams.CONTACTS."""
        return (
            self.event,
            self.agent,
            self.station,
            self.rise_s,
            self.set_s,
            self.elevation_deg_max,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewInterval:
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
        """Number of passes that have begun, as far as it was told."""
        self.passes_open = 0
        """Of these, those that go on."""

    def look_ahead(self, t_s: float) -> list[ViewInterval]:
        """Look until LOOK_AHEAD_S after *t_s*, as far as truth is known, and return what is new, in order."""
        stretches: list[ViewInterval] = []
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

    def _look(self, t_s: float) -> ViewInterval | None:
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

    def _note(self, windows: list[Window], from_s: float, until_s: float) -> ViewInterval:
        """Note who rose and who set."""
        for window in windows:
            pair = window.station, window.vehicle
            if pair not in self._open:
                self._open.add(pair)
                self._contacts.append(self._contact("rise", window))
            if window.set_s is not None:
                self._open.remove(pair)
                self._contacts.append(self._contact("set", window))
        return ViewInterval(from_s=from_s, until_s=until_s, windows=windows)

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
