"""
Spacecraft in a Basilisk simulation whose states are set, stepped and read. The one place that imports Basilisk.

A simulation has one clock, which only runs forward; orbits do not mind when they begin, so a simulation
serves any number of calls. Gravity is set here: Basilisk's own files are fetched from the internet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from madns_runtime.errors import MissingExtraError
from madns_runtime.simulations.constellation.orbit.constants import GravityModel

try:
    from Basilisk.simulation import (
        GravityGradientEffector,
        extForceTorque,
        gravityEffector,
        spacecraft,
    )
    from Basilisk.utilities import SimulationBaseClass
except ImportError as error:
    raise MissingExtraError("Basilisk", "basilisk") from error

Array = NDArray[np.float64]

_TASK = "dynamics"
_EARTH = "earth_planet_data"
_POINT_INERTIA_KG_M2 = (1.0, 1.0, 1.0)
_NOTHING = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Design of a simulation; two of equal design are exchangeable."""

    count: int
    """Spacecraft."""
    step_ns: int
    """Integration step (RK4)."""
    knot_ns: int
    """Time between the states returned: a multiple of the step."""
    gravity: GravityModel
    has_j2: bool
    has_thrust: bool
    """Whether forces and torques act."""
    inertias_kg_m2: tuple[tuple[float, float, float], ...] | None = None
    """Principal moments of each rigid body; None for point masses."""
    rotates_points: bool = False
    """Whether rotation is integrated for point masses as well, as Basilisk does unless told otherwise."""
    have_gravity_gradient: tuple[bool, ...] = ()
    """Whether gravity turns each rigid body."""

    def part(self, which: slice) -> Design:
        """Return the design for some of the spacecraft."""
        return replace(
            self,
            count=len(range(self.count)[which]),
            inertias_kg_m2=None if self.inertias_kg_m2 is None else self.inertias_kg_m2[which],
            have_gravity_gradient=self.have_gravity_gradient[which],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ForcesAndTorques:
    """Forces and torques, constant all through a call; None for none."""

    thrust_m_s2: Array | None = None
    """Accelerations, shape (N, 3), inertial."""
    torques_n_m: Array | None = None
    """Shape (N, 3), body axes."""

    def part(self, which: slice) -> ForcesAndTorques:
        """Return those of some of the spacecraft."""
        thrust, torques = self.thrust_m_s2, self.torques_n_m
        return ForcesAndTorques(
            thrust_m_s2=None if thrust is None else thrust[which],
            torques_n_m=None if torques is None else torques[which],
        )


class BasiliskSimulation:
    """All spacecraft in one process with one task."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._now_ns = 0
        self._base = SimulationBaseClass.SimBaseClass()
        process = self._base.CreateNewProcess("truth")
        process.addTask(self._base.CreateNewTask(_TASK, design.step_ns))
        self._earth = _make_earth(design)
        self._spacecraft = [self._add_spacecraft(number) for number in range(design.count)]
        self._pushes = [self._add_push(craft) for craft in self._spacecraft if design.has_thrust]
        # Kept here, as all that simulations only point to.
        self._gradients = [
            self._add_gradient(craft)
            for craft, has_gradient in zip(
                self._spacecraft, design.have_gravity_gradient, strict=False
            )
            if has_gradient
        ]
        self._recorders = [
            craft.scStateOutMsg.recorder(design.knot_ns) for craft in self._spacecraft
        ]
        for recorder in self._recorders:
            self._base.AddModelToTask(_TASK, recorder)
        self._base.InitializeSimulation()
        # At time zero every task runs once over no time, and one sample too many is taken.
        self._run_until(0)
        self._clear()

    @property
    def count(self) -> int:
        """Spacecraft."""
        return self._design.count

    def run(self, states: Array, knots: int, pushes: ForcesAndTorques) -> Array:
        """
        Return the states at the next knots.

        Args:
            states: Shape (N, 6), m and m/s, inertial; for rigid bodies (N, 13) with the quaternion,
                scalar last, inertial to body, and body rates, rad/s.
            knots: Number of knots.
            pushes: What acts on them, if the design has thrust.

        Returns:
            Shape (N, knots, 6 or 13), the last not before `knots` times the design's knot_ns.
        """
        for craft, state in zip(self._spacecraft, states.tolist(), strict=True):
            self._set(craft, state)
        thrust, torques = pushes.thrust_m_s2, pushes.torques_n_m
        # What the call before gave would go on acting.
        for number, push in enumerate(self._pushes):
            push.extForce_N = _column(_NOTHING if thrust is None else thrust[number])
            push.extTorquePntB_B = _column(_NOTHING if torques is None else torques[number])
        self._run_until(self._now_ns + knots * self._design.knot_ns)
        rows = np.stack([self._read(recorder) for recorder in self._recorders])
        self._clear()
        return rows

    def _add_spacecraft(self, number: int) -> Any:
        craft = spacecraft.Spacecraft()
        craft.ModelTag = f"vehicle{number}"
        inertias = self._design.inertias_kg_m2
        # Rigid bodies cost more than twice as much; as of Basilisk 2.12 points need not be any.
        craft.pointMassTranslationalOnly = inertias is None and not self._design.rotates_points
        craft.hub.mHub = 1.0
        moments = _POINT_INERTIA_KG_M2 if inertias is None else inertias[number]
        craft.hub.IHubPntBc_B = np.diag(moments).tolist()
        # Any orbit: the first run sets the state. At the centre gravity has no value.
        craft.hub.r_CN_NInit = _column((self._design.gravity.radius_m, 0.0, 0.0))
        craft.gravField.gravBodies = spacecraft.GravBodyVector([self._earth])
        self._base.AddModelToTask(_TASK, craft)
        return craft

    def _add_push(self, craft: Any) -> Any:
        push = extForceTorque.ExtForceTorque()
        push.ModelTag = f"{craft.ModelTag}_push"
        craft.addDynamicEffector(push)
        self._base.AddModelToTask(_TASK, push)
        return push

    def _add_gradient(self, craft: Any) -> Any:
        gradient = GravityGradientEffector.GravityGradientEffector()
        gradient.ModelTag = f"{craft.ModelTag}_gradient"
        gradient.addPlanetName(_EARTH)
        craft.addDynamicEffector(gradient)
        self._base.AddModelToTask(_TASK, gradient)
        return gradient

    def _set(self, craft: Any, state: list[float]) -> None:
        manager, hub = craft.dynManager, craft.hub
        manager.getStateObject(hub.nameOfHubPosition).setState(_column(state[:3]))
        manager.getStateObject(hub.nameOfHubVelocity).setState(_column(state[3:6]))
        if self._design.inertias_kg_m2 is not None:
            manager.getStateObject(hub.nameOfHubSigma).setState(_column(mrp_of(state[6:10])))
            manager.getStateObject(hub.nameOfHubOmega).setState(_column(state[10:13]))

    def _read(self, recorder: Any) -> Array:
        parts = [np.array(recorder.r_BN_N), np.array(recorder.v_BN_N)]
        if self._design.inertias_kg_m2 is not None:
            parts += [quaternions_of(np.array(recorder.sigma_BN)), np.array(recorder.omega_BN_B)]
        return np.hstack(parts)

    def _run_until(self, time_ns: int) -> None:
        self._base.ConfigureStopTime(time_ns)
        self._base.ExecuteSimulation()
        self._now_ns = time_ns

    def _clear(self) -> None:
        for recorder in self._recorders:
            recorder.clear()


def mrp_of(quaternion: list[float]) -> tuple[float, float, float]:
    """Return Basilisk's modified Rodrigues parameters of a quaternion, scalar last, inertial to body."""
    x, y, z, w = quaternion
    # Of the two quaternions of an attitude the one whose parameters stay below one.
    share = 1.0 / (abs(w) + 1.0) * math.copysign(1.0, w)
    return x * share, y * share, z * share


def quaternions_of(mrps: Array) -> Array:
    """Return quaternions (K, 4), scalar last, inertial to body, of Basilisk's parameters (K, 3)."""
    squares = np.sum(mrps**2, axis=1, keepdims=True)
    return np.asarray(np.hstack((2.0 * mrps, 1.0 - squares)) / (1.0 + squares))


def _make_earth(design: Design) -> Any:
    earth = gravityEffector.GravBodyData()
    earth.planetName = _EARTH
    earth.mu = design.gravity.mu_m3_s2
    earth.radEquator = design.gravity.radius_m
    earth.isCentralBody = True
    if design.has_j2:
        field = gravityEffector.SphericalHarmonicsGravityModel()
        field.maxDeg = 2
        field.muBody = design.gravity.mu_m3_s2
        field.radEquator = design.gravity.radius_m
        # Normalised: C20 = -J2 / sqrt(5).
        field.cBar = [[1.0], [0.0, 0.0], [-design.gravity.j2 / math.sqrt(5.0), 0.0, 0.0]]
        field.sBar = [[0.0], [0.0, 0.0], [0.0, 0.0, 0.0]]
        earth.gravityModel = field
    return earth


def _column(numbers: Any) -> list[list[float]]:
    return [[float(number)] for number in numbers]
