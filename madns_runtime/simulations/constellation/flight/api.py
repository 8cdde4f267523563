"""
The contract between a vehicle and its flight software: what is under test sees this and nothing else.

Flight software is one class in one file; each vehicle has an object of it, made without arguments. It
subclasses `FlightSoftware`, or merely looks like it. Times are simulated seconds since the epoch; vectors
are in the run's inertial frame unless it says otherwise.

    class Guidance(FlightSoftware):
        def step(self, t_s, readings):
            if (gnss := readings.get("gnss")) is not None and self.is_time(t_s, gnss.values):
                self.context.delta_v((0.0, 0.1, 0.0), at_s=t_s + 3.0, frame="rtn")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from madns_runtime.simulations.constellation.messages import (
    CommandFrame,
    CommandResult,
    Delivery,
    TransmissionRefusal,
)

if TYPE_CHECKING:
    import numpy as np

TRUTH = "truth"
"""Name of the reading that is the truth itself, when the scenario says input: truth. Its values are x, y, z, m,
vx, vy, vz, m/s; for a rigid body also the quaternion, scalar last, and the body rates, rad/s."""
MASS = "mass"
"""Name of the reading that a tank gauge gives when a command was executed, and once per second while a thruster is stuck
open: mass, kg, and propellant, kg."""
WHEELS = "wheels"
"""Name of the reading of the wheels' speeds when a torque was executed: momentum about body x, y, z, N m s."""


class Reading(NamedTuple):
    """One measurement."""

    t_s: float
    """Time at which it was valid, s."""
    values: tuple[float, ...]
    """Units and frame: see the sensor in `equipment.Sensors`."""


Readings = Mapping[str, Reading]
"""By the sensor's name the newest that became known since the step before: a sensor without news is not in it. See
`StepReadings` for the others."""


class StepReadings(dict[str, Reading]):
    """
    Readings of one step.

    Args:
        newest: By the sensor's name.
        all_new: All that became known since the step before, oldest first, where there are several.
    """

    def __init__(
        self,
        newest: Mapping[str, Reading] = MappingProxyType({}),
        all_new: Mapping[str, Sequence[Reading]] = MappingProxyType({}),
    ) -> None:
        self.samples: dict[str, tuple[Reading, ...]] = {}
        """Of the sensors with more than one."""
        if newest:  # in lockstep many a step of many a vehicle has none
            super().__init__(newest)
            self.samples = {name: tuple(news) for name, news in all_new.items() if len(news) > 1}

    def since(self, name: str) -> tuple[Reading, ...]:
        """Return all readings of a sensor since the step before, oldest first; none for one without news."""
        return self.samples.get(name) or ((self[name],) if name in self else ())


class FlightContext(Protocol):
    """The vehicle as its flight software sees it."""

    name: str
    """The agent's."""
    satellite: str
    agents: tuple[str, ...]
    """All agents of the run, in order."""
    index: int
    """Place of this one among them, from 0."""
    tick_hz: float
    """Of the vehicle."""
    rate_hz: float
    """Of its own steps: `flight.rate_hz`, else that of the ticks."""
    duration_s: float
    epoch_utc: str
    """UTC of simulated time zero, ISO 8601."""
    frame: str
    settings: Mapping[str, Any]
    """From the scenario: flight.settings."""
    random: np.random.Generator
    """Seeded from the run's seed and the agent's name."""
    first_number: int
    """Of its first command: 0, or more in a vehicle that rejoined the run."""

    def delta_v(
        self, delta_v_m_s: Sequence[float], *, at_s: float, frame: CommandFrame = "rtn"
    ) -> int:
        """
        Command a change of velocity and return the command's number; `command_result` tells what became of it.

        None, (0, 0, 0), closes off a thruster that is stuck open; of any other it is refused.
        """

    def torque(self, torque_n_m: Sequence[float], *, at_s: float, duration_s: float) -> int:
        """Command a torque about the body axes and return the command's number."""

    def dipole(self, dipole_a_m2: Sequence[float], *, at_s: float, duration_s: float) -> int:
        """Command the magnetorquers' dipole along the body axes, A m^2, and return the command's number."""

    def ballistic(self, ballistic_m2_kg: float, *, at_s: float) -> int:
        """Command another ballistic coefficient, m^2/kg, from *at_s* on; within the vehicle's range."""

    def send(self, to: str, payload: Any) -> int:
        """
        Send a message by radio to an agent or satellite, to ground:NAME or to ground, and return its number.

        `message_refused` tells if it could not leave, or if nobody was there to hear it.
        """

    def broadcast(self, payload: Any) -> int:
        """Send a message by radio to every vehicle in view, and return its number."""

    def estimate(self, values: Mapping[str, float | None]) -> None:
        """Record what flight software believes now; names with units, such as slot_error_deg."""

    def log(self, level: str, text: str) -> None:
        """Log a sentence at critical, error, warning, info or debug."""


class AnsweredContext(FlightContext, Protocol):
    """The same as what stands in for software elsewhere sees it, whose answers to several ticks may come at once."""

    def begin_answer(self) -> None:
        """Take what comes from here on as that of another tick: by its bounds, and not beside what was said before."""


class FlightSoftware(Protocol):
    """Flight software under test. Subclass it and override what is needed."""

    context: FlightContext

    def setup(self, context: FlightContext) -> None:
        """Prepare; called once, before the first tick."""
        self.context = context

    def step(self, t_s: float, readings: Readings) -> None:
        """Do one tick's work."""

    def receive(self, message: Delivery) -> None:
        """Take a message by radio; called right before the tick in which it is heard."""

    def command_result(self, result: CommandResult) -> None:
        """Take what became of a command; called right before a tick."""

    def message_refused(self, refusal: TransmissionRefusal) -> None:
        """Take that a message of one's own was refused, and why; called right before a tick."""

    def finish(self) -> Mapping[str, Any]:
        """Return a summary: plain numbers and texts. No tick follows: it can neither command nor send any more."""
        return {}
