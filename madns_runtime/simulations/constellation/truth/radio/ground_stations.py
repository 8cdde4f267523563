"""
Ground stations: passes over them, and messages between them and vehicles.

Pure: states come from a function, times from the caller. Downlinks are judged by truth at the time they
were sent, as crosslinks are. Uplinks leave by themselves: passes are looked for a little ahead of time,
so that what they carry is on its way before it is due.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.medium.links import Chance, Transmitter
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Transmission
from madns_runtime.simulations.constellation.messages import GROUND
from madns_runtime.simulations.constellation.orbit.visibility import (
    coast,
    signal_way,
)
from madns_runtime.simulations.constellation.parameters import GroundStation, Uplink
from madns_runtime.simulations.constellation.truth.radio.channel import (
    TO_GROUND,
    Attempt,
    LinkEvent,
    Truth,
    index_of_names,
)
from madns_runtime.simulations.constellation.truth.radio.passes import (
    SCAN_STEP_S,
    Contact,
    PassFinder,
    PassWatch,
    Sites,
    ViewInterval,
    Window,
)

DOWNLINK_QUEUE_MAX = 256
"""Messages that may wait at one vehicle's transmitter to the ground; further ones are refused."""
LOOKS_MAX = 1000
"""At the time that one message takes: SCAN_STEP_S apart, or further if it takes more than 10,000 s."""
PREFIX = f"{GROUND}:"
_Waiting = tuple[int, Uplink, int | None]
"""A message for a vehicle: its number, itself, and the one station that may send it, None for any."""


