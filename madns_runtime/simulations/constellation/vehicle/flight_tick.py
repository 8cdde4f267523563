"""
A vehicle fitted out with sensors and flight software, and one tick on board, in its order: measure, hear, be told, think.

    truth -> sensors -> readings -.
    host -> messages, results ----+-> flight software -> commands, messages, estimates
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from madns_runtime.errors import BlamedError, MachineError, PluginError
from madns_runtime.plugin import validation
from madns_runtime.plugin.api import AgentContext
from madns_runtime.plugin.context import describe_exception
from madns_runtime.plugin.isolation import is_from_outside
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight.api import (
    MASS,
    TRUTH,
    WHEELS,
    Reading,
    Readings,
    StepReadings,
)
from madns_runtime.simulations.constellation.flight.loading import load_flight_class
from madns_runtime.simulations.constellation.flight.process import ExternalFlight
from madns_runtime.simulations.constellation.flight_rates import FlightRate, flight_rate
from madns_runtime.simulations.constellation.flight_settings import FlightClass, FlightRule
from madns_runtime.simulations.constellation.messages import (
    GROUND,
    CommandResult,
    Delivery,
    Initial,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.vehicle.flight_context import VehicleContext
from madns_runtime.simulations.constellation.vehicle.sensors.environment import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.sensor import SensorSuite
from madns_runtime.simulations.constellation.vehicle.sensors.sensor_errors import generator_of
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer
from madns_runtime.simulations.constellation.vehicles import flight_of

RESULTS_MAX = 1024
"""Results of commands that wait for the next tick; older ones are dropped and counted."""

MESSAGES_MAX = 16_384
"""Messages that wait for a step of slow flight software; older ones are dropped and counted."""
READINGS_MAX = 4096
"""Readings of one sensor that wait for a step; older ones are dropped and counted."""
CHANCE_BYTES = 32
"""Of the run's chance for one vehicle."""


