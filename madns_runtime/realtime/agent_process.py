"""The process of some of a machine's agents: their loop, which ends with its supervisor."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Any

from madns_runtime.config import AgentLaunch
from madns_runtime.errors import MadnsError
from madns_runtime.faults.intended_losses import RETURN_S_MIN
from madns_runtime.hardware.port import Hardware
from madns_runtime.plugin.half import RoleProgram
from madns_runtime.reactor.descriptors import allow_descriptors
from madns_runtime.reactor.operator_link import OPERATOR_SIDE_GONE
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.realtime.agent import AgentRunner
from madns_runtime.realtime.agent_calls import LoopSeat
from madns_runtime.realtime.agent_report import AgentOutcome
from madns_runtime.realtime.packs import Pack
from madns_runtime.realtime.process_port import ProcessPort
from madns_runtime.timing.pack_split import split_into_packs

ABANDON_S = 5
"""Time for an agent that a fault ends with its process to let go of what outlives it."""
HANG_GRACE_S = 2.0
"""Time beyond that for shutdown: an agent that hangs in its plug-in ends itself, and leaves its stack."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SupervisorCalls:
    """Calls that a supervisor hands to a process of agents, for the child."""

    hardware_of: Callable[[str], Hardware]
    """Returns the devices that an agent uses, as one that starts sees them."""
    tell_killed: Callable[[str, str, float | None], None]
    """Tells that a fault ends this process now, and the time until its return, s."""
    tell_left: Callable[[str], None]
    """Tells that an agent has ended, while others of the process may go on."""


