"""
One tick on board, in its order: measure, hear, be told, think.

    truth -> sensors -> readings -.
    host -> messages, results ----+-> flight software -> commands, messages, estimates
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.flight.api import MASS, TRUTH, Reading
from madns_runtime.simulations.constellation.flight.pilot import Pilot
from madns_runtime.simulations.constellation.messages import CommandResult, Delivery, Refusal
from madns_runtime.simulations.constellation.vehicle.board import Board
from madns_runtime.simulations.constellation.vehicle.radio import Receiver

RESULTS_MAX = 1024
"""Results of commands that wait for the next tick; older ones are dropped and counted."""


class Cockpit:
    """
    Flight software in its vehicle.

    Args:
        pilot: The flight software.
        board: Its context.
        vehicle: What the vehicle is like.
        is_truth_fed: Whether it is given truth instead of measurements.
    """

    def __init__(self, pilot: Pilot, board: Board, *, vehicle: Vehicle, is_truth_fed: bool) -> None:
        self._pilot = pilot
        self._board = board
        self._vehicle = vehicle
        self._is_truth_fed = is_truth_fed
        self._receiver = Receiver()
        self._results: deque[CommandResult] = deque(maxlen=RESULTS_MAX)
        self._results_dropped = 0
        self.phase_s = 0.0
        """By how much the vehicle's ticks lie behind their nominal times, s."""
        pilot.setup(board)

    def step(
        self,
        tick: int,
        t_s: float,
        state: tuple[float, ...] | None,
        measured: Mapping[str, Reading],
    ) -> None:
        """
        Do one tick; a tick without truth has no readings, but flight software runs all the same.

        Args:
            tick: Its number.
            t_s: Its time.
            state: Truth, or None.
            measured: What sensors have to say since the tick before.

        Raises:
            BlamedError: Flight software raised.
        """
        board, pilot = self._board, self._pilot
        board.begin(tick, t_s)
        board.phase_s = self.phase_s
        readings = dict(measured) if not self._is_truth_fed else {}
        if self._is_truth_fed and state is not None:
            readings[TRUTH] = Reading(t_s, state)
        for message in self._receiver.due(t_s):
            board.record_received(tick, message)
            pilot.receive(message)
        while self._results:
            result = self._results.popleft()
            board.record_result(tick, result)
            self._read_gauge(t_s, result, readings)
            pilot.command_result(result)
        for refusal in board.take_refusals(tick):
            pilot.message_refused(refusal)
        pilot.step(t_s, readings)

    def deliver(self, message: Delivery) -> None:
        """Take a message by radio, to be heard at its time."""
        self._receiver.add(message)

    def tell(self, result: CommandResult) -> None:
        """Take what became of a command, to be told in the next tick."""
        self._results_dropped += len(self._results) == RESULTS_MAX
        self._results.append(result)

    def refuse(self, refusal: Refusal) -> None:
        """Take that the host refused a message, to be told in the next tick."""
        self._board.refuse(refusal)

    def finish(self) -> dict[str, Any]:
        """
        Return the summary of what went in and out, and flight software's own under flight.

        Raises:
            BlamedError: Flight software raised.
        """
        receiver = self._receiver
        return {
            "commands": self._board.commands,
            "command_results_dropped": self._results_dropped,
            "messages_sent": self._board.messages,
            "sends_refused": self._board.refused,
            "messages_received": receiver.received,
            "messages_held": receiver.held,
            "messages_late": receiver.late,
            "messages_refused": receiver.refused,
            "flight": self._pilot.finish(),
        }

    def _read_gauge(self, t_s: float, result: CommandResult, readings: dict[str, Reading]) -> None:
        """Give mass and propellant with what changed them, and not before it has."""
        thruster = self._vehicle.thruster
        if thruster is None or result.status != "executed":
            return
        left_kg = result.propellant_kg
        mass_kg = self._vehicle.mass_kg - (thruster.propellant_kg - left_kg)
        readings[MASS] = Reading(t_s, (mass_kg, left_kg))
