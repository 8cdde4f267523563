"""The process of some of a machine's agents: their loop, which ends with its supervisor."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence

from madns_runtime.agent_runner import AgentRunner, Outcome
from madns_runtime.config import AgentLaunch
from madns_runtime.half import Program
from madns_runtime.reactor.lines import OPERATOR_SIDE_GONE
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.watchdog import end_after_hang_up

HANG_GRACE_S = 2.0
"""Beyond the time for shutdown: an agent that hangs in its plug-in ends itself, and leaves its stack."""


class AgentProcess:
    """
    The agents of one process in their loop.

    Args:
        launch: The run.
        agents: Names of this process's agents.
        program: What they run.
        life_fd: Closes when the supervisor is gone.
    """

    def __init__(
        self, launch: AgentLaunch, agents: Sequence[str], program: Program, *, life_fd: int
    ) -> None:
        self._reactor = Reactor()
        self._supervisor_pid = os.getppid()
        self._launch = launch
        self._agents = agents
        self._program = program
        self._life_fd = life_fd
        self._runners: dict[str, AgentRunner] = {}
        self._outcomes: dict[str, Outcome] = {}

    def run(self) -> dict[str, Outcome]:
        """Run every agent to its end, and return how each ended."""
        reactor = self._reactor
        reactor.on_signal(signal.SIGTERM, lambda: self._end("SIGTERM"))
        reactor.on_signal(signal.SIGINT, lambda: None)
        reactor.add_reader(self._life_fd, self._life_ended)
        end_after_hang_up(self._life_fd, self._launch.config.timeouts.shutdown_s + HANG_GRACE_S)
        runners = [self._make_runner(name) for name in self._agents]
        for runner in runners:
            runner.start()
        # The recorders' threads run already and keep the normal policy; only the loop is raised.
        grant = apply_scheduling(self._launch.config.scheduling, is_host=False).to_mapping()
        for runner in runners:
            runner.set_scheduling(grant)
        reactor.run()
        reactor.close()
        return self._outcomes

    def _make_runner(self, name: str) -> AgentRunner:
        runner = AgentRunner(
            name, self._launch, self._program, reactor=self._reactor, on_ended=self._ended
        )
        self._runners[name] = runner
        return runner

    def _life_ended(self) -> None:
        self._reactor.remove_reader(self._life_fd)
        if os.read(self._life_fd, 1):
            self._end(OPERATOR_SIDE_GONE)
        else:
            self._end(f"its supervisor (pid {self._supervisor_pid}) is gone")

    def _end(self, reason: str) -> None:
        for runner in list(self._runners.values()):
            runner.emergency(reason)

    def _ended(self, name: str, outcome: Outcome) -> None:
        del self._runners[name]
        self._outcomes[name] = outcome
        if not self._runners:
            self._reactor.stop()