class GroundSegment:
    """
    All ground stations: each may speak to, and hear, every vehicle in its view at the same time.

    Every vehicle has one transmitter to the ground beside that of its crosslinks.
    """

    def __init__(  # noqa: PLR0913 - all but two by name, and each of them another collaborator
        self,
        stations: Sequence[GroundStation],
        uplinks: Sequence[Uplink],
        *,
        agents: tuple[str, ...],
        satellites: tuple[str, ...],
        epoch_utc: datetime,
        random: np.random.Generator,
        truth: Truth,
    ) -> None:
        """
        Prepare stations and their messages.

        Args:
            stations: From the scenario.
            uplinks: From the scenario; those to one vehicle leave in the order of their times.
            agents: Names, in the order of the vehicles' indices.
            satellites: The same, of what they fly.
            epoch_utc: UTC of simulated time zero, with its time zone.
            random: One number is drawn from it, now, as the seed of all chance.
            truth: Where the vehicles are at a time.

        Raises:
            ConfigurationError: Two stations have one name, or an uplink is for nobody.
        """
        index = index_of_names(agents, satellites)
        faults = _faults(stations, uplinks, index)
        if faults:
            raise ConfigurationError("\n".join(faults))
        self._stations = tuple(stations)
        self._agents = agents
        self._truth = truth
        self._sites = Sites(stations, epoch_utc)
        names = tuple(station.name for station in stations)
        self._watch = PassWatch(PassFinder(self._sites, truth), agents, names)
        self._chance = Chance(random)
        self._transmitters = [Transmitter(DOWNLINK_QUEUE_MAX) for _ in agents]
        self._index = index
        self._uplinks = _uplink_queues(uplinks, index)
        self._uplinks_given = self._uplinks_waiting = len(uplinks)
        self._free_s: dict[tuple[int, int], float] = {}
        """By station and vehicle: when what the station says to it is said."""
        self._uplinked_s: dict[int, float] = {}
        """By vehicle: when the newest uplink to it left."""
        self._uplinked: list[tuple[Transmission, LinkEvent]] = []
        self.dark: set[int] = set()
        """Stations that neither hear nor are heard at present."""

    def carry(self, sender: int, transmission: Transmission) -> list[LinkEvent]:
        """
        Send a vehicle's message to the ground and return what becomes of it.

        It reaches one station: the one named, or the one over which the vehicle stands highest. A message
        that cannot begin and end within a pass is refused.

        Args:
            sender: Index of the vehicle.
            transmission: To ground or ground:NAME. Messages of one sender must come in the order of
                (sent_s, number); one out of order is refused.
        """
        sent_s = transmission.sent_s
        size_bytes = len(pack(transmission.payload))
        attempt = Attempt(sender, self._agents[sender], transmission, size_bytes, TO_GROUND)
        stations = self._stations_meant(transmission.to)
        if not self._transmitters[sender].is_in_order(sent_s, transmission.number):
            return [attempt.failed("out_of_order")]
        if not stations:
            return [attempt.failed("unknown_receiver")]
        state = self._truth.state(sender, sent_s)
        if state is None:
            return [attempt.failed("no_truth")]
        lit = [number for number in stations if number not in self.dark]
        return [self._downlink(attempt, lit, np.array((state,)))]

    def darken(self, station: str, *, is_dark: bool) -> bool:
        """Have a station neither heard nor hear, or do both again; False if there is none of that name."""
        numbers = {number for number, each in enumerate(self._stations) if each.name == station}
        self.dark = self.dark | numbers if is_dark else self.dark - numbers
        return bool(numbers)

    def add_uplink(self, uplink: Uplink, station: str) -> bool:
        """Let another message wait, for one station's contact; False if there is none of that name."""
        numbers = [number for number, each in enumerate(self._stations) if each.name == station]
        if not numbers:
            return False
        queue = self._uplinks.setdefault(self._index[uplink.to], [])
        queue.append((self._uplinks_given, uplink, numbers[0]))
        queue.sort(key=lambda waiting: waiting[1].at_s)  # before those whose time is yet to come
        self._uplinks_given += 1
        self._uplinks_waiting += 1
        return True

    def contacts(self, t_s: float) -> list[Contact]:
        """Return the passes that began or ended until *t_s*, in order; each event once."""
        self._look_ahead(t_s)
        return self._watch.contacts(t_s)

    def uplinks(self, t_s: float) -> list[tuple[Transmission, LinkEvent]]:
        """Return the uplinks that left, or leave soon after *t_s*, and what became of each; each once."""
        self._look_ahead(t_s)
        uplinked, self._uplinked = self._uplinked, []
        return uplinked

    def next_s(self) -> float | None:
        """Return when `uplinks` and `contacts` are to be called next; None: there is no station."""
        return self._watch.next_s() if self._stations else None

    def summary(self) -> Mapping[str, int]:
        """Return the counts of uplinks that still wait for a pass, which are not sent, and of passes."""
        return {
            "uplinks_waiting": self._uplinks_waiting,
            "passes": self._watch.passes,
            "passes_open": self._watch.passes_open,
        }

    # Vehicles to stations.

    def _stations_meant(self, to: str) -> list[int]:
        """Return the stations that a message may be for."""
        name = to.removeprefix(PREFIX)
        return [
            number
            for number, station in enumerate(self._stations)
            if to == GROUND or (to.startswith(PREFIX) and name == station.name)
        ]

    def _downlink(
        self, attempt: Attempt, stations: list[int], state: NDArray[np.float64]
    ) -> LinkEvent:
        sent_s = attempt.message.sent_s
        clear, _ = self._sites.clearances(state, sent_s)
        in_view = [number for number in stations if clear[number, 0] >= 0.0]
        if not in_view:
            return attempt.failed("no_contact")
        sines = clear[:, 0] + self._sites.mask_sines
        station = max(in_view, key=lambda number: float(sines[number]))
        transmitter = self._transmitters[attempt.sender]
        leaves_s = transmitter.leaves_s(sent_s)
        if leaves_s is None:
            return attempt.failed("queue_full")
        duration_s = attempt.size_bytes * 8.0 / self._stations[station].rate_bit_s
        ends_s = leaves_s + duration_s
        if not self._stays_in_view(station, state, sent_s, ends_s):
            return attempt.failed("no_contact")
        transmitter.occupy(sent_s, leaves_s, duration_s)
        start = coast(state, leaves_s - sent_s)[0].tolist()
        distance_m, _ = signal_way(start, self._site_state(station, leaves_s))
        name = PREFIX + self._stations[station].name
        receiver = len(self._agents) + station
        drawn = self._chance.draw(attempt.sender, attempt.message.number, receiver)
        is_lost = drawn < self._stations[station].loss
        return attempt.ended(name, distance_m, ends_s, is_lost=is_lost)

    def _stays_in_view(
        self, station: int, state: NDArray[np.float64], t_s: float, until_s: float
    ) -> bool:
        """Return whether one vehicle, shape (1, 6), above a mask at *t_s*, stays there until later."""
        takes_s = until_s - t_s
        looks = min(max(1, math.ceil(takes_s / SCAN_STEP_S)), LOOKS_MAX)
        # The end first: most that do not stay are gone by then.
        for look in range(looks, 0, -1):
            after_s = takes_s * look / looks
            later = coast(state, after_s)
            clear, _ = self._sites.clearances(later, t_s + after_s, slice(station, station + 1))
            if clear[0, 0] < 0.0:
                return False
        return True

    def _site_state(self, station: int, t_s: float) -> tuple[float, ...]:
        """Return a station's position, m, and velocity, m/s, TEME: it turns with the Earth."""
        x, y, z = self._sites.at(t_s)[0, station].tolist()
        turn = self._sites.turn_rad_s
        return (x, y, z, -turn * y, turn * x, 0.0)

    # Passes, and stations to vehicles.

    def _look_ahead(self, t_s: float) -> None:
        """Look for passes, and let uplinks leave in those found."""
        for stretch in self._watch.look_ahead(t_s):
            for window in sorted(stretch.windows, key=lambda found: (found.rise_s, found.station)):
                if window.station not in self.dark:
                    self._uplink(window, stretch)

    def _uplink(self, window: Window, stretch: ViewInterval) -> None:
        """Let what waits for a vehicle leave in this stretch of a pass, one after the other."""
        queue = self._uplinks.get(window.vehicle, [])
        pair = window.station, window.vehicle
        ends_s = stretch.until_s if window.set_s is None else window.set_s
        for waiting in [each for each in queue if each[2] in (None, window.station)]:
            number, uplink, _ = waiting
            begins_s = max(
                stretch.from_s,
                window.rise_s,
                uplink.at_s,
                self._free_s.get(pair, 0.0),
                self._uplinked_s.get(window.vehicle, 0.0),
            )
            if begins_s >= ends_s:
                return
            message = Transmission(
                to=self._agents[window.vehicle],
                sent_s=begins_s,
                number=number,
                payload=uplink.text,
            )
            sender = len(self._agents) + window.station
            name = PREFIX + self._stations[window.station].name
            attempt = Attempt(sender, name, message, len(pack(uplink.text)), TO_GROUND)
            duration_s = attempt.size_bytes * 8.0 / self._stations[window.station].rate_bit_s
            event = self._send_up(attempt, window, begins_s + duration_s)
            if event is None:
                return
            self._free_s[pair] = begins_s + duration_s
            self._uplinked_s[window.vehicle] = begins_s
            queue.remove(waiting)
            self._uplinks_waiting -= 1
            self._uplinked.append((message, event))

    def _send_up(self, attempt: Attempt, window: Window, ends_s: float) -> LinkEvent | None:
        """Return what becomes of an uplink; None: the pass, or what is known of it, ends before it does."""
        begins_s = attempt.message.sent_s
        state = self._truth.state(window.vehicle, begins_s)
        if state is None or not self._stays_in_view(
            window.station, np.array((state,)), begins_s, ends_s
        ):
            return None
        distance_m, _ = signal_way(self._site_state(window.station, begins_s), state)
        agent = self._agents[window.vehicle]
        drawn = self._chance.draw(attempt.sender, attempt.message.number, window.vehicle)
        is_lost = drawn < self._stations[window.station].loss
        return attempt.ended(agent, distance_m, ends_s, is_lost=is_lost)


def _faults(
    stations: Sequence[GroundStation], uplinks: Sequence[Uplink], names: Mapping[str, int]
) -> list[str]:
    """Return what `cosmos validate` finds as well; *names* are all that messages may be for."""
    counts = Counter(station.name for station in stations)
    faults = [
        f"parameters.stations: expected one station named {name!r}, got {count}"
        for name, count in counts.items()
        if count > 1
    ]
    if uplinks and not stations:
        faults.append("parameters.uplinks: expected stations to send them from, got none")
    faults += [
        f"parameters.uplinks.{number}.to: expected an agent or a satellite that flies, got {uplink.to!r}"
        for number, uplink in enumerate(uplinks)
        if uplink.to not in names
    ]
    return faults


def _uplink_queues(
    uplinks: Sequence[Uplink], index: Mapping[str, int]
) -> dict[int, list[_Waiting]]:
    """Return by vehicle what waits for it, with its place in the scenario, in the order of its times."""
    queues: dict[int, list[_Waiting]] = {}
    for number, uplink in sorted(enumerate(uplinks), key=lambda entry: entry[1].at_s):
        queues.setdefault(index[uplink.to], []).append((number, uplink, None))
    return queues
