"""
Crosslinks: radio between vehicles, with the host as the medium.

Pure: states come from a function, times from messages. What becomes of a message depends on the truth
at the time it was sent, on what its sender sent before, and on the seed; never on when, or after whose
messages, the host hears of it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from madns_runtime.protocol.codec import pack
from madns_runtime.simulations.constellation.messages import EVERYBODY, Delivery, Transmission
from madns_runtime.simulations.constellation.orbit.visibility import (
    LIGHT_SPEED_M_S,
    coast,
    has_line_of_sight,
    have_line_of_sight,
    signal_way,
    signal_ways,
)
from madns_runtime.simulations.constellation.parameters import Crosslinks as CrosslinkSettings
from madns_runtime.simulations.constellation.truth.medium import (
    LEAD_S,
    Account,
    Attempt,
    Chance,
    InFlight,
    LinkEvent,
    Outcome,
    Transmitter,
    Truth,
    checked_sent_s,
    index_of_names,
)

_ALL = -1
"""Stands for every receiver."""


class Crosslinks:
    """
    The medium between vehicles.

    Every vehicle has one transmitter, on one channel, that radiates all around: its messages wait for
    each other, and a broadcast is one transmission with many receivers. Receivers hear any number of
    messages at once; nothing interferes.
    """

    def __init__(
        self,
        settings: CrosslinkSettings,
        *,
        agents: tuple[str, ...],
        satellites: tuple[str, ...],
        random: np.random.Generator,
        truth: Truth,
    ) -> None:
        """
        Prepare the links of *agents*, each of which may also be called by its satellite's name.

        Args:
            settings: From the scenario.
            agents: Names, in the order of the vehicles' indices.
            satellites: The same, of what they fly.
            random: One number is drawn from it, now, as the seed of all chance.
            truth: Where the vehicles are at a time.
        """
        self._settings = settings
        self._agents = agents
        self._index = index_of_names(agents, satellites)
        self._range_m = settings.range_km_max * 1e3
        self._height_m = settings.atmosphere_km * 1e3
        self._chance = Chance(random)
        self._truth = truth
        self._transmitters = [Transmitter(settings.queue_max) for _ in agents]
        self._in_flight = InFlight(LEAD_S)
        self._account = Account()

    def send(self, sender: int, transmission: Transmission, now_s: float) -> list[LinkEvent]:
        """
        Send a vehicle's message and return what becomes of it.

        Args:
            sender: Index of the vehicle.
            transmission: Messages of one sender must come in the order of (sent_s, number), as they do
                over a reliable connection; one out of order is refused.
            now_s: Simulated time at which the host hears of it; only to count what it hears too late.

        Returns:
            One event a receiver: for a broadcast those in view, or a single one that says why there is
            none.

        Raises:
            PluginError: The message's time is not finite.
        """
        sent_s = checked_sent_s(transmission)
        self._account.transmissions += 1
        receiver = self._receiver(sender, transmission.to)
        payload_bytes = len(pack(transmission.payload))
        attempt = Attempt(sender, self._agents[sender], transmission, payload_bytes)
        if not self._transmitters[sender].is_in_order(sent_s, transmission.number):
            events = [attempt.failed("out_of_order")]
        elif receiver is None:
            events = [attempt.failed("unknown_receiver")]
        elif (states := self._states_of(sender, receiver, sent_s)) is None:
            events = [attempt.failed("no_truth")]
        else:
            events = self._transmit(attempt, receiver, states)
        for event in events:
            self._account.enter(event, now_s)
        return events

    def due(self, t_s: float) -> list[tuple[int, Delivery]]:
        """Return receivers and what they hear up to LEAD_S after *t_s*, each once, in order of arrival."""
        return self._in_flight.due(t_s)

    def next_s(self) -> float | None:
        """Return when `due` has something next, which may be over already; None: nothing is on its way."""
        return self._in_flight.next_s()

    def summary(self) -> Mapping[str, int]:
        """Return the account: sent is the sum of all outcomes, delivered what was handed over or is in flight."""
        return self._account.to_summary(self._in_flight)

    def _receiver(self, sender: int, to: str) -> int | None:
        """Return whom a message is for, _ALL for everybody, None for nobody."""
        if to == EVERYBODY:
            return _ALL
        receiver = self._index.get(to)
        return None if receiver == sender else receiver

    def _states_of(self, sender: int, receiver: int, t_s: float) -> NDArray[np.float64] | None:
        """Return the states of a sender and its receiver, in this order, or of all vehicles."""
        if receiver == _ALL:
            return self._truth.states(t_s)
        start, end = self._truth.state(sender, t_s), self._truth.state(receiver, t_s)
        return None if start is None or end is None else np.array((start, end))

    def _transmit(
        self, attempt: Attempt, receiver: int, states: NDArray[np.float64]
    ) -> list[LinkEvent]:
        """Let a message wait for its turn and leave; the radio does not know whether anybody hears it."""
        sent_s = attempt.message.sent_s
        transmitter = self._transmitters[attempt.sender]
        leaves_s = transmitter.leaves_s(sent_s)
        if leaves_s is None:
            return [attempt.failed("queue_full")]
        duration_s = attempt.size_bytes * 8.0 / self._settings.rate_bit_s
        transmitter.occupy(sent_s, leaves_s, duration_s)
        ready_s = leaves_s + duration_s + self._settings.processing_s
        if receiver == _ALL:
            return self._to_all(attempt, coast(states, leaves_s - sent_s), ready_s)
        if leaves_s > sent_s:
            states = coast(states, leaves_s - sent_s)
        start, end = states.tolist()
        distance_m, meets_m = signal_way(start, end)
        if not has_line_of_sight(start, meets_m, self._height_m):
            return [attempt.failed("no_line_of_sight", self._agents[receiver], distance_m)]
        if distance_m > self._range_m:
            return [attempt.failed("out_of_range", self._agents[receiver], distance_m)]
        return [self._radiate(attempt, receiver, distance_m, ready_s)]

    def _to_all(
        self, attempt: Attempt, states: NDArray[np.float64], ready_s: float
    ) -> list[LinkEvent]:
        """Broadcast: whoever is in view and range hears it after a light time of its own."""
        start = states[attempt.sender, :3]
        distances_m, meets_m = signal_ways(start, states)
        in_view = have_line_of_sight(start, meets_m, self._height_m)
        in_view[attempt.sender] = False
        in_range = in_view & (distances_m <= self._range_m)
        if not in_range.any():
            outcome: Outcome = "out_of_range" if in_view.any() else "no_line_of_sight"
            return [attempt.failed(outcome)]
        return [
            self._radiate(attempt, receiver, float(distances_m[receiver]), ready_s)
            for receiver in np.flatnonzero(in_range).tolist()
        ]

    def _radiate(
        self, attempt: Attempt, receiver: int, distance_m: float, ready_s: float
    ) -> LinkEvent:
        """Bring a message to a receiver in view, unless chance has it otherwise."""
        message, loss = attempt.message, self._settings.loss
        if loss and self._chance.draw(attempt.sender, message.number, receiver) < loss:
            return attempt.failed("lost", self._agents[receiver], distance_m)
        arrives_s = ready_s + distance_m / LIGHT_SPEED_M_S
        delivery = Delivery(
            sender=attempt.name,
            sent_s=message.sent_s,
            arrives_s=arrives_s,
            payload=message.payload,
        )
        self._in_flight.add(attempt.sender, message.number, receiver, delivery)
        return attempt.delivered(self._agents[receiver], distance_m, arrives_s)
