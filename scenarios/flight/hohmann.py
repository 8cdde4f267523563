"""
Injection into a Hohmann transfer: one burn to an apogee of 42,164 km, if wanted a second one there.

The thesis (section 6.2.1) gave this to single satellites. Each satellite takes its own state at the time
of the burn, predicted from its newest reading, and asks for the along-track velocity whose ellipse has
the apogee wanted. J2's potential counts: low down it is worth up to 5 m/s, and an osculating apogee
that leaves it out is up to 300 km away from where the satellite will be.

flight.settings:

    burn_s            time of the first burn, s (60)
    lead_s            from command to burn, s (3); 0 for one tick
    apogee_km         distance of the apogee from the Earth's centre, km (42164)
    has_j2            whether J2 counts (true); false is the textbook's transfer
    circularise       whether a second burn makes the orbit round at the apogee (false)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    FlightContext,
    FlightSoftware,
    Reading,
    Readings,
)
from madns_runtime.simulations.constellation.flight.ring_consensus import position_reading
from madns_runtime.simulations.constellation.messages import CommandResult
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.elements import elements_from_state

MU = EGM_96.mu_m3_s2
PREDICTION_STEP_S = 1.0
"""Of RK4: its error over minutes is far below GNSS's."""


class Hohmann(FlightSoftware):
    """One satellite that leaves its orbit."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings."""
        self.context = context
        settings = context.settings
        self._apogee_m = 1e3 * float(settings.get("apogee_km", 42_164.0))
        # One tick's lead, and half a tick more for the rounding of times.
        self._lead_s = float(settings.get("lead_s", 3.0)) or 1.0 / context.tick_hz
        self._burn_s = float(settings.get("burn_s", 60.0))
        self._circularises = bool(settings.get("circularise", False))
        self._j2 = EGM_96.j2 if settings.get("has_j2", True) else 0.0
        self._newest: Reading | None = None
        self._asked_m_s: list[float] = []
        self._given_m_s: list[float] = []
        self._slack_s = 0.5 / context.tick_hz
        self._reported_s = -math.inf
        self._refused = 0

    def step(self, t_s: float, readings: Readings) -> None:
        """Keep the newest reading; command when the lead begins; report once a second."""
        if (reading := position_reading(readings)) is not None:
            self._newest = reading
        if self._newest is None:
            return
        if t_s + self._lead_s >= self._burn_s - self._slack_s:
            self._command(t_s)
        if t_s - self._reported_s >= 1.0 - self._slack_s:
            self._reported_s = t_s
            self._report()

    def command_result(self, result: CommandResult) -> None:
        """Note what was given, and plan the second burn from it."""
        if result.status == "refused":
            self._refused += 1
            self.context.log("warning", f"burn refused: {result.reason}")
        elif result.status == "executed":
            self._given_m_s.append(result.delta_v_m_s)

    def finish(self) -> Mapping[str, Any]:
        """Return what was asked for, what was given and where it leads."""
        return {
            "burns": len(self._asked_m_s),
            "refused": self._refused,
            "delta_v_asked_m_s": sum(self._asked_m_s),
            "delta_v_m_s": sum(self._given_m_s),
            "apogee_km": 0.0
            if self._newest is None
            else apogee_m(self._newest.values, self._j2) / 1e3,
        }

    def _command(self, t_s: float) -> None:
        at_s = max(self._burn_s, t_s + self._lead_s)
        assert self._newest is not None
        state = predicted(self._newest.values[:6], at_s - self._newest.t_s)
        if self._asked_m_s:
            along_m_s = round_m_s(state)
            self._burn_s = math.inf
        else:
            along_m_s = injection_m_s(state, self._apogee_m, self._j2)
            self._burn_s = (
                self._apogee_s(state, along_m_s, at_s) if self._circularises else math.inf
            )
        self.context.delta_v((0.0, along_m_s, 0.0), at_s=at_s, frame="rtn")
        self._asked_m_s.append(abs(along_m_s))

    def _apogee_s(self, state: Sequence[float], along_m_s: float, at_s: float) -> float:
        """Return when the ellipse after the first burn is at its apogee."""
        r, v = state[:3], state[3:]
        _, along = axes(state)
        after = tuple(value + along_m_s * axis for value, axis in zip(v, along, strict=True))
        elements = elements_from_state((r[0], r[1], r[2]), (after[0], after[1], after[2]), MU)
        a_m = sma_m((*r, *after), self._j2)
        n_rad_s = math.sqrt(MU / a_m**3)
        return at_s + (math.pi - elements.mean_anomaly_rad) % math.tau / n_rad_s

    def _apogee_km(self, reading: Reading) -> float:
        # Of a round orbit J2's potential would be taken for eccentricity: its root is not small.
        return apogee_m(reading.values, 0.0 if len(self._given_m_s) > 1 else self._j2) / 1e3

    def _report(self) -> None:
        assert self._newest is not None
        self.context.estimate(
            {
                "apogee_km": self._apogee_km(self._newest),
                "delta_v_asked_m_s": sum(self._asked_m_s),
                "delta_v_m_s": sum(self._given_m_s),
            }
        )


