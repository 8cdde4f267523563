"""The process of some of a machine's agents: their loop, which ends with its supervisor."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence

from madns_runtime.config import AgentLaunch
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.reactor.operator_link import OPERATOR_SIDE_GONE
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.realtime.agent import AgentOutcome, AgentRunner
from madns_runtime.realtime.agent_calls import LoopSeat
from madns_runtime.realtime.packs import Pack, phase_of, split_into_packs
from madns_runtime.realtime.process_port import ProcessPort

HANG_GRACE_S = 2.0
"""Beyond the time for shutdown: an agent that hangs in its plug-in ends itself, and leaves its stack."""


class AgentProcess:
    """
    The agents of one process in their loop.

    Args:
        launch: The run.
        seats: This process's agents.
        program: What they run.
        life_fd: Closes when the supervisor is gone.
    """

    def __init__(
        self,
        launch: AgentLaunch,
        seats: Sequence[LoopSeat],
        program: RoleProgram,
        *,
        life_fd: int,
    ) -> None:
        self._reactor = Reactor()
        self._supervisor_pid = os.getppid()
        self._launch = launch
        self._seats = seats
        self._program = program
        self._life_fd = life_fd
        self._runners: dict[str, AgentRunner] = {}
        self._outcomes: dict[str, AgentOutcome] = {}

    def run(self) -> dict[str, AgentOutcome]:
        """Run every agent to its end, and return how each ended."""
        reactor = self._reactor
        reactor.on_signal(signal.SIGTERM, lambda: self._end("SIGTERM"))
        reactor.on_signal(signal.SIGINT, lambda: None)
        reactor.add_reader(self._life_fd, self._life_ended)
        end_after_hang_up(self._life_fd, self._launch.config.timeouts.shutdown_s + HANG_GRACE_S)
        runners = self._make_runners()
        self._runners = {runner.name: runner for runner in runners}
        for runner in runners:
            runner.start()
        # The recorders' threads run already and keep the normal policy; only the loop is raised.
        grant = apply_scheduling(self._launch.config.scheduling, is_host=False).to_mapping()
        for runner in runners:
            runner.set_scheduling(grant)
        reactor.run()
        reactor.close()
        return self._outcomes

    def _make_runners(self) -> list[AgentRunner]:
        seats = {seat.name: seat for seat in self._seats}
        process = ProcessPort(self._launch, self._reactor, len(seats))
        runners = []
        for number, names in enumerate(split_into_packs(list(seats))):
            phase_s = phase_of(number, names, self._launch.config.agents)
            pack = Pack(phase_s, reactor=self._reactor, process=process)
            for name in names:
                runner = AgentRunner(
                    seats[name],
                    self._launch,
                    self._program,
                    reactor=self._reactor,
                    process=process,
                    pack=pack,
                    on_ended=self._ended,
                )
                runners.append(runner)
        return runners

    def _life_ended(self) -> None:
        self._reactor.remove_reader(self._life_fd)
        if os.read(self._life_fd, 1):
            self._end(OPERATOR_SIDE_GONE)
        else:
            self._end(f"its supervisor (pid {self._supervisor_pid}) is gone")

    def _end(self, reason: str) -> None:
        for runner in list(self._runners.values()):
            runner.emergency(reason)

    def _ended(self, name: str, outcome: AgentOutcome) -> None:
        del self._runners[name]
        self._outcomes[name] = outcome
        if not self._runners:
            self._reactor.stop()
