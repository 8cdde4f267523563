"""
The host of a lockstep run: simulated time goes on when everybody is done with it.

One script from beginning to end, unlike the host of a real-time run: it hands out a tick, waits for
all workers, hands their messages to the simulation's host half in the order of agents, and moves its
clock to what comes next. Nothing in it depends on the wall clock but how long it waits for whom.
"""

from __future__ import annotations

import contextlib
import math
from functools import partial
from pathlib import Path
from time import monotonic

from madns_runtime.conditions.reports import HostConditions
from madns_runtime.config import HostLaunch
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.absences import Absences
from madns_runtime.lockstep.barrier import Barrier, RunEnds
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.host_core import LockstepCore
from madns_runtime.lockstep.host_faults import LockstepFaults
from madns_runtime.lockstep.host_half import LockstepHalf
from madns_runtime.lockstep.messages import Outbox, decode
from madns_runtime.lockstep.partition import processors_here, share_out
from madns_runtime.lockstep.recorder import open_journal
from madns_runtime.lockstep.result import EarlyEnd, RunAccount
from madns_runtime.lockstep.timeline import LockstepTimeline
from madns_runtime.lockstep.workers import WorkerPool
from madns_runtime.medium.carrier import Carrier
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import JobContext
from madns_runtime.plugin.executor import make_executor
from madns_runtime.plugin.half import HostHalf, RoleProgram
from madns_runtime.plugin.host_calls import HostCalls
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import ConditionMet, Service
from madns_runtime.protocol.states import HostEvent, host_machine
from madns_runtime.reactor.descriptors import allow_descriptors
from madns_runtime.reactor.host_signals import heed_signals
from madns_runtime.reactor.operator_link import tell_loading
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.recording.result_file import hand_over, leave
from madns_runtime.timing.clock import utc_now_iso
from madns_runtime.timing.rate import count_ticks

HANG_GRACE_S = 2.0
"""Time beyond twice that for shutdown: a host that hangs, without an operator, ends by force."""
SERVICES = tuple(Service)
"""Classes of service by number."""
DRAIN_ROUNDS_MAX = 16
"""Answers to answers that are handed out after the last tick."""