class Cockpit:
    """
    Flight software in its vehicle: what it lacks is skipped, and what it raises is blamed on its own line.

    Args:
        make: Returns an object that has some of the contract's methods: a class.
        board: Its context.
        vehicle: What the vehicle is like.
        is_truth_fed: Whether it is given truth instead of measurements.

    Raises:
        BlamedError: It raised.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        board: VehicleContext,
        *,
        vehicle: Vehicle,
        is_truth_fed: bool,
    ) -> None:
        self._name = getattr(make, "__name__", "flight software")
        self._software = software = self._call("__init__", make)
        self._step: Callable[[float, Readings], object] = getattr(software, "step", _do_nothing)
        self._board = board
        self._vehicle = vehicle
        self._is_truth_fed = is_truth_fed
        self._messages: list[Delivery] = []
        self._results: deque[CommandResult] = deque(maxlen=RESULTS_MAX)
        self._gauges: dict[str, tuple[float, ...]] = {}
        """Readings of gauges since the step before, the newest of each."""
        self._results_dropped = 0
        self._news: dict[str, deque[Reading]] = {}
        """Measurements since the step before."""
        self._news_dropped = self._messages_dropped = 0
        self._radio_dropped = 0
        """Of the messages dropped those that a radio brought."""
        self.phase_s = 0.0
        """By how much the vehicle's ticks lie behind their nominal times, s."""
        self.refuse = board.refuse
        """Take that the host refused a message, to be told in the next tick."""
        if hasattr(software, "setup"):
            self._call("setup", software.setup, board)
        else:  # it finds its context all the same
            with contextlib.suppress(AttributeError):  # a class with slots does without
                software.context = board

    def step(
        self,
        tick: int,
        t_s: float,
        state: tuple[float, ...] | None,
        *,
        tick_s: float | None = None,
    ) -> None:
        """
        Do one step; one without truth has no readings, but flight software runs all the same.

        Args:
            tick: Its number.
            t_s: Its time.
            state: Truth, or None.
            tick_s: The tick's own time where the step's is before it, else None: what came since the tick before is not
                told then, but messages that had arrived by the step's time; and what it sends leaves at the tick's.

        Raises:
            BlamedError: Flight software raised.
        """
        board, is_early = self._board, tick_s is not None
        board.begin(tick, t_s, self.phase_s, leaves_s=tick_s)
        readings = self._read(t_s, state)
        # Most steps find nothing that came.
        if self._messages:
            self._tell_messages(tick, t_s if is_early else math.inf)
        if (self._results or self._gauges) and not is_early:
            self._tell_results(tick, t_s, readings)
        if board.refusals and not is_early:
            for refusal in board.take_refusals(tick):
                self._tell("message_refused", refusal)
        self._call("step", self._step, t_s, readings)

    def _read(self, t_s: float, state: tuple[float, ...] | None) -> StepReadings:
        """Return what a step is given: truth, or what was measured since the step before."""
        if self._is_truth_fed:
            readings = StepReadings()
            if state is not None:
                readings[TRUTH] = Reading(t_s, state)
            return readings
        news, self._news = self._news, {}
        return StepReadings({name: one[-1] for name, one in news.items()}, news)

    def _tell_messages(self, tick: int, until_s: float) -> None:
        for message in self._arrived(until_s):
            self._board.record_received(tick, message)
            self._tell("receive", message)

    def _tell_results(self, tick: int, t_s: float, readings: StepReadings) -> None:
        gauges, self._gauges = self._gauges, {}
        for name, values in gauges.items():
            readings[name] = Reading(t_s, values)
        while self._results:
            result = self._results.popleft()
            self._board.desk.record_result(tick, result)
            self._tell("command_result", result)

    @property
    def commands(self) -> int:
        """Count of commands that flight software has given."""
        return self._board.desk.count

    def take(self, measured: Mapping[str, Sequence[Reading]]) -> None:
        """Keep what became known of sensors for the next step, if it is given that; of very many readings the oldest are given up."""
        if self._is_truth_fed:
            return
        for name, readings in measured.items():
            kept = self._news.get(name)
            if kept is None:
                kept = self._news[name] = deque(maxlen=READINGS_MAX)
            self._news_dropped += max(0, len(kept) + len(readings) - READINGS_MAX)
            kept.extend(readings)

    def _arrived(self, until_s: float) -> list[Delivery]:
        """Take the messages that had arrived by some time."""
        messages = self._messages
        self._messages = [one for one in messages if one.arrives_s > until_s]
        return [one for one in messages if one.arrives_s <= until_s]

    def deliver(self, message: Delivery) -> None:
        """Take a message by radio, or a text that came by none, to be told in the next step."""
        if len(self._messages) >= MESSAGES_MAX:
            self._messages_dropped += 1
            self._radio_dropped += self._messages.pop(0).sender != GROUND
        self._messages.append(message)

    def unheard(self) -> tuple[int, int]:
        """Return how many messages by radio still wait for a step, and how many had no room to."""
        waiting = sum(message.sender != GROUND for message in self._messages)
        return waiting, self._radio_dropped

    def read_gauges(self, result: CommandResult) -> None:
        """Let the next step read the gauges of what a command has changed, and not before it has."""
        if result.wheels_n_m_s is not None:
            self._gauges[WHEELS] = result.wheels_n_m_s
        if result.status == "executed":
            self.read_tank(result.propellant_kg)

    def read_tank(self, propellant_kg: float) -> None:
        """Let the next step read the tank's gauge: mass and propellant, kg."""
        thruster = self._vehicle.thruster
        if thruster is not None:
            mass_kg = self._vehicle.mass_kg - (thruster.propellant_kg - propellant_kg)
            self._gauges[MASS] = mass_kg, propellant_kg

    def tell(self, result: CommandResult) -> None:
        """Take what became of a command, to be told in the next tick."""
        self._results_dropped += len(self._results) == RESULTS_MAX
        self._results.append(result)
        self.read_gauges(result)

    def abandon(self) -> None:
        """End flight software that is a program; a class ends with its vehicle."""
        if isinstance(self._software, ExternalFlight):
            self._software.abandon()

    def finish(self) -> dict[str, Any]:
        """
        Return the summary of what went in and out, and flight software's own under flight.

        Raises:
            BlamedError: Flight software raised, or returned what is no summary.
        """
        self._board.end()
        summary = self._call("finish", getattr(self._software, "finish", dict))
        try:
            told = validation.summary(summary)
        except PluginError as error:
            raise BlamedError(f"{self._name}.finish returned {error}") from error
        return {
            "commands": self._board.desk.count,
            "command_results_dropped": self._results_dropped,
            **({"readings_dropped": self._news_dropped} if self._news_dropped else {}),
            **({"messages_dropped": self._messages_dropped} if self._messages_dropped else {}),
            "messages_sent": self._board.messages_sent,
            "sends_refused": dict(self._board.refused),
            "flight": told,
        }

    def _tell(self, method: str, news: CommandResult | Delivery | TransmissionRefusal) -> None:
        """Hand news to `receive`, `command_result` or `message_refused`, if it has that method."""
        self._call(method, getattr(self._software, method, _do_nothing), news)

    def _call(self, name: str, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except (BlamedError, MachineError):  # a full disk: no fault of flight software's
            raise
        except BaseException as error:  # it may raise anything
            if is_from_outside(error):
                raise
            raise BlamedError(describe_exception(error, f"{self._name}.{name}", method)) from error


def _do_nothing(*_arguments: object) -> None:
    """Stand in for a method that flight software does not have."""


def fit_out(
    context: AgentContext, initial: Initial, *, vehicle: Vehicle, buffer: TruthBuffer
) -> tuple[SensorSuite | None, Cockpit | None]:
    """
    Mount sensors and flight software, and let the latter prepare; None for what the vehicle has not.

    Raises:
        BlamedError: Flight software does not load, or raised.
        MissingExtraError: A sensor, or flight software, needs what is not installed.
    """
    flight = flight_of(context.parameters, context.name, initial.satellite)
    wanted = vehicle.sensors
    has_sensors = any(getattr(wanted, field.name) for field in dataclasses.fields(wanted))
    if flight is None and not has_sensors:
        return None, None
    # All that is left to chance on board hangs on these bytes and on a name, not on an order.
    chance = context.random.bytes(CHANCE_BYTES)
    suite = cockpit = None
    rate = rate_of(flight, context.tick_hz)
    if has_sensors:
        gravity = GRAVITY_MODELS[context.parameters.gravity]
        step_hz = rate.hz if rate.steps_per_tick > 1 else None
        scene = Scene(initial.epoch_utc, buffer, gravity.radius_m)
        suite = SensorSuite(wanted, scene, context=context, chance=chance, step_hz=step_hz)
    if flight is not None:
        board = VehicleContext(
            context,
            initial,
            vehicle=vehicle,
            settings=copy.deepcopy(flight.settings),  # its own: vehicles may share a process
            random=generator_of(chance, "flight"),
        )
        software, is_truth_fed = _software(flight, context), flight.input == "truth"
        cockpit = Cockpit(software, board, vehicle=vehicle, is_truth_fed=is_truth_fed)
    return suite, cockpit


def rate_of(flight: FlightRule | None, tick_hz: float) -> FlightRate:
    """
    Return the steps of a vehicle's flight software.

    Raises:
        BlamedError: Its rate and that of the ticks have no whole ratio.
    """
    try:
        return flight_rate(None if flight is None else flight.rate_hz, tick_hz)
    except ValueError as error:
        raise BlamedError(f"parameters.flight.rate_hz: {error}") from error


def _software(flight: FlightRule, context: AgentContext) -> Callable[[], Any]:
    if isinstance(flight, FlightClass):
        return load_flight_class(flight.software, context.base_directory)
    return partial(ExternalFlight, flight, context)
