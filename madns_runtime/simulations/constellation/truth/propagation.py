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
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    GravityModel,
)
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
    "numba": f"{_TRUTH}.numba_propagator:NumbaDop853",
    "sgp4": f"{_TRUTH}.sgp4_propagator:Sgp4",
    "basilisk": f"{_TRUTH}.basilisk_propagator:Basilisk",
    "custom": f"{_TRUTH}.custom_propagator:Custom",
}
"""The kind in a scenario -> module:class."""
FAULTS_MAX = 5
"""Vehicles that one message names."""
_ANY_ORBIT = (7.0e6, 0.0, 0.0, 0.0, 7.5e3, 0.0)
"""Position and velocity, m and m/s."""


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
    names: tuple[str, ...] = ()
    """What messages call the vehicles, in the order of the states; empty for their numbers."""

    def name_of(self, vehicle: int) -> str:
        """Return what messages call a vehicle."""
        return self.names[vehicle] if self.names else f"vehicle {vehicle}"

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


@lru_cache(maxsize=len(PROPAGATORS))
def load_propagator(kind: str) -> Propagator:
    """
    Return the propagator of a kind in PROPAGATORS, one a process: some have much to set up.

    Raises:
        MissingExtraError: The library behind it is not installed.
    """
    module, _, name = PROPAGATORS[kind].partition(":")
    propagator: Propagator = getattr(importlib.import_module(module), name)()
    return propagator


def propagate(
    states: NDArray[np.float64],
    t0_s: float,
    knots_s: NDArray[np.float64],
    parameters: PropagationParameters,
) -> NDArray[np.float64]:
    """
    Return the states of all vehicles at all knots by the propagator of the settings.

    Arguments and result are those of `Propagator.propagate`, and are judged here for all kinds. A vehicle
    that has met the Earth stands still: from the knot after the first one inside it, or all through a call
    that begins there, so that the others' truth goes on.

    Raises:
        ConfigurationError: Arguments do not fit each other, or a vehicle cannot be propagated; the
            message names it and says when and why.
        MissingExtraError: The library behind the propagator is not installed.
    """
    _check_arguments(states, t0_s, knots_s, parameters)
    shape = (len(states), len(knots_s), 6)
    if 0 in shape:
        return np.empty(shape)
    is_down = is_inside_earth(states)
    # Something flies in the place of a wreck, whose own way would lead to the Earth's centre.
    flown = np.where(is_down[:, None], _ANY_ORBIT, states) if is_down.any() else states
    found = load_propagator(parameters.settings.kind).propagate(flown, t0_s, knots_s, parameters)
    _check_result(found, shape, knots_s, parameters)
    inside = is_inside_earth(found)
    if not (inside.any() or is_down.any()):
        return found
    return _held(states, found, inside, knots_s > t0_s)


