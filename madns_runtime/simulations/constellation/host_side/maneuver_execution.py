"""
Carries commands out: from a vehicle's message to truth that holds it, and what its flight software is told.

What is due soon is propagated at once, in the loop; what has time is propagated by the executor, so that a
whole constellation that commands at once does not stop the loop. A job that is not back in time is overtaken.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from madns_runtime.plugin.api import HostContext
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.equipment import Vehicle
from madns_runtime.simulations.constellation.host_side.stuck_burns import StuckBurns
from madns_runtime.simulations.constellation.host_side.truth_distribution import Refills
from madns_runtime.simulations.constellation.host_side.truth_propagation import TruthSupply
from madns_runtime.simulations.constellation.messages import LEAD_TICKS, Command
from madns_runtime.simulations.constellation.streams import MANEUVERS
from madns_runtime.simulations.constellation.truth.maneuvers.account import Times
from madns_runtime.simulations.constellation.truth.maneuvers.rules import (
    ManeuverDesk,
    Taken,
)

URGENT_S = 0.5
"""Lead of a command below which it is propagated before anything else is done."""
OVERTAKEN_S = 0.25
"""Lead of a command below which it is propagated in the loop, if the executor has not done it."""


class Maneuvering:
    """
    All vehicles' commands.

    Args:
        context: Through which results are sent.
        supply: Whose truth is changed.
        refills: Who sends it.
        desk: Who decides.
        vehicles: What they are like.
    """

    def __init__(
        self,
        context: HostContext,
        supply: TruthSupply,
        refills: Refills,
        *,
        desk: ManeuverDesk,
        vehicles: Sequence[Vehicle],
    ) -> None:
        self._context = context
        self._supply = supply
        self._refills = refills
        self._desk = desk
        self.failures = desk.failures
        """Of the vehicles' actuators."""
        self.stuck = StuckBurns(context, supply, refills, stuck=desk.stuck, vehicles=vehicles)
        """Thrusters that are stuck open."""
        self._waiting: list[tuple[float, int, Taken]] = []
        """Time at which each job is overtaken, and the job; also of those that are done."""
        self._pending: list[tuple[float, int, Taken]] = []
        self._count = 0
        # Of a rerun: its agents hold the results until the ticks on record.
        is_rerun = context.parameters.recorded_agents is not None
        self._lead_s = LEAD_TICKS / context.tick_hz if is_rerun else 0.0
        context.open_stream("maneuvers", MANEUVERS)

    def receive(self, vehicle: int, command: Command) -> None:
        """Take a command: decide about it, and carry it out."""
        taken = self._desk.decide(vehicle, command, self._context.now_s())
        if taken.effect is None:
            # Of those that are refused only the late ones have to do with the inequality.
            self._record(taken, self._desk.measure(taken, None) if taken.is_late else None)
            self._tell(taken)
            return
        self._carry_out(taken, is_urgent=self._context.is_lockstep)

    def timer(self, t_s: float) -> float | None:
        """Overtake jobs that are late, report what is over, and return when to come back."""
        while self._waiting and self._waiting[0][0] <= t_s:
            _, job, late = heapq.heappop(self._waiting)
            if self._supply.jobs.give_up(job):
                self._carry_out(late, is_urgent=True)
        while self._pending and self._pending[0][0] <= t_s:
            taken = heapq.heappop(self._pending)[2]
            self._tell(self._desk.execute(taken), is_over=True)
        times_s = [heap[0][0] for heap in (self._waiting, self._pending) if heap]
        for next_s in (self.stuck.timer(t_s), self._supply.remainders.timer(t_s)):
            if next_s is not None:
                times_s.append(next_s)
        return min(times_s, default=None)

    def finish(self) -> Mapping[str, Any]:
        """Return the account of all commands."""
        account = self._desk.account
        return {
            "commanded": account.commanded,
            "executed": account.executed,
            "postponed": account.postponed,
            "refused": account.refused,
            "waiting": self._desk.waiting,
            "inequality_broken": account.inequality_broken,
            "inequality_broken_agent": self._most_broken(),
            "propagated_anew": self._supply.propagated_anew,
            "delta_v_m_s": account.delta_v_m_s,
            "propellant_kg": account.propellant_kg,
            "slack_s_min": account.slack_s_min if math.isfinite(account.slack_s_min) else None,
            "propagation_s_max": account.propagation_s_max,
            "network_s_max": account.network_s_max,
            **self.stuck.finish(),
        }

    def _most_broken(self) -> str | None:
        """Return the agent whose commands broke the inequality most often; None if none did."""
        most = self._desk.account.inequality_broken_by.most_common(1)
        return self._context.agents[most[0][0]] if most else None

    def _carry_out(self, taken: Taken, *, is_urgent: bool) -> None:
        """Have truth changed by the executor, or here and now if time is short, and tell flight software then."""
        vehicle, start_s = taken.vehicle, self._changed_from(taken)
        due_s = start_s + taken.command.phase_s
        if is_urgent or due_s - self._context.now_s() < URGENT_S:
            # In lockstep nobody waits: there truth comes in one, and to the same digits as ever.
            in_parts = not self._context.is_lockstep
            is_changed = self._supply.change(vehicle, start_s, in_parts=in_parts)
            self._announce(taken, is_changed=is_changed)
            return
        job = self._supply.change_by_job(vehicle, start_s, partial(self._came, taken))
        if job is None:
            self._announce(taken, is_changed=False)
        else:
            heapq.heappush(self._waiting, (due_s - OVERTAKEN_S, job, taken))
            self._context.wake(due_s - OVERTAKEN_S)

    def _changed_from(self, taken: Taken) -> float:
        """Return from when truth is another one by a command that was taken."""
        assert taken.effect is not None
        allowed = self._context.parameters.maneuvers
        ready_s = taken.heard_s + allowed.propagation_s + allowed.network_s - taken.command.phase_s
        return self._supply.store.timelines[taken.vehicle].changed_from(taken.effect, ready_s)

    def _came(self, taken: Taken, is_current: bool) -> None:
        """Take that the executor is done with a command."""
        if is_current:
            self._announce(taken, is_changed=True)
        else:
            self._carry_out(taken, is_urgent=False)

    def _announce(self, taken: Taken, *, is_changed: bool) -> None:
        """
        Send truth that a command has changed, record the command and tell flight software.

        Truth that is not changed yet holds the command as soon as it is known so far.
        """
        assert taken.effect is not None
        vehicle, start_s, phase_s = taken.vehicle, self._changed_from(taken), taken.command.phase_s
        if is_changed:
            if taken.effect.kind in ("impulse", "thrust"):
                # It may be flown before a burn by whose end energy is compared already.
                self._refills.judge_anew(vehicle)
            self._refills.changed(vehicle, start_s, start_s + phase_s)
        self._record(taken, self._desk.measure(taken, self._context.now_s()))
        self._tell(taken)
        over_s = taken.effect.end_s + phase_s - self._lead_s
        self._count += 1
        heapq.heappush(self._pending, (over_s, self._count, taken))
        self._context.wake(over_s)

    def _tell(self, taken: Taken, *, is_over: bool = False) -> None:
        result = taken.result(self._supply.store.revisions[taken.vehicle], is_over=is_over)
        agent = self._context.agents[taken.vehicle]
        self._context.send(agent, result.to_message(), Service.RELIABLE)

    def _record(self, taken: Taken, times: Times | None) -> None:
        command = taken.command
        is_burn = command.kind == "delta_v"
        self._context.record(
            "maneuvers",
            (
                command.commanded_s,
                self._context.agents[taken.vehicle],
                command.number,
                command.kind,
                taken.status,
                taken.heard_s,
                command.at_s,
                taken.at_s if taken.effect is not None else None,
                math.hypot(*command.vector) if is_burn else 0.0,
                taken.delta_v_m_s,
                None if times is None else times.propagation_s,
                None if times is None else times.network_s,
                None if times is None else times.slack_s,
                taken.propellant_kg,
                taken.reason,
            ),
        )
