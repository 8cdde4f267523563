"""
Burns of thrusters that are stuck open, as the host goes through them: truth ahead of time, gauges, records.

Flight software is not told of the failure. Its sensors feel the thrust, and its tank's gauge is read once per second.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.plugin.api import ActionRefused, HostContext
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.actions import StuckThruster
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.truth_distribution import Refills
from madns_runtime.simulations.constellation.host_side.truth_propagation import TruthSupply
from madns_runtime.simulations.constellation.messages import TankGauge
from madns_runtime.simulations.constellation.parameters import Maneuvers
from madns_runtime.simulations.constellation.streams import STUCK_THRUSTERS
from madns_runtime.simulations.constellation.truth.maneuvers.effects import scaled
from madns_runtime.simulations.constellation.truth.maneuvers.stuck_thrusters import (
    AHEAD_S,
    StuckBurn,
    StuckDirection,
    StuckThrusters,
)

GAUGE_S = 1.0
"""Time between two readings of a gauge while the thruster burns."""
LEAD_S_MIN = 0.01
"""Truth changes no sooner after it was decided."""
STREAM = "stuck_thrusters"


class StuckBurns:
    """
    All vehicles' burns of stuck thrusters.

    Args:
        context: Through which gauges are told.
        supply: Whose truth is changed.
        refills: Who sends it.
        stuck: Decides what burns when.
        vehicles: What they are like.
    """

    def __init__(
        self,
        context: HostContext,
        supply: TruthSupply,
        refills: Refills,
        *,
        stuck: StuckThrusters,
        vehicles: Sequence[Vehicle],
    ) -> None:
        self._context = context
        self._supply = supply
        self._refills = refills
        self._stuck = stuck
        self._vehicles = vehicles
        settings: Maneuvers = context.parameters.maneuvers
        self._lead_s = max(LEAD_S_MIN, settings.propagation_s + settings.network_s)
        self._burns: list[tuple[StuckBurn, float]] = []
        """Those that go on, and when their gauges are read next."""
        self._by_failure: dict[int, list[StuckBurn]] = {}
        self._ended: list[tuple[StuckBurn, float]] = []
        """Those that are over, and what was left in the tank then, kg."""

    def begin(self, failure: int, vehicles: Sequence[int], given: StuckThruster) -> None:
        """
        Let thrusters be stuck open.

        Raises:
            ActionRefused: One has no thrust, is stuck already, or has no body axes; or nothing changes truth here.
        """
        if not self._context.parameters.propagator.can_maneuver:
            raise ActionRefused(
                "the scenario's propagator starts from no other states than its own"
            )
        pushes = {vehicle: self._push(vehicle, given) for vehicle in vehicles}
        if not self._burns and not self._ended:  # nothing has burnt yet, not even until just now
            self._context.open_stream(STREAM, STUCK_THRUSTERS)
        now_s = self._context.now_s()
        begins_s = now_s + self._lead_s
        burns = [self._stuck.open(vehicle, push, begins_s) for vehicle, push in pushes.items()]
        self._by_failure[failure] = burns
        for burn in burns:
            self._extend(burn, now_s)
            self._burns.append((burn, burn.begins_s))
            self._context.wake(burn.begins_s)

    def end(self, failure: int) -> None:
        """Let the thrusters of a failure close, and work again."""
        ends_s = self._context.now_s() + self._lead_s
        for burn in self._by_failure.pop(failure, []):
            changed_s = self._stuck.close(burn.vehicle, ends_s, "mended")
            self._change(burn, changed_s)
            self._stuck.lift(burn.vehicle)

    def timer(self, t_s: float) -> float | None:
        """Give truth the burns that are due, read gauges, and return when to come back."""
        going_on = []
        for burn, gauge_s in self._burns:
            self._extend(burn, t_s)
            is_over = t_s >= burn.ends_s
            next_s = gauge_s
            if t_s >= gauge_s or is_over:
                self._read_gauge(burn, min(t_s, burn.ends_s))
                next_s = gauge_s + math.floor((t_s - gauge_s) / GAUGE_S + 1.0) * GAUGE_S
            if is_over:
                self._ended.append((burn, self._stuck.propellant_kg(burn, burn.ends_s)))
                self._tell_end(burn)
            else:
                going_on.append((burn, next_s))
        self._burns = going_on
        return min((self._next_s(burn, gauge_s, t_s) for burn, gauge_s in going_on), default=None)

    def finish(self) -> Mapping[str, Any]:
        """Return what each vehicle's thruster burnt while it was stuck; empty if none was."""
        now_s = self._context.now_s()
        summary: dict[str, list[dict[str, Any]]] = {}
        going_on = [(burn, self._stuck.propellant_kg(burn, now_s)) for burn, _ in self._burns]
        for burn, left_kg in (*self._ended, *going_on):
            agent = self._context.agents[burn.vehicle]
            summary.setdefault(agent, []).append(
                {
                    "from_s": burn.begins_s,
                    "to_s": max(burn.begins_s, min(burn.ends_s, now_s)),
                    "ended": burn.state(now_s),
                    "delta_v_m_s": self._stuck.delta_v_m_s(burn, now_s),
                    "propellant_left_kg": left_kg,
                }
            )
        return {"stuck_thrusters": summary} if summary else {}

    def _push(self, vehicle: int, given: StuckThruster) -> StuckDirection:
        agent, described = self._context.agents[vehicle], self._vehicles[vehicle]
        thrust_n = given.thrust_n
        if thrust_n is None and described.thruster is not None:
            thrust_n = described.thruster.thrust_n
        if thrust_n is None:
            raise ActionRefused(
                f"{agent}: give thrust_n: parameters.vehicles.thruster has none, its burns are impulses"
            )
        if given.frame == "body" and described.attitude is None:
            raise ActionRefused(f"{agent}: body axes of a vehicle without attitude")
        if vehicle in self._stuck.burns:
            raise ActionRefused(f"{agent}: its thruster is stuck open already")
        length = math.hypot(*given.direction)
        if not 0.0 < length < math.inf:
            raise ActionRefused(f"expected a direction, got {given.direction}")
        direction = scaled(given.direction, 1.0 / length)
        return StuckDirection(thrust_n=thrust_n, direction=direction, frame=given.frame)

    def _extend(self, burn: StuckBurn, t_s: float) -> None:
        is_body = burn.push.frame == "body"
        turn_rad_s = self._supply.turn_rad_s(burn.vehicle, burn.given_until_s) if is_body else 0.0
        self._change(burn, self._stuck.extend(burn, t_s, turn_rad_s))

    def _change(self, burn: StuckBurn, changed_s: float | None) -> None:
        """Have truth propagated anew from a time on, and sent."""
        if changed_s is None:
            return
        self._refills.judge_anew(burn.vehicle)
        in_parts = not self._context.is_lockstep
        if self._supply.change(burn.vehicle, changed_s, in_parts=in_parts):
            self._refills.changed(burn.vehicle, changed_s, changed_s)

    def _read_gauge(self, burn: StuckBurn, t_s: float) -> None:
        left_kg = self._stuck.propellant_kg(burn, t_s)
        agent = self._context.agents[burn.vehicle]
        gauge = TankGauge(t_s=t_s, propellant_kg=left_kg)
        self._context.send(agent, gauge.to_message(), Service.RELIABLE)
        given_m_s = self._stuck.delta_v_m_s(burn, t_s)
        self._context.record(STREAM, (t_s, agent, burn.state(t_s), given_m_s, left_kg))

    def _tell_end(self, burn: StuckBurn) -> None:
        given_m_s = self._stuck.delta_v_m_s(burn, burn.ends_s)
        self._context.log(
            "info",
            f"{self._context.agents[burn.vehicle]}: its thruster, stuck open, burnt from {burn.begins_s:.3f} s to "
            f"{burn.ends_s:.3f} s, when it was {burn.ends_as}, and gave {given_m_s:.4g} m/s",
        )

    @staticmethod
    def _next_s(burn: StuckBurn, gauge_s: float, t_s: float) -> float:
        """Return when something is due of one: the next arc, its gauge, or its end."""
        times_s = [gauge_s, burn.ends_s]
        if burn.given_until_s < burn.ends_s and burn.given_until_s - AHEAD_S > t_s:
            times_s.append(burn.given_until_s - AHEAD_S)
        return min(times_s)
