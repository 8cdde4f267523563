"""
Carries commands out: from a vehicle's message to truth that holds it, and what its flight software is told.

What is due soon is propagated at once, in the loop; what has time is propagated by the executor, so that a
whole constellation that commands at once does not stop the loop. A job that is not back in time is overtaken.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping
from typing import Any

from madns_runtime.plugin.api import HostContext
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field
from madns_runtime.simulations.constellation.hosting.refills import Refills
from madns_runtime.simulations.constellation.hosting.supply import TruthSupply
from madns_runtime.simulations.constellation.messages import Command, CommandResult
from madns_runtime.simulations.constellation.truth.maneuvers import ManeuverDesk, Taken, Times
from madns_runtime.simulations.constellation.truth.pieces import VehicleTruth

URGENT_S = 0.5
"""What is to be executed within this is propagated before anything else is done."""
OVERTAKEN_S = 0.25
"""What the executor has not made by so long before its time is made in the loop."""

MANEUVERS = (
    Field("commanded_s", "s"),
    Field("agent", "", "str"),
    Field("number", "", "int"),
    Field("kind", "", "str"),
    Field("status", "", "str"),
    Field("heard_s", "s"),
    Field("at_s", "s"),
    Field("executed_s", "s"),
    Field("dv_commanded_m_s", "m/s"),
    Field("dv_given_m_s", "m/s"),
    Field("propagation_s", "s"),
    Field("network_s", "s"),
    Field("slack_s", "s"),
    Field("propellant_kg", "kg"),
    Field("reason", "", "str"),
)
"""One record a command: at_s is T_m as commanded, executed_s as it became (none if refused); propagation_s
is T_p, network_s T_n, slack_s (T_m - T_s) - (T_p + 2 T_n), for a finite burn with its beginning for T_m."""


class Maneuvering:
    """
    All vehicles' commands.

    Args:
        context: Through which results are sent.
        supply: Whose truth is changed.
        refills: Who sends it.
        desk: Who decides.
    """

    def __init__(
        self, context: HostContext, supply: TruthSupply, refills: Refills, desk: ManeuverDesk
    ) -> None:
        self._context = context
        self._supply = supply
        self._refills = refills
        self._desk = desk
        self._jobs: dict[int, Taken] = {}
        self._overtaken: set[int] = set()
        self._waiting: list[tuple[float, int]] = []
        """When each job is overtaken, and which; also of those that are done."""
        self._pending: list[tuple[float, int, Taken]] = []
        self._count = 0
        context.open_stream("maneuvers", MANEUVERS)

    def receive(self, vehicle: int, command: Command) -> None:
        """Take a command: decide about it, and carry it out."""
        now_s = self._context.now_s()
        taken = self._desk.decide(vehicle, command, now_s)
        if taken.effect is None:
            # Of those that are refused only the late ones have to do with the inequality.
            self._record(taken, self._desk.measure(taken, None) if taken.is_late else None)
            self._tell(vehicle, taken.result(self._supply.store.revisions[vehicle]))
            return
        if self._context.is_lockstep:
            self._carry_out(taken)
        else:
            self._make(taken, now_s)

    def result(self, job: int, value: list[VehicleTruth]) -> bool:
        """Take a job's value; False if it is none of these."""
        if job in self._overtaken:
            self._overtaken.remove(job)
            return True
        taken = self._jobs.pop(job, None)
        if taken is None or taken.effect is None:
            return False
        if self._supply.take_change(job, taken.vehicle, value[0]):
            self._hand_out(taken.vehicle, taken.effect.start_s, taken.command.phase_s)
            self._announce(taken)
        else:
            self._make(taken, self._context.now_s())
        return True

    def timer(self, t_s: float) -> float | None:
        """Overtake jobs that are late, report what is over, and return when to come back."""
        while self._waiting and self._waiting[0][0] <= t_s:
            _, job = heapq.heappop(self._waiting)
            if (late := self._jobs.pop(job, None)) is not None:
                self._overtaken.add(job)
                self._supply.forget_job(job)
                self._carry_out(late)
        while self._pending and self._pending[0][0] <= t_s:
            taken = heapq.heappop(self._pending)[2]
            self._desk.execute(taken)
            revision = self._supply.store.revisions[taken.vehicle]
            self._tell(taken.vehicle, taken.executed(revision))
        times_s = [heap[0][0] for heap in (self._waiting, self._pending) if heap]
        return min(times_s, default=None)

    def finish(self) -> Mapping[str, Any]:
        """Return the account of all commands: numbers only."""
        account = self._desk.account
        return {
            "commanded": account.commanded,
            "executed": account.executed,
            "postponed": account.postponed,
            "refused": account.refused,
            "waiting": self._desk.waiting,
            "inequality_broken": account.inequality_broken,
            "propagated_anew": self._supply.propagated_anew,
            "delta_v_m_s": account.delta_v_m_s,
            "propellant_kg": account.propellant_kg,
            "slack_s_min": account.slack_s_min if math.isfinite(account.slack_s_min) else None,
            "propagation_s_max": account.propagation_s_max,
            "network_s_max": account.network_s_max,
        }

    def _make(self, taken: Taken, now_s: float) -> None:
        """Have truth changed by the executor, or here if time is short."""
        assert taken.effect is not None
        start_s = taken.effect.start_s
        due_s = start_s + taken.command.phase_s
        if due_s - now_s < URGENT_S:
            self._carry_out(taken)
        elif (job := self._supply.change_by_job(taken.vehicle, start_s)) is None:
            self._announce(taken)
        else:
            self._jobs[job] = taken
            heapq.heappush(self._waiting, (due_s - OVERTAKEN_S, job))
            self._context.wake(due_s - OVERTAKEN_S)

    def _carry_out(self, taken: Taken) -> None:
        """Change truth here and now, send it, and tell flight software."""
        assert taken.effect is not None
        start_s = taken.effect.start_s
        if self._supply.change(taken.vehicle, start_s):
            self._hand_out(taken.vehicle, start_s, taken.command.phase_s)
        self._announce(taken)

    def _hand_out(self, vehicle: int, start_s: float, phase_s: float) -> None:
        self._refills.changed(vehicle, start_s, start_s + phase_s)

    def _announce(self, taken: Taken) -> None:
        """Record a command that truth holds, or will as soon as it is known so far, and tell flight software."""
        assert taken.effect is not None
        self._record(taken, self._desk.measure(taken, self._context.now_s()))
        revision = self._supply.store.revisions[taken.vehicle]
        self._tell(taken.vehicle, taken.result(revision))
        over_s = taken.effect.end_s + taken.command.phase_s
        self._count += 1
        heapq.heappush(self._pending, (over_s, self._count, taken))
        self._context.wake(over_s)

    def _tell(self, vehicle: int, result: CommandResult) -> None:
        self._context.send(self._context.agents[vehicle], result.to_message(), Service.RELIABLE)

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
