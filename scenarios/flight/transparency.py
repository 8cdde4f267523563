"""
Takes a satellite to its slot in a ring and keeps it there, by its own navigation alone.

The same software flies on truth and on GNSS: the study of the two is in docs/transparency.md. Navigation
is a Kalman filter of two numbers, the error of the slot and the mean semi-major axis; guidance turns the
error into a semi-major axis that lets it fade with a time constant, and commands the difference along-track.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.simulations.constellation.flight.api import (
    TRUTH,
    FlightContext,
    FlightSoftware,
    Reading,
    Readings,
)
from madns_runtime.simulations.constellation.messages import CommandResult
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_state,
    secular_rates,
    wrapped,
)

DEFAULTS = {
    "a_km": 7158.137,
    "i_deg": 53.0,
    "first_deg": 0.0,
    "spacing_deg": 60.0,
    "time_constant_s": 9000.0,
    "period_s": 3000.0,
    "lead_s": 3.0,
    "estimate_s": 60.0,
    "position_noise_m": 30.0,
    "velocity_noise_m_s": 0.1,
    "delta_v_min_m_s": 1e-3,
    "delta_v_error": 0.02,
}
"""Ring: mean semi-major axis, inclination, mean argument of latitude of the first slot at the epoch and from
slot to slot. Guidance: time constant, time between commands, from command to execution, between records of
estimates. Navigation: noise that it reckons with, of a fix and, as a share, of a maneuver."""
DRIFT_M_S = 0.003
"""Random walk of the semi-major axis that the filter allows for, m over one square root of a second."""


class Navigation:
    """
    Kalman filter of slot error e, rad, and mean semi-major axis minus the ring's, d, m.

    e grows by -3/2 n d / a a second.
    """

    def __init__(self, a_m: float, mean_motion_rad_s: float) -> None:
        self.error_rad = self.excess_m = 0.0
        self.t_s: float | None = None
        self._drift = -1.5 * mean_motion_rad_s / a_m
        # Nothing is known before the first fix.
        self._p_ee, self._p_ed, self._p_dd = math.pi**2, 0.0, 1e8

    def predict(self, t_s: float) -> None:
        """Go on to a time, s; back by as much as a fix is late."""
        step_s = 0.0 if self.t_s is None else t_s - self.t_s
        self.t_s = t_s
        f = self._drift * step_s
        self.error_rad += f * self.excess_m
        self._p_ee += f * (2.0 * self._p_ed + f * self._p_dd)
        self._p_ed += f * self._p_dd
        self._p_dd += DRIFT_M_S**2 * abs(step_s)

    def kick(self, change_m: float, sigma_m: float) -> None:
        """Take a maneuver's change of the semi-major axis."""
        self.excess_m += change_m
        self._p_dd += sigma_m * sigma_m

    def take(self, error_rad: float, excess_m: float, sigmas: tuple[float, float]) -> None:
        """Take a fix and its standard deviations."""
        gain = self._p_ee + sigmas[0] ** 2
        k_e, k_d = self._p_ee / gain, self._p_ed / gain
        residual = wrapped(error_rad - self.error_rad)
        self.error_rad += k_e * residual
        self.excess_m += k_d * residual
        self._p_dd -= k_d * self._p_ed
        self._p_ee, self._p_ed = (1.0 - k_e) * self._p_ee, (1.0 - k_e) * self._p_ed
        gain = self._p_dd + sigmas[1] ** 2
        k_e, k_d = self._p_ed / gain, self._p_dd / gain
        residual = excess_m - self.excess_m
        self.error_rad += k_e * residual
        self.excess_m += k_d * residual
        self._p_ee -= k_e * self._p_ed
        self._p_ed, self._p_dd = (1.0 - k_d) * self._p_ed, (1.0 - k_d) * self._p_dd


