"""
The board under flight software: the context that it sees, and what leaves the vehicle through it.

Everything is stamped with the time of the tick in progress, not with a clock's: flight software that is
given the same readings commands the same things, whatever computer it runs on.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.plugin.api import EVERYBODY, AgentContext
from madns_runtime.protocol.codec import pack
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation import streams
from madns_runtime.simulations.constellation.command_numbers import first_number
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight_rates import flight_rate
from madns_runtime.simulations.constellation.messages import (
    Delivery,
    Initial,
    TransmissionRefusal,
    is_for_ground,
)
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.vehicle.commands import (
    COMMANDS_PER_TICK_MAX,
    CommandDesk,
    check_running,
)
from madns_runtime.simulations.constellation.vehicles import flight_of

PAYLOAD_BYTES_MAX = 16_384
"""Of one message by radio, encoded, and of its receiver's name."""
MESSAGES_PER_TICK_MAX = 64
REFUSALS_MAX = 1024
"""Number of refusals that wait for the next tick to be told; older ones are dropped, but counted as all others."""
MISTAKES = {
    "no_radio": "the scenario has no crosslinks, or for the ground no stations",
    "too_long": f"a payload has at most {PAYLOAD_BYTES_MAX} bytes",
    "unknown_receiver": "there is no other vehicle and no station of that name",
}
"""Refusals that no waiting cures: the first of each is told in the log."""
TAKEN = frozenset(field.name for field in streams.ESTIMATES)
"""Names of the fields that every record of estimates has."""
ESTIMATES_MAX = 64
"""Names in an estimate."""
LOG_CHARACTERS_MAX = 2000