def injection_m_s(state: Sequence[float], apogee_m: float, j2: float) -> float:
    """
    Return the along-track change of velocity after which the ellipse's apogee is *apogee_m*, m/s.

    Energy and angular momentum at the state and at the apogee: vis-viva for a state whose radial
    velocity stays, (1 - r^2/ra^2) vt^2 = 2 mu (1/r - 1/ra) - vr^2 - 2 (V - Va), with J2's potential V.
    """
    r, vr, vt = polar(state)
    # The apogee is on the other side of the Earth, at the latitude's mirror image.
    oblate = oblate_j_kg(state, j2) * (1.0 - (r / apogee_m) ** 3)
    wanted = 2.0 * MU * (1.0 / r - 1.0 / apogee_m) - vr * vr - 2.0 * oblate
    return math.sqrt(wanted / (1.0 - (r / apogee_m) ** 2)) - vt


def round_m_s(state: Sequence[float]) -> float:
    """Return the along-track change of velocity to a circular orbit's speed, m/s."""
    r, _, vt = polar(state)
    return math.sqrt(MU / r) - vt


def apogee_m(state: Sequence[float], j2: float) -> float:
    """Return the apogee of the ellipse with the state's energy and momentum, m from the Earth's centre."""
    r, _, vt = polar(state)
    a = sma_m(state, j2)
    return a * (1.0 + math.sqrt(max(0.0, 1.0 - (r * vt) ** 2 / (MU * a))))


def sma_m(state: Sequence[float], j2: float) -> float:
    """Return the semi-major axis that belongs to the state's energy, J2's potential included, m."""
    r, vr, vt = polar(state)
    return 1.0 / (2.0 / r - (vr * vr + vt * vt + 2.0 * oblate_j_kg(state, j2)) / MU)


def oblate_j_kg(state: Sequence[float], j2: float) -> float:
    """Return J2's potential energy per mass, J/kg."""
    r2 = _dot(state[:3], state[:3])
    scale = 0.5 * MU * j2 * EGM_96.radius_m**2 / (r2 * math.sqrt(r2))
    return scale * (3.0 * state[2] ** 2 / r2 - 1.0)


def polar(state: Sequence[float]) -> tuple[float, float, float]:
    """Return distance (m), radial and along-track velocity (m/s)."""
    radial, along = axes(state)
    r = math.hypot(*state[:3])
    return r, _dot(state[3:6], radial), _dot(state[3:6], along)


def axes(state: Sequence[float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the radial and the along-track unit vector."""
    r = math.hypot(*state[:3])
    radial = tuple(value / r for value in state[:3])
    vr = _dot(state[3:6], radial)
    across = tuple(v - vr * axis for v, axis in zip(state[3:6], radial, strict=True))
    speed = math.hypot(*across)
    return radial, tuple(value / speed for value in across)


def predicted(state: Sequence[float], span_s: float) -> tuple[float, ...]:
    """Return the state *span_s* later, under two-body gravity and J2, by RK4."""
    steps = max(1, math.ceil(span_s / PREDICTION_STEP_S))
    h, y = span_s / steps, tuple(state)
    for _ in range(steps):
        k1 = _derivative(y)
        k2 = _derivative(_moved(y, k1, 0.5 * h))
        k3 = _derivative(_moved(y, k2, 0.5 * h))
        k4 = _derivative(_moved(y, k3, h))
        total = tuple(a + 2.0 * (b + c) + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True))
        y = _moved(y, total, h / 6.0)
    return y


def _derivative(y: Sequence[float]) -> tuple[float, ...]:
    r2 = y[0] * y[0] + y[1] * y[1] + y[2] * y[2]
    r = math.sqrt(r2)
    point = -MU / (r2 * r)
    oblate = 1.5 * EGM_96.j2 * (EGM_96.radius_m**2 / r2)
    five = 5.0 * y[2] * y[2] / r2
    plane = point * (1.0 + oblate * (1.0 - five))
    return (
        *y[3:6],
        plane * y[0],
        plane * y[1],
        point * (1.0 + oblate * (3.0 - five)) * y[2],
    )


def _moved(y: Sequence[float], rate: Sequence[float], h: float) -> tuple[float, ...]:
    return tuple(value + h * change for value, change in zip(y, rate, strict=True))


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))
