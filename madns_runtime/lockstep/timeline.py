"""The timeline of a lockstep run: its actions take place between two ticks, at their simulated time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from madns_runtime.conditions.reports import HostConditions, MetCondition
from madns_runtime.errors import MadnsError
from madns_runtime.hardware.action_socket import ActionSocket, open_action_socket
from madns_runtime.hardware.order_socket import Readers
from madns_runtime.lockstep.host_core import LockstepCore
from madns_runtime.plugin.action_handlers import timeline_runner
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.protocol.messages import ActionOrder
from madns_runtime.timeline.action import ActionHandler
from madns_runtime.timeline.fault_kinds import FAULT_WORDS
from madns_runtime.timeline.kinds import DEVICE_FAULT


class LockstepTimeline:
    """
    Carries out the timeline.

    Args:
        core: Of the host.
        program: What the host's half declares.
        faults: Carries out faults of agents and messages.
    """

    def __init__(self, core: LockstepCore, program: RoleProgram, faults: ActionHandler) -> None:
        self._config = core.config
        self._clock = core.clock
        self._outbox = core.outbox
        self.is_stopped = False
        """Whether the run ends with the tick under way."""
        self.runner, self.kinds = timeline_runner(
            core.config,
            program.actions,
            dict.fromkeys(FAULT_WORDS, faults),
            record=core.journal.event,
            call=core.half.call,
            post=self._post,
            stop=self._stop,
            intended=core.account.intended,
        )
        self._action_socket: ActionSocket | None = None

    def wait_for(self, conditions: HostConditions) -> None:
        """Have the actions begin that wait for conditions."""
        for number in {e.condition for e in self._config.timeline if e.condition is not None}:
            conditions.on_met(number, self._met)

    def accept_orders(self, folder: Path, loop: Readers, say: Callable[[str, str], None]) -> None:
        """Take orders of actions in the run directory from now on; they are carried out before the next tick."""
        self._action_socket = open_action_socket(
            folder,
            loop,
            config=self._config,
            kinds=self.kinds,
            runner=self.runner,
            begin=lambda order: self.runner.order(order, self._clock.t_s),
            say=say,
            is_immediate=False,
        )

    def take_orders(self) -> None:
        """Carry out what was ordered."""
        if self._action_socket is not None:
            self._action_socket.carry_out()

    def close(self) -> None:
        """Take no more orders."""
        if self._action_socket is not None:
            self._action_socket.close()
            self._action_socket = None

    def next_s(self, half_s: float | None) -> tuple[float | None, bool]:
        """Return the time of what comes next, given when the half wants to be called, and whether it is an action."""
        own_s = self.runner.next_s
        if own_s is not None and (half_s is None or own_s <= half_s):
            return own_s, True
        return half_s, False

    def run_due(self) -> None:
        """Do what is due by now."""
        self.runner.run_due(self._clock.t_s)

    def _met(self, met: MetCondition) -> None:
        self.runner.met(met.condition.number, met.t_s, self._clock.t_s)

    def _stop(self) -> None:
        self.is_stopped = True
        self.runner.close()

    def _post(self, agent: str, order: ActionOrder) -> bool:
        if order.word == DEVICE_FAULT.word:
            # Of the present, at its end as well: between two ticks it cuts samples.
            order = dataclasses.replace(order, t_s=self._clock.t_s)
        try:
            return self._outbox.post(agent, order)
        except MadnsError:  # it takes nothing more before simulated time goes on
            return False
