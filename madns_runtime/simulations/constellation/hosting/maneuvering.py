"""
Carries commands out: from a vehicle's message to truth that holds it, and what its flight software is told.

What is due soon is propagated at once; what has time waits for its turn, one vehicle a call of the timer,
so that a whole constellation that commands at once does not stop the loop.
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

URGENT_S = 0.5
"""What is to be executed within this is propagated before anything else is done."""
TURN_S = 0.001
"""Between two vehicles that wait for their turn."""

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
is T_p, network_s T_n, slack_s (T_m - T_s) - (T_p + 2 T_n)."""


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
        self._turns: list[tuple[float, int, Taken]] = []
        self._pending: list[tuple[float, int, Taken]] = []
        self._count = 0
        context.open_stream("maneuvers", MANEUVERS)

    def receive(self, vehicle: int, command: Command) -> None:
        """Take a command: decide about it, and carry it out now or in its turn."""
        now_s = self._context.now_s()
        taken = self._desk.decide(vehicle, command, now_s)
        if taken.effect is None:
            self._record(taken, None)
            self._tell(vehicle, taken.result(self._supply.store.revisions[vehicle]))
            return
        start_s = taken.effect.start_s + command.phase_s
        if self._context.is_lockstep or start_s - now_s < URGENT_S:
            self._carry_out(taken)
        else:
            self._push(self._turns, start_s, taken)
            self._context.wake(now_s + TURN_S)

    def timer(self, t_s: float) -> float | None:
        """Carry out the next that waits, report what is over, and return when to come back."""
        while self._pending and self._pending[0][0] <= t_s:
            taken = heapq.heappop(self._pending)[2]
            self._desk.execute(taken)
            revision = self._supply.store.revisions[taken.vehicle]
            self._tell(taken.vehicle, taken.executed(revision))
        if self._turns:
            self._carry_out(heapq.heappop(self._turns)[2])
        if self._turns:
            return t_s + TURN_S
        return self._pending[0][0] if self._pending else None

    def finish(self) -> Mapping[str, Any]:
        """Return the account of all commands: numbers only."""
        account = self._desk.account
        return {
            "commanded": account.commanded,
            "executed": account.executed,
            "postponed": account.postponed,
            "refused": account.refused,
            "inequality_broken": account.inequality_broken,
            "propagated_anew": self._supply.propagated_anew,
            "delta_v_m_s": account.delta_v_m_s,
            "propellant_kg": account.propellant_kg,
            "slack_s_min": account.slack_s_min if math.isfinite(account.slack_s_min) else None,
            "propagation_s_max": account.propagation_s_max,
            "network_s_max": account.network_s_max,
        }

    def _carry_out(self, taken: Taken) -> None:
        """Change truth, send it, and tell flight software."""
        effect, vehicle = taken.effect, taken.vehicle
        assert effect is not None
        phase_s = taken.command.phase_s
        if self._supply.change(vehicle, effect.start_s):
            self._refills.changed(vehicle, effect.start_s, effect.start_s + phase_s)
        self._record(taken, self._desk.measure(taken, self._context.now_s()))
        self._tell(vehicle, taken.result(self._supply.store.revisions[vehicle]))
        over_s = effect.end_s + phase_s
        self._push(self._pending, over_s, taken)
        self._context.wake(over_s)

    def _push(self, heap: list[tuple[float, int, Taken]], t_s: float, taken: Taken) -> None:
        self._count += 1
        heapq.heappush(heap, (t_s, self._count, taken))

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