def is_inside_earth(states: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell of states (..., 6) whether they are nearer to the Earth's centre than its poles."""
    r2 = np.einsum("...i,...i->...", states[..., :3], states[..., :3])
    return np.asarray(r2 < EARTH_POLAR_RADIUS_M**2)


def _held(
    states: NDArray[np.float64],
    found: NDArray[np.float64],
    inside: NDArray[np.bool_],
    is_later: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return the states found with vehicles standing still once they are inside the Earth."""
    held = np.array(found)
    for vehicle in np.flatnonzero(is_inside_earth(states)):
        held[vehicle] = states[vehicle]
        held[vehicle, is_later, 3:] = 0.0
        inside[vehicle] = False
    for vehicle in np.flatnonzero(inside.any(axis=1)):
        first = int(np.argmax(inside[vehicle]))
        held[vehicle, first + 1 :, :3] = held[vehicle, first, :3]
        held[vehicle, first + 1 :, 3:] = 0.0
    return held


def propagate_stretch(request: StretchRequest, parameters: PropagationParameters) -> Stretch:
    """Compute a stretch of truth and what it should conserve; runs in the executor."""
    numbers = np.arange(request.first_knot, request.first_knot + request.knots)
    # Times are products, not sums, so that knots stay on the grid however long the run.
    times_s = numbers.astype(np.float64) * request.knot_s
    states = propagate(request.states, float(times_s[0]), times_s, parameters)
    conserved = conserved_by(states, parameters)
    return Stretch(first_knot=request.first_knot, states=states, invariants=conserved)


def conserved_by(
    states: NDArray[np.float64], parameters: PropagationParameters
) -> NDArray[np.float64]:
    """Return the invariants, shape (..., 3), of states (..., 6) under the forces of *parameters*."""
    also = [force for force in parameters.forces if force in ("j3", "j4")]
    return invariants(states, parameters.gravity, with_j2=parameters.has_j2, also=also)


def _check_arguments(
    states: NDArray[np.float64],
    t0_s: float,
    knots_s: NDArray[np.float64],
    parameters: PropagationParameters,
) -> None:
    count = len(states)
    wanted: dict[str, tuple[NDArray[np.float64], tuple[int, ...]]] = {
        "states": (states, (count, 6))
    }
    if parameters.ballistic_m2_kg is not None:
        wanted["ballistic_m2_kg"] = (parameters.ballistic_m2_kg, (count,))
    if parameters.thrust_m_s2 is not None:
        wanted["thrust_m_s2"] = (parameters.thrust_m_s2, (count, 3))
    faults = [
        f"propagation: expected {name} of shape {shape}, got {values.shape}"
        for name, (values, shape) in wanted.items()
        if values.shape != shape
    ]
    if "two_body" not in parameters.forces:
        faults.append(
            f"parameters.propagator.forces: expected two_body among them, got {list(parameters.forces)}"
        )
    if parameters.thrust_m_s2 is not None and not can_maneuver(parameters.settings):
        kind = parameters.settings.kind
        faults.append(f"parameters.propagator: {kind} cannot follow a thrust, see can_maneuver")
    if not np.isfinite(knots_s).all() or (np.diff(knots_s, prepend=t0_s) < 0.0).any():
        faults.append(f"propagation: expected knots that ascend from {t0_s:g} s on, got {knots_s}")
    if faults:
        raise ConfigurationError("\n".join(faults))
    _check_finite(states[:, None], np.array([t0_s]), parameters)


def _check_result(
    found: object,
    shape: tuple[int, ...],
    knots_s: NDArray[np.float64],
    parameters: PropagationParameters,
) -> None:
    """Raise ConfigurationError for anything but finite float64 states of that shape."""
    got = type(found).__name__
    if isinstance(found, np.ndarray):
        if found.shape == shape and found.dtype == np.float64:
            return _check_finite(found, knots_s, parameters)
        got = f"{found.shape} of {found.dtype}"
    raise ConfigurationError(
        f"parameters.propagator: expected states of shape {shape} of float64, got {got}"
    )


def _check_finite(
    states: NDArray[np.float64], times_s: NDArray[np.float64], parameters: PropagationParameters
) -> None:
    """Raise ConfigurationError for states (N, K, 6) that are not finite."""
    # A sum is finite only if all of its numbers are: one quick look at what is nearly always sound.
    if np.isfinite(states.sum()):
        return
    sound = np.asarray(np.isfinite(states).all(axis=2))
    vehicles = np.flatnonzero(~sound.all(axis=1))
    faults = []
    for vehicle in vehicles[:FAULTS_MAX].tolist():
        knot = int(np.argmin(sound[vehicle]))
        what = f"expected a finite state, got {states[vehicle, knot].tolist()}"
        faults.append(f"{parameters.name_of(vehicle)}: {what}, at {times_s[knot]:g} s")
    if len(vehicles) > FAULTS_MAX:
        faults.append(f"and {len(vehicles) - FAULTS_MAX} more")
    if faults:  # else their sum alone is too large
        raise ConfigurationError("\n".join(faults))