class VehicleContext:
    """
    A vehicle's FlightContext; see `flight.api.FlightContext` for what is not described here.

    Args:
        context: The framework's.
        initial: The host's initial data.
        vehicle: What the vehicle is like.
        settings: Of its flight software.
        random: For its flight software.
    """

    def __init__(
        self,
        context: AgentContext,
        initial: Initial,
        *,
        vehicle: Vehicle,
        settings: Mapping[str, Any],
        random: np.random.Generator,
    ) -> None:
        parameters = context.parameters
        assert isinstance(parameters, ConstellationParameters)
        self.name = context.name
        self.satellite = initial.satellite
        self.agents = context.agents
        self.index = context.agents.index(context.name)
        self.tick_hz = context.tick_hz
        self.duration_s = context.duration_s
        self.epoch_utc = initial.epoch_utc
        self.frame = initial.frame
        self.settings = settings
        self.random = random
        self._context = context
        self._has_crosslinks = parameters.crosslinks is not None
        self._has_stations = bool(parameters.stations)
        # One that rejoins goes on behind all numbers that it can have given before.
        rejoined_tick = max(0, math.ceil(context.now_s() * context.tick_hz))
        flight = flight_of(parameters, context.name, initial.satellite)
        rate = flight_rate(None if flight is None else flight.rate_hz, context.tick_hz)
        self.rate_hz = rate.hz
        steps = rejoined_tick * rate.steps_per_tick
        self.first_number = first_number(steps * COMMANDS_PER_TICK_MAX)
        """Of its first command: 0, or more in a vehicle that rejoined the run."""
        self._first_message = steps * MESSAGES_PER_TICK_MAX
        self.desk = desk = CommandDesk(context, vehicle, self.first_number)
        """Of its commands."""
        self.delta_v, self.torque, self.ballistic = desk.delta_v, desk.torque, desk.ballistic
        self.dipole = desk.dipole
        self._tick: int | None = None
        self._is_over = False
        self._t_s = self._leaves_s = -math.inf
        self._messages = 0
        self._messages_in_tick = 0
        self.messages_sent = 0
        """Messages handed to the radio."""
        self.refusals: deque[TransmissionRefusal] = deque(maxlen=REFUSALS_MAX)
        """Refusals that wait to be told."""
        self.refused: Counter[str] = Counter()
        """Messages refused, by reason: on board, where they never reach the radio, or by the host."""
        self._has_refusals_stream = self._has_heard = False
        self._estimate_names: tuple[str, ...] = ()
        if self._has_crosslinks or self._has_stations:
            context.open_stream("messages", streams.MESSAGES)

    def begin(
        self, tick: int, t_s: float, phase_s: float, *, leaves_s: float | None = None
    ) -> None:
        """Begin a step: from now on everything bears its time, but messages the one at which they leave, where that is another."""
        self.desk.begin(tick, t_s, phase_s)
        self._tick, self._t_s = tick, t_s
        self._leaves_s = t_s if leaves_s is None else leaves_s
        self._messages_in_tick = 0

    def end(self) -> None:
        """Take neither commands nor messages any more: no tick follows."""
        self._is_over = True
        self.desk.end()

    def begin_answer(self) -> None:
        """Take what a program says from here on as its answer to another tick, whose bounds are its own."""
        self.desk.begin_answer()
        self._messages_in_tick = 0

    # What flight software calls --------------------------------------------------------------

    def send(self, to: str, payload: Any) -> int:
        """Send a message by radio."""
        check_running("send", self._tick, is_over=self._is_over)
        if not isinstance(to, str):
            raise PluginError(f"send: expected a receiver's name, got {to!r:.80}")
        if self._messages_in_tick >= MESSAGES_PER_TICK_MAX:
            raise PluginError(
                f"send: expected at most {MESSAGES_PER_TICK_MAX} messages in one tick; "
                f"the tick at {self._t_s:g} s wants more"
            )
        if (to_bytes := _encoded_bytes(to)) > PAYLOAD_BYTES_MAX:
            raise PluginError(
                f"send: expected as its receiver a name of at most {PAYLOAD_BYTES_MAX} bytes, got {to_bytes}: {to!r:.80}"
            )
        size = _encoded_bytes(payload)
        number = self._first_message + self._messages
        self._messages += 1
        self._messages_in_tick += 1
        reason = self._why_refused(to, size)
        if reason is not None:
            self.refuse(TransmissionRefusal(number, to, self._leaves_s, reason))
            return number
        self.messages_sent += 1
        self._context.transmit(to, payload, number=number)
        row = (self._tick, "sent", to, self._leaves_s, self._leaves_s, size)
        self._context.record("messages", row)
        return number

    def broadcast(self, payload: Any) -> int:
        """Send a message to every vehicle in view."""
        return self.send(EVERYBODY, payload)

    def estimate(self, values: Mapping[str, float | None]) -> None:
        """Record what flight software believes; the first call fixes the names."""
        check_running("estimate", self._tick)
        names = self._estimate_names
        if not names:
            names = self._open_estimates(values)
        try:
            believed = [values[name] for name in names]
            is_text = any(isinstance(value, str | bytes) for value in believed)
            row = [] if is_text else [None if one is None else float(one) for one in believed]
        except (KeyError, TypeError, ValueError, OverflowError):
            row = []
        if len(row) != len(names) or len(values) != len(names):
            raise PluginError(
                f"estimate: expected numbers for {', '.join(names)}, as in the first call, "
                f"got {values!r:.200}"
            )
        self._context.record("estimates", (self._tick, *row))

    def log(self, level: str, text: str) -> None:
        """Log a sentence."""
        told = str(text)
        if (rest := len(told) - LOG_CHARACTERS_MAX) > 0:
            told = f"{told[:LOG_CHARACTERS_MAX]}... ({rest} more characters)"
        self._context.log(level, told)

    # What the vehicle itself calls -------------------------------------------------------------

    def refuse(self, refusal: TransmissionRefusal) -> None:
        """Take that a message was refused, to be told in the next tick."""
        reason = refusal.reason
        self.refused[reason] += 1
        self.refusals.append(refusal)
        if reason in MISTAKES and self.refused[reason] == 1:
            words = f"{reason.replace('_', ' ')}: {MISTAKES[reason]}"
            self._context.log(
                "warning",
                f"the message to {refusal.to!r:.80} of {refusal.sent_s:g} s was refused, {words}; "
                "others like it are counted in sends_refused",
            )

    def take_refusals(self, tick: int) -> list[TransmissionRefusal]:
        """Record and return what flight software is about to be told of its messages."""
        taken = list(self.refusals)
        self.refusals.clear()
        if taken and not self._has_refusals_stream:
            self._context.open_stream("refusals", streams.REFUSALS)
            self._has_refusals_stream = True
        for one in taken:
            self._context.record("refusals", (tick, one.number, one.to, one.sent_s, one.reason))
        return taken

    def record_received(self, tick: int, message: Delivery) -> None:
        """Record a message that flight software is about to hear."""
        if not (self._has_crosslinks or self._has_stations or self._has_heard):
            # A text that came by no radio.
            self._context.open_stream("messages", streams.MESSAGES)
        self._has_heard = True
        size = len(pack(message.payload))
        row = (tick, "received", message.sender, message.sent_s, message.arrives_s, size)
        self._context.record("messages", row)

    def _why_refused(self, to: str, payload_bytes: int) -> str | None:
        """Return why a message cannot leave the vehicle; None if it can."""
        if not (self._has_stations if is_for_ground(to) else self._has_crosslinks):
            return "no_radio"
        return "too_long" if payload_bytes > PAYLOAD_BYTES_MAX else None

    def _open_estimates(self, values: Any) -> tuple[str, ...]:
        if not isinstance(values, Mapping) or not 1 <= len(values) <= ESTIMATES_MAX:
            raise PluginError(
                f"estimate: expected a mapping of 1 to {ESTIMATES_MAX} names, got {values!r:.200}"
            )
        names = tuple(values)
        for name in names:
            if not isinstance(name, str) or not name.isprintable() or not name:
                raise PluginError(
                    f"estimate: expected names such as slot_error_deg, got {name!r:.80}"
                )
            if name in TAKEN:
                raise PluginError(
                    f"estimate: {name} is taken, as each record bears it already; choose another name"
                )
        fields = [Field(name, streams.unit_of(name)) for name in names]
        self._context.open_stream("estimates", (*streams.ESTIMATES, *fields))
        self._estimate_names = names
        return names


def _encoded_bytes(part: Any) -> int:
    """
    Return how many bytes a part of a message has on its way.

    Raises:
        PluginError: No message carries it.
    """
    try:
        return len(pack(part))
    except MadnsError as error:
        raise PluginError(f"send: {error}") from error