class LockstepHost:
    """
    One run.

    Args:
        launch: What to run.
        fds: Where the operator's commands come from and events go to.
        pending: What had already come behind the launch document.
    """

    def __init__(self, launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> None:
        self._config = config = launch.config
        self._launch, self._line_fd = launch, fds[0]
        self._names = config.agents.resolved_names()
        self._directory = Path(launch.directory)
        allow_descriptors()
        shares = share_out(config.agents, processors_here())
        # Everything that forks comes before every thread; workers load their half at the same time.
        self._pool = WorkerPool(launch, self._directory.parent, shares)
        self._program = program = RoleProgram.load(
            config, "host", tell=partial(tell_loading, fds[1])
        )
        self._calls = calls = HostCalls(launch.session_hex)
        executor = make_executor(config.executor)
        self._clock = clock = SimulatedClock(-config.timeouts.start_lead_s)
        self._account = account = RunAccount(
            self._names, config.time.duration_s, len(shares), program.columns
        )
        self._conditions = conditions = HostConditions(
            config.conditions,
            tick_hz=config.agents.tick_hz,
            now_s=clock.now_s,
            end=self._end,
        )
        self._journal = open_journal(
            self._directory, config, source=HOST, clock=clock, tap=conditions.tap
        )
        self._outbox = Outbox(shares, account=account, clock=clock, journal=self._journal)
        self._barrier = Barrier(
            launch, self._pool, account=account, clock=clock, fds=fds, pending=pending
        )
        self._operator = self._barrier.operator
        calls.t_s = self._t_s
        self._carrier = carrier = Carrier(
            self._names, self._outbox.post, clock.now_s, end_s=config.time.duration_s
        )
        self._half = HostHalf(program, self._journal.say, carrier=carrier, calls=calls)
        self._guarded = LockstepHalf(
            self._half,
            config.timeouts,
            barrier=self._barrier,
            executor=executor,
            on_hang=self._leave_hanging,
        )
        core = LockstepCore(
            config=config,
            account=account,
            clock=clock,
            pool=self._pool,
            barrier=self._barrier,
            outbox=self._outbox,
            half=self._guarded,
            journal=self._journal,
        )
        self._absences = Absences(core, self._log)
        self._faults = LockstepFaults(core, self._absences)
        self._timeline = LockstepTimeline(core, program, self._faults)
        self._absences.resume = self._timeline.runner.resume
        self._absences.heed = self._take_conditions
        self._timeline.wait_for(conditions)
        self._machine = host_machine()

    def run(self) -> int:
        """Run to the end and return the process's exit code."""
        is_detached, barrier = self._launch.is_detached, self._barrier
        if not is_detached:
            end_after_hang_up(self._line_fd, 2 * self._config.timeouts.shutdown_s + HANG_GRACE_S)
        terminated = partial(barrier.end, HOST, "ended by SIGTERM", status="interrupted")
        heed_signals(barrier.reactor, terminated, is_detached=is_detached)
        self._operator.emit({"event": "state", "state": self._machine.state.value})
        try:
            with contextlib.suppress(RunEnds):
                self._script()
            self._shut_down()
        finally:
            self._pool.end_left()
        return self._close()

    # The script -----------------------------------------------------------------------------------

    def _script(self) -> None:
        self._set_up()
        self._start()
        duration_s, tick_hz = self._config.time.duration_s, self._config.agents.tick_hz
        for number in range(count_ticks(duration_s, tick_hz)):
            self._advance(number / tick_hz)
            self._timeline.take_orders()
            if self._timeline.is_stopped:
                self._account.duration_s = duration_s = number / tick_hz
                break
            self._absences.bring_back(number, self._settle)
            self._barrier.exchange((frames.TICK, number), self._outbox.boxes)
            self._account.ticks, self._account.ticked_s = number + 1, number / tick_hz
            self._settle()
            self._settle_conditions()
        self._advance(duration_s)
        self._drain()
        self._settle_conditions()
        self._finish()

    def _set_up(self) -> None:
        timeouts, barrier = self._config.timeouts, self._barrier
        barrier.await_all(
            timeouts.agents_ready_s, "has not loaded the agent's half", "agents_ready_s"
        )
        self._account.set_states("ready")
        self._fire(HostEvent.AGENTS_READY)
        limit_s = timeouts.host_setup_s
        context = JobContext(
            name=HOST,
            config=self._config,
            parameters=self._program.parameters,
            agent_parameters=self._program.agent_parameters,
            journal=self._journal,
            now_s=self._clock.now_s,
            send=self._outbox.send,
            half=self._half,
            submit=self._guarded.submit,
            wake=self._half.wake,
        )
        self._guarded.set_up(context, limit_s)
        initial = []
        for number, name in enumerate(self._names):
            data = self._guarded.call("initial_data", name, limit_s=limit_s)
            initial.append((number, pack(data)))
            barrier.serve()
        self._fire(HostEvent.SETUP_FINISHED)
        self._absences.begin()
        for worker in self._pool.workers:
            barrier.order(worker, frames.SETUP, [initial[number] for number in worker.agents])
        barrier.await_all(timeouts.agent_setup_s, "has not set itself up", "agent_setup_s")
        self._settle()

    def _start(self) -> None:
        self._fire(HostEvent.AGENTS_SIMULATION_READY)
        self._account.set_states("running")
        freeze_garbage()  # what set-up made stays: no collection walks it in mid-run
        self._account.t0_utc = utc_now_iso()
        self._account.began_s = monotonic()
        self._timeline.accept_orders(self._directory.parent, self._barrier.reactor, self._log)
        self._guarded.call("start", self._clock.t_s)
        self._half.begin_timer(self._clock.t_s)
        self._guarded.call_timer(self._clock.t_s)

    def _advance(self, t_s: float) -> None:
        """Let simulated time go on to *t_s*, and do all that the half wants done until then."""
        while True:
            next_s, is_action = self._timeline.next_s(self._half.next_s)
            if next_s is None or next_s > t_s:
                break
            self._clock.t_s = max(self._clock.t_s, next_s)
            if is_action:
                self._timeline.run_due()
            else:
                self._guarded.call_timer(self._clock.t_s)
            self._barrier.serve()
        self._clock.t_s = t_s
        self._faults.release()
        self._carrier.hand_over()

    def _drain(self) -> None:
        """Hand out what was answered to the last tick, and the answers to that."""
        for _ in range(DRAIN_ROUNDS_MAX):
            if not any(self._outbox.boxes):
                break
            self._barrier.exchange((frames.DRAIN, self._clock.t_s), self._outbox.boxes)
            self._settle()
        self._outbox.give_up()

    def _finish(self) -> None:
        timeouts, account = self._config.timeouts, self._account
        account.wall_s = monotonic() - (account.began_s or 0.0)
        self._fire(HostEvent.AGENTS_COMPLETE)
        for worker in self._pool.workers:
            self._barrier.order(worker, frames.FINISH, self._clock.t_s)
        limit_s, setting = max((timeouts.tick_s, "tick_s"), (timeouts.complete_s, "complete_s"))
        self._barrier.await_all(limit_s, "has not summed itself up", setting)
        self._absences.take()
        self._conditions.end_s = -math.inf  # what is met from now on is noted, and nothing follows
        self._timeline.runner.close()
        self._take_conditions()
        self._conditions.settle(self._journal)
        for answer in self._pool.answers():
            for number, summary, deadlines_broken, counts, newest in answer[frames.LOSSES + 1]:
                account.agents[number].summary = summary
                account.agents[number].deadlines_broken += deadlines_broken
                account.agents[number].peer_messages = counts
                account.agents[number].columns = newest
        account.set_states("complete")
        # The view's last picture stays on the terminal: without this one of some moment before the end.
        self._barrier.operator.emit(account.progress(self._clock.t_s, monotonic()))
        account.simulation = self._guarded.finish()
        self._conditions.settle(self._journal)
        self._outbox.give_up()

    def _t_s(self) -> float | None:
        return None if self._account.began_s is None else self._clock.t_s

    # Messages -------------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Hand in what the agents sent, and tell of those that were lost."""
        self._take_messages()
        self._absences.take()

    def _take_messages(self) -> None:
        """Hand what the agents sent to the half, in the order of agents and of sending."""
        names, accounts, half = self._names, self._account.agents, self._guarded
        for number, service, body in self._barrier.messages():
            accounts[number].up[service] += 1
            message = decode(body)
            if isinstance(message, ConditionMet):
                self._conditions.hear(names[number], message.number, message.t_s)
            else:
                half.take(names[number], message, SERVICES[service])
            self._barrier.serve()

    # Conditions -----------------------------------------------------------------------------------

    def _take_conditions(self) -> None:
        """Hear what agents tell of conditions; what they sent besides is too late."""
        for number, service, body in self._barrier.messages():
            account, message = self._account.agents[number], decode(body)
            account.up[service] += 1
            if isinstance(message, ConditionMet):
                self._conditions.hear(self._names[number], message.number, message.t_s)
            else:
                account.too_late += 1

    def _settle_conditions(self) -> None:
        """
        Act at the end of a tick on the conditions that were met in it.

        Raises:
            RunEnds: One of them ends the run.
        """
        self._conditions.tap.look(self._clock.t_s)
        self._conditions.settle(self._journal)
        if self._barrier.ending is not None:
            raise RunEnds

    def _end(self, who: str, reason: str, status: str) -> None:
        self._barrier.end(who, reason, status=status)

    # The end --------------------------------------------------------------------------------------

    def _shut_down(self) -> None:
        ending, reason = self._barrier.ending, None
        self._account.ending = ending
        if ending is None:
            self._fire(HostEvent.STOP_ORDERED)
        else:
            reason = f"{ending.who}: {ending.reason}"
            self._fire(HostEvent.EMERGENCY)
            self._journal.event("emergency", who=ending.who, reason=ending.reason)
            self._log("critical", f"emergency shutdown: {reason}")
        missing = self._account.not_stopped = self._barrier.stop_workers(reason)
        if missing:
            self._log("error", f"{', '.join(missing)}: no word that records are closed")
        self._fire(HostEvent.AGENTS_STOPPED)
        self._guarded.close()
        self._fire(HostEvent.CLEANED_UP)
        self._account.records = self._journal.close().to_mapping()
        self._account.peer_messages = self._carrier.to_mapping()
        self._account.faults = self._faults.to_mapping()
        self._fire(HostEvent.RECORDS_CLOSED)
        self._fire(HostEvent.SERVER_STOPPED)

    def _close(self) -> int:
        self._timeline.close()
        code = hand_over(self._account.result(), self._directory, self._operator)
        self._calls.close()
        self._barrier.reactor.close()
        return code

    def _leave_hanging(self, reason: str) -> None:
        """Leave a result although the half hangs; called in another thread, before the process ends."""
        self._account.ending = EarlyEnd(who=HOST, reason=reason)
        leave(self._account.result(), self._directory)
        self._calls.close()

    # Telling --------------------------------------------------------------------------------------

    def _fire(self, event: HostEvent) -> None:
        state = self._machine.fire(event).value
        self._journal.event("state", state=state)
        self._operator.emit({"event": "state", "state": state})

    def _log(self, level: str, text: str) -> None:
        self._journal.say(level, text)
        self._operator.emit({"event": "log", "level": level, "source": HOST, "text": text})