class AgentProcess:
    """
    The agents of one process in their loop.

    Args:
        launch: The run.
        seats: This process's agents.
        program: What they run.
        life_fd: Closes when the supervisor is gone.
        supervisor: What the supervisor does for it.
    """

    def __init__(
        self,
        launch: AgentLaunch,
        seats: Sequence[LoopSeat],
        program: RoleProgram,
        *,
        life_fd: int,
        supervisor: SupervisorCalls,
    ) -> None:
        self._reactor = Reactor()
        self._supervisor_pid = os.getppid()
        self._launch = launch
        self._seats = seats
        self._program = program
        self._life_fd = life_fd
        self._runners: dict[str, AgentRunner] = {}
        self._outcomes: dict[str, AgentOutcome] = {}
        self._supervisor = supervisor
        self._dropped: dict[str, float | None] = {}
        """Agents that a fault is ending, with the time until their return, s."""
        self._away: set[str] = set()
        """Agents that a fault has ended and that will return."""
        self._packs: dict[str, Pack] = {}
        self._incarnations: dict[str, int] = {}
        self._counted: dict[str, dict[int, int]] = {}
        """Counts of an agent's conditions: one that returns would read that in its records, while others wait."""
        self._is_ending = False
        self._grant: dict[str, Any] = {}

    def run(self) -> dict[str, AgentOutcome]:
        """Run every agent to its end, and return how each ended."""
        allow_descriptors()  # a file per stream and agent: a usual limit of 1024 would hold some hundred agents
        reactor = self._reactor
        reactor.on_signal(signal.SIGTERM, lambda: self._end("SIGTERM"))
        reactor.on_signal(signal.SIGINT, lambda: None)
        reactor.add_reader(self._life_fd, self._life_ended)
        end_after_hang_up(self._life_fd, self._launch.config.timeouts.shutdown_s + HANG_GRACE_S)
        runners = self._make_runners()
        self._runners = {runner.name: runner for runner in runners}
        for runner in runners:
            runner.start()
        # The recorders' thread runs already: only the loop is raised to its priority.
        grant = apply_scheduling(self._launch.config.scheduling, is_host=False)
        self._process.writer.follow(grant.priority)
        self._grant = grant.to_mapping()
        for runner in runners:
            runner.set_scheduling(self._grant)
        reactor.run()
        reactor.close()
        return self._outcomes

    def _make_runners(self) -> list[AgentRunner]:
        names_here = [seat.name for seat in self._seats]
        self._process = process = ProcessPort(self._launch, self._reactor, len(names_here))
        phases_s = self._launch.phases_s
        for together in split_into_packs(names_here):
            # On a machine that has returned, where some agents are missing, they may be of several packs.
            for phase_s, names in groupby(together, lambda name: phases_s.get(name, 0.0)):
                pack = Pack(phase_s, reactor=self._reactor, process=process)
                self._packs |= dict.fromkeys(names, pack)
                process.arms.append(pack.arm)
        if len(process.arms) == 1:
            self._reactor.expect_period(1.0 / self._launch.config.agents.tick_hz)
        return [self._make_runner(seat) for seat in self._seats]

    def _make_runner(self, seat: LoopSeat) -> AgentRunner:
        incarnation = self._incarnations.setdefault(seat.name, self._program.incarnation)
        runner = AgentRunner(
            seat,
            self._launch,
            replace(self._program, incarnation=incarnation),
            reactor=self._reactor,
            process=self._process,
            pack=self._packs[seat.name],
            on_ended=self._ended,
            on_left=self._left,
            on_killed=self._killed,
            counted=self._counted.get(seat.name, {}),
        )
        self._reactor.end_if_forked()
        return runner

    # Faults that end an agent ---------------------------------------------------------------------

    def _killed(self, name: str, reason: str, after_s: float | None) -> None:
        """End the process if it is the agent's alone, else drop the agent's half."""
        if len(self._seats) == 1:
            self._supervisor.tell_killed(name, reason, after_s)
            # What it has started would live on; one that hangs in letting go of it ends by the alarm.
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(ABANDON_S)
            self._runners[name].half.abandon()
            os.kill(os.getpid(), signal.SIGKILL)
        # Already now: the last one that leaves the socket closes it.
        self._process.awaited += after_s is not None
        self._dropped[name] = after_s
        # In the loop's next turn: the order came with messages that others of the process share.
        drop = partial(self._runners[name].emergency, reason)
        self._reactor.call_at(self._reactor.now_s(), drop)

    def _left(self, name: str) -> None:
        """Have the outputs that an agent owns made safe: it has ended, and others may keep the process."""
        if self._seat_of(name).hardware:
            self._supervisor.tell_left(name)

    def _seat_of(self, name: str) -> LoopSeat:
        return next(seat for seat in self._seats if seat.name == name)

    def _return(self, seat: LoopSeat) -> None:
        """Make an agent anew that was dropped."""
        if self._is_ending:
            return
        self._away.discard(seat.name)
        self._process.awaited -= 1
        self._incarnations[seat.name] += 1
        # Of its earlier start's devices it knows nothing: no status, and nothing that found no room there.
        seat = replace(seat, hardware=self._supervisor.hardware_of(seat.name))
        try:
            self._runners[seat.name] = runner = self._make_runner(seat)
        except MadnsError as error:  # the others of the process go on; the host misses it
            reason = f"cannot return: {error}"
            sys.stderr.write(f"{seat.name} {reason}\n")
            self._outcomes[seat.name] = AgentOutcome(as_ordered=False, reason=reason)
            self._stop_if_done()
            return
        runner.start()
        runner.set_scheduling(self._grant)

    def _life_ended(self) -> None:
        self._reactor.remove_reader(self._life_fd)
        if os.read(self._life_fd, 1):
            self._end(OPERATOR_SIDE_GONE)
        else:
            self._end(f"its supervisor (pid {self._supervisor_pid}) is gone")

    def _end(self, reason: str) -> None:
        self._is_ending = True
        self._process.awaited = 0
        for runner in list(self._runners.values()):
            runner.emergency(reason)
        self._stop_if_done()

    def _ended(self, name: str, outcome: AgentOutcome) -> None:
        self._counted[name] = self._runners.pop(name).counted()
        self._outcomes[name] = outcome
        if outcome.is_run_over:  # nobody returns to it any more
            self._is_ending, self._process.awaited = True, 0
        if name in self._dropped:
            self._outcomes[name] = replace(outcome, as_ordered=True, may_restart=False)
            after_s = self._dropped.pop(name)
            if after_s is not None and not self._is_ending:
                self._away.add(name)
                due_s = self._reactor.now_s() + max(after_s, RETURN_S_MIN)
                self._reactor.call_at(due_s, partial(self._return, self._seat_of(name)))
        self._stop_if_done()

    def _stop_if_done(self) -> None:
        if not self._runners and (self._is_ending or not self._away):
            self._process.close_if_unused()
            self._reactor.stop()
