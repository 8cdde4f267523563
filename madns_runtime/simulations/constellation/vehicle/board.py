"""
The board under flight software: the context that it sees, and what leaves the vehicle through it.

Everything is stamped with the time of the tick in progress, not with a clock's: flight software that is
given the same readings commands the same things, whatever computer it runs on.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.plugin.api import HOST, AgentContext
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.messages import (
    EVERYBODY,
    Command,
    CommandFrame,
    CommandResult,
    Delivery,
    Initial,
    Refusal,
    Transmission,
    is_for_ground,
)
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.vehicle import streams
from madns_runtime.simulations.constellation.vehicle.commands import (
    COMMANDS_PER_TICK_MAX,
    CommandDesk,
)

PAYLOAD_BYTES_MAX = 16_384
"""Of one message by radio, encoded."""
MESSAGES_PER_TICK_MAX = 64
REFUSALS_MAX = 1024
"""That wait for the next tick to be told; older ones are dropped, but counted as all others."""
MISTAKES = {
    "no_radio": "the scenario has no crosslinks, or for the ground no stations",
    "too_long": f"a payload has at most {PAYLOAD_BYTES_MAX} bytes",
    "unknown_receiver": "there is no other vehicle and no station of that name",
}
"""Refusals that no waiting cures: the first of each is told in the log."""
ESTIMATES_MAX = 64
"""Names in an estimate."""
LOG_CHARACTERS_MAX = 2000


class Board:
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
        self.phase_s = 0.0
        """By how much the vehicle's ticks lie behind their nominal times, s: so do its maneuvers."""
        self._context = context
        self._has_crosslinks = parameters.crosslinks is not None
        self._has_stations = bool(parameters.stations)
        # One that rejoins goes on behind all numbers that it can have given before.
        rejoined_tick = max(0, math.ceil(context.now_s() * context.tick_hz))
        self.first_number = rejoined_tick * COMMANDS_PER_TICK_MAX
        """Of its first command: 0, or more in a vehicle that rejoined the run."""
        self._first_message = rejoined_tick * MESSAGES_PER_TICK_MAX
        self._desk = CommandDesk(vehicle, self.first_number)
        self._tick: int | None = None
        self._t_s = -math.inf
        self._messages = 0
        self._messages_in_tick = 0
        self._handed_over = 0
        self._refusals: deque[Refusal] = deque(maxlen=REFUSALS_MAX)
        self._refused: Counter[str] = Counter()
        self._has_refusals_stream = False
        self._estimate_names: tuple[str, ...] = ()
        context.open_stream("commands", streams.COMMANDS)
        context.open_stream("command_results", streams.COMMAND_RESULTS)
        if self._has_crosslinks or self._has_stations:
            context.open_stream("messages", streams.MESSAGES)

    @property
    def commands(self) -> int:
        """Commands given."""
        return self._desk.count

    @property
    def messages(self) -> int:
        """Messages handed to the radio."""
        return self._handed_over

    @property
    def refused(self) -> dict[str, int]:
        """Messages refused, by reason: on board, where they never reach the radio, or by the host."""
        return dict(self._refused)

    def begin(self, tick: int, t_s: float) -> None:
        """Begin a tick: from now on everything bears its time."""
        self._tick, self._t_s = tick, t_s
        self._messages_in_tick = 0

    # What flight software calls --------------------------------------------------------------

    def delta_v(self, delta_v_m_s: Any, *, at_s: float, frame: CommandFrame = "rtn") -> int:
        """Command a change of velocity."""
        tick = self._running("delta_v")
        command = self._desk.delta_v(self._t_s, delta_v_m_s, at_s=at_s, frame=frame)
        return self._send_command(tick, command)

    def torque(self, torque_n_m: Any, *, at_s: float, duration_s: float) -> int:
        """Command a torque."""
        tick = self._running("torque")
        command = self._desk.torque(self._t_s, torque_n_m, at_s=at_s, duration_s=duration_s)
        return self._send_command(tick, command)

    def ballistic(self, ballistic_m2_kg: float, *, at_s: float) -> int:
        """Command another ballistic coefficient."""
        tick = self._running("ballistic")
        command = self._desk.ballistic(self._t_s, ballistic_m2_kg, at_s=at_s)
        return self._send_command(tick, command)

    def send(self, to: str, payload: Any) -> int:
        """Send a message by radio."""
        tick = self._running("send")
        if not isinstance(to, str):
            raise PluginError(f"send: expected a receiver's name, got {to!r:.80}")
        if self._messages_in_tick >= MESSAGES_PER_TICK_MAX:
            raise PluginError(
                f"send: expected at most {MESSAGES_PER_TICK_MAX} messages in one tick; "
                f"the tick at {self._t_s:g} s wants more"
            )
        size = _payload_bytes(payload)
        number = self._first_message + self._messages
        self._messages += 1
        self._messages_in_tick += 1
        reason = self._why_refused(to, size)
        if reason is not None:
            self.refuse(Refusal(number=number, to=to, sent_s=self._t_s, reason=reason))
            return number
        self._handed_over += 1
        message = Transmission(to=to, sent_s=self._t_s, number=number, payload=payload)
        self._context.send(HOST, message.to_message(), Service.RELIABLE)
        self._context.record("messages", (tick, "sent", to, self._t_s, self._t_s, size))
        return number

    def broadcast(self, payload: Any) -> int:
        """Send a message to every vehicle in view."""
        return self.send(EVERYBODY, payload)

    def estimate(self, values: Mapping[str, float]) -> None:
        """Record what flight software believes; the first call fixes the names."""
        tick = self._running("estimate")
        names = self._estimate_names
        if not names:
            names = self._open_estimates(values)
        try:
            row = [float(values[name]) for name in names]
        except (KeyError, TypeError, ValueError):
            row = []
        if len(row) != len(names) or len(values) != len(names):
            raise PluginError(
                f"estimate: expected numbers for {', '.join(names)}, as in the first call, "
                f"got {values!r:.200}"
            )
        self._context.record("estimates", (tick, *row))

    def log(self, level: str, text: str) -> None:
        """Log a sentence."""
        self._context.log(level, str(text)[:LOG_CHARACTERS_MAX])

    # What the vehicle itself calls -------------------------------------------------------------

    def record_result(self, tick: int, result: CommandResult) -> None:
        """Record what flight software is about to be told of a command."""
        self._context.record(
            "command_results",
            (
                tick,
                result.number,
                result.status,
                result.at_s,
                result.revision,
                result.delta_v_m_s,
                result.propellant_kg,
                result.reason,
            ),
        )

    def refuse(self, refusal: Refusal) -> None:
        """Take that a message was refused, to be told in the next tick."""
        reason = refusal.reason
        self._refused[reason] += 1
        self._refusals.append(refusal)
        if reason in MISTAKES and self._refused[reason] == 1:
            words = f"{reason.replace('_', ' ')}: {MISTAKES[reason]}"
            self._context.log(
                "warning",
                f"the message to {refusal.to!r:.80} of {refusal.sent_s:g} s was refused, {words}; "
                "others like it are counted in sends_refused",
            )

    def take_refusals(self, tick: int) -> list[Refusal]:
        """Record and return what flight software is about to be told of its messages."""
        taken = list(self._refusals)
        self._refusals.clear()
        if taken and not self._has_refusals_stream:
            self._context.open_stream("refusals", streams.REFUSALS)
            self._has_refusals_stream = True
        for one in taken:
            row = (tick, one.number, one.to, one.sent_s, one.reason)
            self._context.record("refusals", row)
        return taken

    def record_received(self, tick: int, message: Delivery) -> None:
        """Record a message that flight software is about to hear."""
        size = len(pack(message.payload))
        row = (tick, "received", message.sender, message.sent_s, message.arrives_s, size)
        self._context.record("messages", row)

    def _running(self, name: str) -> int:
        if self._tick is None:
            raise PluginError(f"{name}: there is no time before the first tick; call it in step()")
        return self._tick

    def _send_command(self, tick: int, command: Command) -> int:
        message = replace(command, phase_s=self.phase_s).to_message()
        self._context.send(HOST, message, Service.SYNC, deadline_s=command.at_s + self.phase_s)
        self._context.record(
            "commands",
            (
                tick,
                command.number,
                command.kind,
                command.at_s,
                command.frame,
                *command.vector,
                command.duration_s,
            ),
        )
        return command.number

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
        fields = [Field(name, streams.unit_of(name)) for name in names]
        self._context.open_stream("estimates", (Field("tick", "", "int"), *fields))
        self._estimate_names = names
        return names


def _payload_bytes(payload: Any) -> int:
    try:
        return len(pack(payload))
    except MadnsError as error:
        raise PluginError(f"send: {error}") from error
