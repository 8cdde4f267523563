"""
The job that computes truth: one call for all vehicles and a stretch of time, made in the executor.

A propagator is an engine, a class with `propagate` in `truth.propagators`, and its settings with its properties,
a member of the union in parameters.py. Engines are imported when they are first used, so that neither the
host's loop nor a test of the table pays for scipy.

Several workers compute a stretch at once, the same to the last digit however many: scipy takes one step size for
all vehicles of a call, so who is in a call shows in the last digits (1e-9 m). Vehicles are therefore propagated
in blocks that follow from their order alone: the first BLOCK, the next BLOCK, and so on. A part is some blocks in
a row, and cutting a part into blocks again gives the same ones.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import ConfigurationError
from madns_runtime.plain_values import first_few
from madns_runtime.simulations.constellation.orbit.constants import (
    EARTH_POLAR_RADIUS_M,
    GravityModel,
)
from madns_runtime.simulations.constellation.orbit.invariants import invariants
from madns_runtime.simulations.constellation.parameters import PROPAGATORS, AnyPropagator
from madns_runtime.simulations.constellation.truth.element_set import ElementSet

FAULTS_MAX = 5
"""Vehicles that one message names."""
_ANY_ORBIT = (7.0e6, 0.0, 0.0, 0.0, 7.5e3, 0.0)
"""Position and velocity, m and m/s."""

BLOCK = 500
"""Vehicles that share a call where they see each other: fewer cost more overhead than workers save."""
INDEPENDENT_BLOCK = 50
"""Least vehicles in a part where each is computed by itself, and parts may be cut anywhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PropagationParameters:
    """All that a propagator may need besides states and times; travels to the executor."""

    settings: AnyPropagator
    gravity: GravityModel
    epoch_utc: datetime
    """UTC of t = 0."""
    element_sets: tuple[ElementSet, ...] = ()
    """One per vehicle, in the order of the states; empty for others than sgp4."""
    ballistic_m2_kg: NDArray[np.float64] | None = None
    """Cd A / m of each vehicle, shape (N,), m^2/kg; None for no drag whatever the forces."""
    thrust_m_s2: NDArray[np.float64] | None = None
    """Acceleration of each vehicle's thruster, shape (N, 3), m/s^2, TEME, constant all through the call."""
    base_directory: str = "."
    """Folder of the scenario, which a custom propagator's file is found from."""
    names: tuple[str, ...] = ()
    """Names of the vehicles in messages, in the order of the states; empty for their numbers."""

    def of(self, vehicles: Sequence[int]) -> PropagationParameters:
        """Return what some of the vehicles need, in that order."""
        rows, sets = list(vehicles), self.element_sets
        ballistic, thrust = self.ballistic_m2_kg, self.thrust_m_s2
        return replace(
            self,
            element_sets=tuple(sets[n] for n in rows) if sets else (),
            ballistic_m2_kg=None if ballistic is None else ballistic[rows],
            thrust_m_s2=None if thrust is None else thrust[rows],
            names=tuple(self.names[n] for n in rows) if self.names else (),
        )

    def name_of(self, vehicle: int) -> str:
        """Return what messages call a vehicle."""
        return self.names[vehicle] if self.names else f"vehicle {vehicle}"

    @property
    def forces(self) -> tuple[str, ...]:
        """Accelerations at work; SGP4 and propagators of one's own are judged as if they had J2."""
        return self.settings.forces

    @property
    def has_j2(self) -> bool:
        """Whether the dynamics contain J2, and the energy its potential."""
        return "j2" in self.forces

    @property
    def has_drag(self) -> bool:
        """Whether the atmosphere acts on the vehicles."""
        return "drag" in self.forces and self.ballistic_m2_kg is not None

    @property
    def conserves_energy(self) -> bool:
        """Whether energy is to stay: numerical propagation of known forces without drag or thrust."""
        is_exact = self.settings.PROPERTIES.conserves_energy
        return is_exact and not self.has_drag and self.thrust_m_s2 is None


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
            parameters: Settings and constants. One that `can_maneuver` adds `thrust_m_s2` to its accelerations: the
                burns of thrusters with `thrust_n`.

        Returns:
            Shape (N, K, 6), m and m/s, TEME.

        Raises:
            ConfigurationError: A vehicle cannot be propagated; the message names it and says why.
        """


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthStretch:
    """Truth of all vehicles over some time: what a job returns."""

    first_knot: int
    """Number of the first knot; its time is first_knot times knot_s."""
    states: NDArray[np.float64]
    """Shape (N, K, 6), m and m/s, TEME."""
    invariants: NDArray[np.float64]
    """At every knot, shape (N, K, 3), see `orbit.invariants`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StretchRequest:
    """Knots to compute, and the states to begin from."""

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
    Return the propagator of a kind in PROPAGATORS, one per process: some have much to set up.

    Raises:
        MissingExtraError: The library behind it is not installed.
    """
    module, _, name = PROPAGATORS[kind].PROPERTIES.engine.partition(":")
    package = f"{__package__}.propagators"
    propagator: Propagator = getattr(importlib.import_module(f"{package}.{module}"), name)()
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
    is_down, flown = is_inside_earth(states), states
    if is_down.any() and not parameters.settings.PROPERTIES.needs_element_sets:
        # Something flies in the place of a wreck, whose own way would lead to the Earth's centre.
        flown = np.where(is_down[:, None], _ANY_ORBIT, states)
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


def propagate_stretch(request: StretchRequest, parameters: PropagationParameters) -> TruthStretch:
    """Compute a stretch of truth and what it should conserve; runs in the executor."""
    numbers = np.arange(request.first_knot, request.first_knot + request.knots)
    # Times are products, not sums, so that knots stay on the grid however long the run.
    times_s = numbers.astype(np.float64) * request.knot_s
    states = propagate(request.states, float(times_s[0]), times_s, parameters)
    conserved = conserved_by(states, parameters)
    return TruthStretch(first_knot=request.first_knot, states=states, invariants=conserved)


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
    if parameters.thrust_m_s2 is not None and not parameters.settings.can_maneuver:
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
    for vehicle in vehicles.tolist():
        knot = int(np.argmin(sound[vehicle]))
        what = f"expected a finite state, got {states[vehicle, knot].tolist()}"
        faults.append(f"{parameters.name_of(vehicle)}: {what}, at {times_s[knot]:g} s")
    if faults:  # else their sum alone is too large
        raise ConfigurationError(first_few(faults, FAULTS_MAX, "\n"))


Part = tuple[StretchRequest, PropagationParameters]
"""Arguments of `propagate_part`."""


def split(request: StretchRequest, parameters: PropagationParameters, parts_max: int) -> list[Part]:
    """
    Cut a request into at most *parts_max* parts of nearly equal size, in the vehicles' order.

    Args:
        request: All vehicles.
        parameters: What is one per vehicle is in the order of the request.
        parts_max: Parts wanted, at least 1: the workers, N_p.
    """
    is_independent = parameters.settings.PROPERTIES.is_independent
    size = INDEPENDENT_BLOCK if is_independent else BLOCK
    count = len(request.states)
    blocks = max(1, -(-count // size))
    parts = min(max(1, parts_max), blocks)
    edges = [min(size * (blocks * n // parts), count) for n in range(parts + 1)]
    return [
        _cut(request, parameters, slice(first, last))
        for first, last in zip(edges[:-1], edges[1:], strict=True)
    ]


def propagate_part(request: StretchRequest, parameters: PropagationParameters) -> TruthStretch:
    """Compute a part, or the whole, block by block; runs in the executor."""
    count = len(request.states)
    if count <= BLOCK or parameters.settings.PROPERTIES.is_independent:
        return propagate_stretch(request, parameters)
    blocks = [slice(first, first + BLOCK) for first in range(0, count, BLOCK)]
    return merge([propagate_stretch(*_cut(request, parameters, block)) for block in blocks])


def merge(parts: Sequence[TruthStretch]) -> TruthStretch:
    """
    Put parts together again, in the order of `split`.

    Raises:
        ValueError: They are not of the same knots.
    """
    knots = {(part.first_knot, part.states.shape[1]) for part in parts}
    if len(knots) != 1:
        raise ValueError(f"parts: expected one stretch's, got first knots and lengths {knots}")
    if len(parts) == 1:
        return parts[0]
    return TruthStretch(
        first_knot=parts[0].first_knot,
        states=np.concatenate([part.states for part in parts]),
        invariants=np.concatenate([part.invariants for part in parts]),
    )


def _cut(request: StretchRequest, parameters: PropagationParameters, part: slice) -> Part:
    """Return the request and the parameters of some of the vehicles."""
    some = range(*part.indices(len(request.states)))
    return replace(request, states=request.states[part]), parameters.of(some)