class Guidance(FlightSoftware):
    """One satellite's navigation and guidance."""

    def setup(self, context: FlightContext) -> None:
        """Read the settings; this satellite's slot is its place among the agents."""
        self.context = context
        # slots is not for us but for those who judge the run by truth: cosmos report and cosmos diff.
        unknown = sorted(set(context.settings) - set(DEFAULTS) - {"gravity", "slots"})
        if unknown:
            raise ValueError(f"flight.settings: unknown {', '.join(unknown)}")
        given = {name: float(value) for name, value in context.settings.items() if name in DEFAULTS}
        s = self.settings = DEFAULTS | given
        self.gravity = GRAVITY_MODELS[context.settings.get("gravity", "EGM-96")]
        self.a_m = s["a_km"] * 1e3
        ring = CircularElements(
            a_m=self.a_m,
            ex=0.0,
            ey=0.0,
            i_rad=math.radians(s["i_deg"]),
            raan_rad=0.0,
            lam_rad=math.radians(s["first_deg"] + s["spacing_deg"] * context.index),
        )
        self.slot_rad, self.rate_rad_s = ring.lam_rad, secular_rates(ring, self.gravity).lam_rad_s
        self.n_rad_s = math.sqrt(self.gravity.mu_m3_s2 / self.a_m**3)
        self.navigation = Navigation(self.a_m, self.n_rad_s)
        self.commanded: dict[int, float] = {}
        self.coming: list[tuple[float, float]] = []
        self.next_command_s, self.next_estimate_s = s["period_s"], 0.0
        self.spent_m_s, self.fixes = 0.0, 0

    def step(self, t_s: float, readings: Readings) -> None:
        """Take a fix if there is one, and act when it is time to."""
        fix = readings.get(TRUTH) or readings.get("gnss")
        if fix is not None:
            self._take(fix)
        if not self.fixes:
            return
        self._go_to(t_s)
        if t_s >= self.next_estimate_s:
            self.next_estimate_s += self.settings["estimate_s"]
            error_deg = math.degrees(self.navigation.error_rad)
            excess_m = self.navigation.excess_m
            self.context.estimate({"slot_error_deg": error_deg, "sma_excess_m": excess_m})
        if t_s >= self.next_command_s:
            self.next_command_s += self.settings["period_s"]
            self._command(t_s)

    def command_result(self, result: CommandResult) -> None:
        """Reckon with what was commanded, from its time on, unless it was refused."""
        delta_v_m_s = self.commanded.pop(result.number, None)
        if delta_v_m_s is not None and result.status != "refused":
            self.coming.append((result.at_s, delta_v_m_s))
            self.spent_m_s += abs(delta_v_m_s)

    def finish(self) -> Mapping[str, Any]:
        """Return what was believed at the end."""
        return {
            "slot_error_deg": math.degrees(self.navigation.error_rad),
            "delta_v_m_s": self.spent_m_s,
            "fixes": self.fixes,
        }

    def _take(self, fix: Reading) -> None:
        x, y, z, vx, vy, vz = fix.values[:6]
        mean = mean_from_state((x, y, z), (vx, vy, vz), self.gravity)
        slot_rad = self.slot_rad + self.rate_rad_s * fix.t_s
        noise_m, noise_m_s = self.settings["position_noise_m"], self.settings["velocity_noise_m_s"]
        sigmas = (noise_m / self.a_m, 2.0 * math.hypot(noise_m, noise_m_s / self.n_rad_s))
        self._go_to(fix.t_s)
        error_rad, excess_m = wrapped(mean.lam_rad - slot_rad), mean.a_m - self.a_m
        self.navigation.take(error_rad, excess_m, sigmas)
        self.fixes += 1

    def _go_to(self, t_s: float) -> None:
        """Predict, with each maneuver at its time."""
        for at_s, delta_v_m_s in [kick for kick in self.coming if kick[0] <= t_s]:
            self.coming.remove((at_s, delta_v_m_s))
            self.navigation.predict(at_s)
            change_m = 2.0 * delta_v_m_s / self.n_rad_s
            self.navigation.kick(change_m, self.settings["delta_v_error"] * abs(change_m))
        self.navigation.predict(t_s)

    def _command(self, t_s: float) -> None:
        """Command what gives the semi-major axis that lets the error fade."""
        now, constant_s = self.navigation, self.settings["time_constant_s"]
        wanted_m = 2.0 * self.a_m * now.error_rad / (3.0 * self.n_rad_s * constant_s)
        delta_v_m_s = 0.5 * self.n_rad_s * (wanted_m - now.excess_m)
        if abs(delta_v_m_s) < self.settings["delta_v_min_m_s"] or self.coming or self.commanded:
            return
        at_s = t_s + self.settings["lead_s"]
        number = self.context.delta_v((0.0, delta_v_m_s, 0.0), at_s=at_s, frame="rtn")
        self.commanded[number] = delta_v_m_s
