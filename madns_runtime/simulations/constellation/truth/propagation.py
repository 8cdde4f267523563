"""
The job that computes truth: one call for all vehicles and a stretch of time, made in the executor.

A new propagator is a class with `propagate` and one line in PROPAGATORS; its settings are one more
member of the union in parameters.py. Classes are named, not imported, so that neither the host's
loop nor a test of the table pays for scipy.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from madns_runtime.simulations.constellation.orbit.constants import GravityModel
from madns_runtime.simulations.constellation.orbit.invariants import invariants
from madns_runtime.simulations.constellation.parameters import (
    AnyPropagator,
    CustomPropagator,
    Sgp4Propagator,
)
from madns_runtime.simulations.constellation.truth.element_sets import ElementSet

_TRUTH = "madns_runtime.simulations.constellation.truth"

PROPAGATORS = {
    "scipy": f"{_TRUTH}.scipy_propagator:ScipyDop853",
    "sgp4": f"{_TRUTH}.sgp4_propagator:Sgp4",
}
"""The kind in a scenario -> module:class."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PropagationParameters:
    """All that a propagator may need besides states and times; travels to the executor."""

    settings: AnyPropagator
    gravity: GravityModel
    epoch_utc: datetime
    """UTC of t = 0."""
    element_sets: tuple[ElementSet, ...] = ()
    """One a vehicle, in the order of the states; empty for others than sgp4."""
    ballistic_m2_kg: NDArray[np.float64] | None = None
    """Cd A / m of each vehicle, shape (N,), m^2/kg; None for no drag whatever the forces."""
    thrust_m_s2: NDArray[np.float64] | None = None
    """Acceleration of each vehicle's thruster, shape (N, 3), m/s^2, TEME, constant all through the call."""
    base_directory: str = "."
    """Folder of the scenario, which a custom propagator's file is found from."""

    @property
    def forces(self) -> tuple[str, ...]:
        """Accelerations at work; SGP4 and propagators of one's own are judged as if they had J2."""
        return getattr(self.settings, "forces", ("two_body", "j2"))

    @property
    def has_j2(self) -> bool:
        """Whether the dynamics contain J2, and the energy its potential."""
        return "j2" in self.forces

    @property
    def conserves_energy(self) -> bool:
        """Whether energy is to stay: numerical propagation of known forces without drag or thrust."""
        drags = "drag" in self.forces and self.ballistic_m2_kg is not None
        return hasattr(self.settings, "forces") and not drags and self.thrust_m_s2 is None


def can_maneuver(settings: AnyPropagator) -> bool:
    """Tell whether a propagator starts from any state, as a vehicle after a maneuver needs."""
    if isinstance(settings, CustomPropagator):
        return settings.can_maneuver
    return not isinstance(settings, Sgp4Propagator)


class Propagator(Protocol):
    """Turns states at one time into states at many."""

    def propagate(
        self,
        states: NDArray[np.float64],
        t0_s: float,
        knots_s: NDArray[np.float64],
        parameters: PropagationParameters,
    ) -> NDArray[np.float64]:
        """
        Return the states of all vehicles at all knots.

        Args:
            states: At t0_s, shape (N, 6), m and m/s, TEME.
            t0_s: Simulated time of *states*, s.
            knots_s: Times, shape (K,), s, ascending, none before t0_s.
            parameters: Settings and constants.

        Returns:
            Shape (N, K, 6), m and m/s, TEME.

        Raises:
            ConfigurationError: A vehicle cannot be propagated; the message names it and says why.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretch:
    """Truth of all vehicles over some time: what a job returns."""

    first_knot: int
    """Number of the first knot; its time is first_knot times knot_s."""
    states: NDArray[np.float64]
    """Shape (N, K, 6), m and m/s, TEME."""
    invariants: NDArray[np.float64]
    """At every knot, shape (N, K, 3), see `orbit.invariants`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StretchRequest:
    """Which knots to compute, and from where."""

    first_knot: int
    """The knot that *states* belong to; it is the first of the result, too."""
    knots: int
    """Number of knots, the first included."""
    knot_s: float
    states: NDArray[np.float64]
    """Shape (N, 6), m and m/s, TEME."""


def load_propagator(kind: str) -> Propagator:
    """
    Return the propagator of a kind in PROPAGATORS.

    Raises:
        MissingExtraError: The library behind it is not installed.
    """
    module, _, name = PROPAGATORS[kind].partition(":")
    propagator: Propagator = getattr(importlib.import_module(module), name)()
    return propagator


def propagate_stretch(request: StretchRequest, parameters: PropagationParameters) -> Stretch:
    """Compute a stretch of truth and what it should conserve; runs in the executor."""
    numbers = np.arange(request.first_knot, request.first_knot + request.knots)
    # Times are products, not sums, so that knots stay on the grid however long the run.
    times_s = numbers.astype(np.float64) * request.knot_s
    propagator = load_propagator(parameters.settings.kind)
    states = propagator.propagate(request.states, float(times_s[0]), times_s, parameters)
    conserved = invariants(states, parameters.gravity, with_j2=parameters.has_j2)
    return Stretch(first_knot=request.first_knot, states=states, invariants=conserved)
