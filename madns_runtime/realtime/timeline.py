"""The timeline of a run in real time: its actions take place at the host when their simulated time has come."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from madns_runtime.conditions.reports import HostConditions, MetCondition
from madns_runtime.errors import MadnsError
from madns_runtime.hardware.action_socket import ActionSocket, open_action_socket
from madns_runtime.plugin.action_handlers import AgentOrders, timeline_runner
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.protocol.messages import ActionOrder, Service
from madns_runtime.protocol.states import HostState
from madns_runtime.realtime.host_core import RealtimeCore
from madns_runtime.realtime.host_faults import HostFaults
from madns_runtime.realtime.host_result import HostReport
from madns_runtime.timeline.fault_kinds import FAULT_WORDS
from madns_runtime.timeline.kinds import DRIFT_CLOCK, STEP_CLOCK, STOP, STRESS
from madns_runtime.timeline.runner import OrderedAction

STOP_LEAD_S: Final = 0.25
"""Every agent hears of a stop before its last tick, and all run the same ticks."""


class HostTimeline:
    """
    Carries out the timeline.

    Args:
        core: Of the host.
        program: What the host's half declares.
        report: Of the run; a stop shortens its duration.
        conditions: Tell when one is met that actions wait for.
    """

    def __init__(
        self,
        core: RealtimeCore,
        program: RoleProgram,
        report: HostReport,
        conditions: HostConditions,
    ) -> None:
        self._config = config = core.launch.config
        self._port = core.port
        self._report = report
        self._conditions = conditions
        conditions.end_s = config.time.duration_s
        self._pump = core.pump
        self._reactor = core.reactor
        self.faults = HostFaults(core)
        self._action_socket: ActionSocket | None = None
        self._end_s: float | None = None
        """Simulated time at which a stop ends the run, s; None without one."""
        self._early: list[MetCondition] = []
        """Met before simulated time zero, as in set-up: what waits for them takes place then."""
        of_agents = (STRESS.word, STEP_CLOCK.word, DRIFT_CLOCK.word)
        self.runner, self.kinds = timeline_runner(
            config,
            program.actions,
            {
                **dict.fromkeys(FAULT_WORDS, self.faults),
                **dict.fromkeys(of_agents, AgentOrders(self._post)),
            },
            record=core.journal.event,
            call=partial(core.guard, core.half.call),
            post=self._post,
            stop=self._stop,
            intended=self.faults.intended,
        )
        # Infinite is never: the timer is made once and moved.
        self._timer = core.reactor.call_at(math.inf, self._due)
        for number in {e.condition for e in config.timeline if e.condition is not None}:
            conditions.on_met(number, self._met)

    def begin(self, folder: Path, say: Callable[[str, str], None]) -> None:
        """Simulated time zero is set: wait for what is due, and for orders in the run directory."""
        self._arm()
        self._action_socket = open_action_socket(
            folder,
            self._reactor,
            config=self._config,
            kinds=self.kinds,
            runner=self.runner,
            begin=self._order,
            say=say,
        )

    def resume(self, agent: str) -> None:
        """Let what is in force go on at an agent that has returned: a stop that it has not heard of, too."""
        if self._end_s is not None:
            self._post_stop(agent, self._end_s)
        self.runner.resume(agent)

    def close(self) -> None:
        """Take no more orders."""
        if self._action_socket is not None:
            self._action_socket.close()
            self._action_socket = None

    def _order(self, order: OrderedAction) -> str:
        if not self._port.is_in(HostState.SIMULATION_START) or self._port.now_s() < 0.0:
            return "simulated time does not run at present"
        if self._is_over():
            return "the run is ending"
        refusal = self.runner.order(order, self._port.now_s())
        self._arm()
        self._pump()
        return refusal

    def _arm(self) -> None:
        next_s = 0.0 if self._early else self.runner.next_s
        self._timer.reschedule(self._port.due_s(next_s, end_s=self._report.duration_s))

    def _due(self) -> None:
        if self._port.is_in(HostState.SIMULATION_START):
            now_s = self._port.now_s()
            early, self._early = self._early, []
            for met in early:
                self.runner.met(met.condition.number, met.t_s, now_s)
            # As in lockstep: behind the end, while agents make their summaries, nothing takes place.
            self.runner.run_due(now_s, until_s=self._report.duration_s)
            self._arm()
            self._pump()

    def _met(self, met: MetCondition) -> None:
        if self._port.t0_s is None or self._port.now_s() < 0.0:
            self._early.append(met)
        elif self._port.is_in(HostState.SIMULATION_START) and not self._is_over():
            self.runner.met(met.condition.number, met.t_s, self._port.now_s())
        self._arm()

    def _is_over(self) -> bool:
        """Tell whether agents make their summaries: nothing takes place any more."""
        return self._port.now_s() > self._report.duration_s

    def _stop(self) -> None:
        tick_hz, now_s = self._config.agents.tick_hz, self._port.now_s()
        end_s = math.ceil((max(now_s, 0.0) + STOP_LEAD_S) * tick_hz) / tick_hz
        self.runner.close()  # nothing more takes place, though the run's own end may be nearer
        if end_s >= self._report.duration_s:
            return
        self._report.duration_s = self._end_s = self._conditions.end_s = end_s
        self.faults.end_at(end_s)
        for agent in self._config.agents.resolved_names():
            self._post_stop(agent, end_s)
        t0_s = self._port.t0_s
        assert t0_s is not None, "actions begin once simulated time runs"
        self._port.session.end_at(t0_s + end_s)

    def _post_stop(self, agent: str, end_s: float) -> None:
        self._post(agent, ActionOrder(-1, STOP.word, {}, end_s, None, is_end=False))

    def _post(self, agent: str, order: ActionOrder) -> bool:
        if self.faults.intended.is_coming(agent):  # it is being killed, and would not hear it
            return False
        try:
            self._port.must_pump = True
            # In the stream of faults: what was ordered before its agent was killed comes before that.
            return self._port.session.send(agent, order, Service.SYNC, self._port.monotonic_s())
        except MadnsError:  # it takes nothing
            return False
