"""Agents that a lockstep run goes on without: whose loss is told, and who returns when."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Callable, Iterable
from typing import Final

from madns_runtime.lockstep import frames
from madns_runtime.lockstep.host_core import LockstepCore
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import AgentFault
from madns_runtime.timing.rate import TIME_EPSILON_S, has_tick_from

RESTART_DELAY_S: Final = 0.2
"""Simulated time from the loss of an agent that agents.restarts_max gives another start to its return."""


def _nobody_waits(agent: str) -> None:
    """Do nothing."""


def _nobody_heeds() -> None:
    """Do nothing."""


class Absences:
    """
    The agents that are away.

    Args:
        core: Of the host.
        log: Takes level and text.
    """

    def __init__(self, core: LockstepCore, log: Callable[[str, str], None]) -> None:
        config = core.config
        self._restarts_max = config.agents.restarts_max
        self._tick_hz = config.agents.tick_hz
        self._duration_s = config.time.duration_s
        self._goes_on = config.on_agent_loss == "continue"
        self._account = core.account
        self._pool = core.pool
        self._barrier = core.barrier
        self._outbox = core.outbox
        self._half = core.half
        self._journal = core.journal
        self._clock = core.clock
        self._log = log
        self._returns: list[tuple[float, int]] = []
        """Simulated time, s, and agent, by index: a heap."""
        self.resume: Callable[[str], None] = _nobody_waits
        """Told of an agent that has returned, when its half and the host's know of it."""
        self.heed: Callable[[], None] = _nobody_heeds
        """Hears what agents told as a fault of theirs began or ended."""

    def begin(self) -> None:
        """Go on without who is lost from now on, if the run is to."""
        self._barrier.goes_on = self._goes_on

    # Losses ---------------------------------------------------------------------------------------

    def take(self) -> None:
        """
        Tell of all that were lost in what the workers were told last, in the order of agents.

        Raises:
            RunEnds: Nobody is left, or the half raised.
        """
        account = self._account
        if account.just_lost:
            lost, account.just_lost = sorted(account.just_lost), []
            for number in lost:
                self._lost(number)
            self._end_without_agents()

    def _lost(self, number: int) -> None:
        name, agent = self._account.names[number], self._account.agents[number]
        reason, intended = agent.reason or "", self._account.intended
        self._outbox.lose(number)
        told = {"agent": name, "state": "lost", "incarnation": agent.incarnations}
        if intended.take(name, agent.incarnations) is not None:
            returns_s = intended.returns_s(name)
            if returns_s is not None:
                heapq.heappush(self._returns, (returns_s, number))
            self._journal.event("agent", **told, reason=reason, is_intended=True)
            self._log("warning", f"{name} is lost on purpose: {reason}")
        else:
            self._account.lost[name] = reason
            if agent.incarnations - len(intended.incarnations(name)) <= self._restarts_max:
                returns_s = self._clock.t_s + RESTART_DELAY_S
                heapq.heappush(self._returns, (returns_s, number))
            self._journal.event("agent", **told, reason=reason)
            self._log("error", f"{name} is lost: {reason}")
        self._half.call("agent_lost", name, reason)

    def _end_without_agents(self) -> None:
        """End a run of which no agent is left, nor returns before it is over."""
        agents = self._account.agents
        is_waiting = any(self.has_tick_from(due_s) for due_s, _ in self._returns)
        if all(agent.is_lost for agent in agents) and (self._pool.have_all_ended or not is_waiting):
            names = self._account.names
            reasons = dict.fromkeys(agent.reason or "" for agent in agents)
            self._barrier.fail(", ".join(names), "; ".join(reasons))

    # Returns --------------------------------------------------------------------------------------

    def has_tick_from(self, t_s: float) -> bool:
        """Tell whether a tick is left for an agent that returns at simulated time *t_s*, s."""
        return has_tick_from(t_s, self._duration_s, self._tick_hz)

    def bring_back(self, number: int, settle: Callable[[], None]) -> None:
        """
        Give the agents whose time has come another start, before tick *number*.

        Args:
            number: Of the tick.
            settle: Hands in what the agents send in their set-up, and tells of those lost in it.

        Raises:
            RunEnds: The half raised, or a worker hangs.
        """
        returns, t_s = self._returns, number / self._tick_hz
        due: list[int] = []
        while returns and returns[0][0] <= t_s + TIME_EPSILON_S:
            due.append(heapq.heappop(returns)[1])
        returning = [index for index in sorted(set(due)) if self._account.agents[index].is_lost]
        if returning and not self._pool.have_all_ended:
            self._start_anew(number, returning, settle)

    def _start_anew(self, number: int, returning: list[int], settle: Callable[[], None]) -> None:
        account, orders = self._account, dict[int, list[tuple[int, int, bytes]]]()
        for index in returning:
            worker = self._pool.worker_for(index)
            assert worker is not None, "one lives"
            place = self._pool.number_of(worker)
            self._outbox.move(index, place)
            # It is there again: what is sent with its data arrives.
            incarnation = account.take_back(index)
            data = pack(self._half.call("initial_data", account.names[index]))
            orders.setdefault(place, []).append((index, incarnation, data))
        self._barrier.forget_answers()
        for place in sorted(orders):
            worker = self._pool.workers[place]
            self._barrier.order(worker, frames.RETURN, number, orders[place])
        self._barrier.await_ordered("has not set up the agents that return")
        settle()
        for index in returning:
            if not account.agents[index].is_lost:
                self._returned(account.names[index])

    def _returned(self, name: str) -> None:
        self._account.intended.returned(name)
        self._log("info", f"{name} has rejoined at t = {self._clock.t_s:.2f} s")
        self._journal.event("agent_rejoined", agent=name)
        self._half.call("agent_rejoined", name)
        self.resume(name)

    # Faults ---------------------------------------------------------------------------------------

    def order(self, fault: AgentFault, agents: Iterable[str]) -> None:
        """
        Have the workers begin or end a fault of agents; see `frames.FAULT`.

        Raises:
            RunEnds: A worker hangs.
        """
        wanted = set(agents)
        indices = [i for i, name in enumerate(self._account.names) if name in wanted]
        self._barrier.forget_answers()
        for worker in self._pool.workers:
            # Those without any of the agents, too: what an agent records bears one time, whoever shares its process.
            own = [index for index in indices if index in worker.agents]
            told = dataclasses.astuple(fault)
            self._barrier.order(worker, frames.FAULT, self._clock.t_s, told, own)
        self._barrier.await_ordered("has not begun a fault")
        self.heed()
