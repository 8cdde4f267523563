"""Starts, ends and further starts of the agents that supervisors run. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from cosmos_cli.launch.request import LaunchRequest, SupervisorStart


class Restarts:
    """
    The processes of the agents that supervisors run.

    Args:
        request: The run.
    """

    def __init__(self, request: LaunchRequest) -> None:
        self._machines: Mapping[str, tuple[str, ...]] = request.machines
        self._manual = frozenset(request.manual)
        config = request.config
        self._restarts_max = config.agents.restarts_max if config.on_agent_loss == "continue" else 0
        self._incarnations: dict[str, int] = {}
        self._killed: dict[str, int] = {}
        """How many of them a fault has ended on purpose: no failures."""
        self._done: set[str] = set()
        self._machine_incarnations: dict[str, int] = {}
        self.ended: set[str] = set()
        """Agents whose process has ended, and that were not started again."""

    def supervised_on(self, machine: str) -> tuple[str, ...]:
        """Return a machine's agents, without those that are started by hand."""
        return tuple(name for name in self._machines.get(machine, ()) if name not in self._manual)

    def started(self, agent: str, incarnation: int) -> None:
        """Note a new process of an agent."""
        self.ended.discard(agent)
        self._incarnations[agent] = max(incarnation, self._incarnations.get(agent, 0))

    def exited(self, agent: str, *, is_abnormal: bool) -> None:
        """Note the end of an agent's process."""
        self.ended.add(agent)
        if not is_abnormal:
            self._done.add(agent)

    def killed(self, agent: str, *, will_return: bool) -> None:
        """Note that a fault has ended an agent's process on purpose."""
        self._killed[agent] = self._killed.get(agent, 0) + 1
        self.exited(agent, is_abnormal=will_return)

    def handed_over(self, agents: Iterable[str]) -> None:
        """Note agents that a new supervisor is to start: if it ends before, they are left."""
        self.ended.difference_update(agents)

    def left_on(self, machine: str) -> tuple[str, ...]:
        """Return a machine's agents of whose end nobody has heard."""
        return tuple(sorted(set(self.supervised_on(machine)) - self.ended))

    def restartable_on(self, machine: str) -> tuple[str, ...]:
        """Return a machine's agents that were cut off and may be started once more."""
        if self._machine_incarnations.get(machine, 1) > self._restarts_max:
            return ()  # also a machine on which nothing starts any more has an end
        return tuple(
            agent
            for agent in self.supervised_on(machine)
            if agent not in self._done
            and self._count(agent) - self._killed.get(agent, 0) <= self._restarts_max
        )

    def next_start_on(self, machine: str) -> SupervisorStart:
        """Return what a new supervisor of a machine is told of those before it."""
        incarnation = self._machine_incarnations.get(machine, 1) + 1
        self._machine_incarnations[machine] = incarnation
        agents = self.supervised_on(machine)
        return SupervisorStart(
            incarnation=incarnation,
            first_incarnations={agent: self._count(agent) + 1 for agent in agents},
            killed_before={agent: self._killed[agent] for agent in agents if agent in self._killed},
        )

    def _count(self, agent: str) -> int:
        return self._incarnations.get(agent, 0)
