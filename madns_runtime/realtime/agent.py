"""One agent inside a loop that others may share: what its session, its pace and its half of the simulation come to."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, assert_never

from madns_runtime.config import AgentLaunch
from madns_runtime.hardware.port import NO_HARDWARE
from madns_runtime.plugin.context import PeerContext
from madns_runtime.plugin.half import Half, HalfFailed, RoleProgram
from madns_runtime.protocol import events
from madns_runtime.protocol.codec import NO_DATA
from madns_runtime.protocol.messages import (
    ActionOrder,
    AgentFault,
    Delivery,
    FaultOrder,
    TransmissionRefusal,
)
from madns_runtime.protocol.states import AgentState
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.realtime.agent_calls import AGENT, IDLE, METHOD, NUMBER_OF, RECEIVE, LoopSeat
from madns_runtime.realtime.agent_faults import AgentFaults
from madns_runtime.realtime.agent_link import AgentPort
from madns_runtime.realtime.agent_report import AgentOutcome, AgentReport
from madns_runtime.realtime.device_time import DeviceTime
from madns_runtime.realtime.last_answers import LastAnswers
from madns_runtime.realtime.loop_account import Span
from madns_runtime.realtime.ordered_actions import OrderedActions
from madns_runtime.realtime.packs import Pack
from madns_runtime.realtime.process_port import ProcessPort
from madns_runtime.realtime.process_records import ProcessRecords
from madns_runtime.realtime.ticks import PacedTicks, TickCalls
from madns_runtime.recording.newest_values import NewestValues
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timing.clock import utc_at_iso
from madns_runtime.timing.late_causes import Cause


class AgentRunner:
    """
    Runs one agent.

    Args:
        seat: The agent, and where its calls are noted.
        launch: The run.
        program: What it runs.
        reactor: The loop.
        process: What it shares with the other agents of its process.
        pack: Whom it ticks with.
        on_ended: Called once, with how it ended.
        on_left: Called with its name when it has ended early, before its records are closed.
        on_killed: Called when a fault is to end it: with its name, why, and the time until its return, s.
        counted: What conditions have counted in its earlier incarnation in this process.

    Raises:
        MachineError: It cannot record.
        HalfFailed: Its half cannot be made.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        seat: LoopSeat,
        launch: AgentLaunch,
        program: RoleProgram,
        *,
        reactor: Reactor,
        process: ProcessPort,
        pack: Pack,
        on_ended: Callable[[str, AgentOutcome], None],
        on_left: Callable[[str], None],
        on_killed: Callable[[str, str, float | None], None],
        counted: Mapping[int, int],
    ) -> None:
        self.name = name = seat.name
        self._calls, self._number = seat.calls.page, seat.number
        self._config = config = launch.config
        self._program, self._reactor = program, reactor
        self._on_ended, self._on_left = on_ended, on_left
        self._port = AgentPort(
            name,
            launch,
            program=program,
            reactor=reactor,
            process=process,
            on_due=self._session_due,
            report=lambda: self._report.ping(),
            counted=counted,
        )
        self.counted = self._port.conditions.counts
        self._session = self._port.session
        directory = Path(launch.directory) / "agents" / name
        files = RecordFiles(directory, run=config.run, source=name, incarnation=program.incarnation)
        self._recorder = recorder = Recorder(
            files, config.recording, process.writer.writes(files), tap=self._port.conditions
        )
        self._journal = RunJournal(recorder, config.recording.verbosity, t_s=self._port.t_s)
        self._records = ProcessRecords(self._journal, self._config.health.period_s)
        self._hardware = seat.hardware
        self.half = half = Half(program.make, self._journal.say)
        """The plug-in's part."""
        self._receive = half.simulation.receive  # called often: without a layer between
        self._spans = process.account.add
        self._pack = pack
        self._ticks = ticks = self._make_ticks(seat, recorder)
        pack.add(ticks)
        self._device_time = DeviceTime(seat.hardware, self._port, lambda: ticks.duration_s)
        self._actions = OrderedActions(
            seat,
            program.actions,
            self._journal,
            call=self._call,
            end_at=ticks.end_at,
            clock=process.clock,
        )
        self._faults = AgentFaults(ticks, self._journal, killed=partial(on_killed, name))
        self._report = AgentReport(
            port=self._port,
            records=self._records,
            ticks=ticks,
            columns=NewestValues(recorder, program.columns),
            devices=seat.hardware if launch.is_detached else NO_HARDWARE,
        )
        self._last_answers = LastAnswers(
            reactor, self._port, self._config.timeouts, pump=self._pump, finish=self._finish_run
        )
        self._usage_timer = reactor.call_at(math.inf, self._record_usage)  # at no time, as yet
        self._outcome = AgentOutcome(as_ordered=False, reason="did not end")
        self._is_closed, self._takes_data = False, True

    def _make_ticks(self, seat: LoopSeat, recorder: Recorder) -> PacedTicks:
        calls = TickCalls(
            prepare=self._prepare_tick if self._program.has_medium or self._hardware else None,
            step=self.half.simulation.step,
            end_if_forked=self._reactor.end_if_forked,
            failed=self._step_failed,
            ended=self._ticks_over,
            is_running=lambda: self._session.state is AgentState.RUN_SIMULATION,
            report_if_due=self._report_if_due,
        )
        return PacedTicks(
            seat, self._config, self._pack.phase_s, port=self._port, recorder=recorder, calls=calls
        )

    def start(self) -> None:
        """Begin, and say hello at once."""
        self._recorder.start()
        self._journal.event("start", pid=os.getpid())
        if warning := self._port.process.socket.warning:
            self._journal.say("warning", warning)
        self._port.listen(self._take_datagram)
        self._pump()

    def set_scheduling(self, grant: Mapping[str, Any]) -> None:
        """Take note of what the kernel granted to the loop."""
        self._report.scheduling = dict(grant)
        self._records.scheduling(grant)

    def emergency(self, reason: str) -> None:
        """End at once, keep the records, tell the host."""
        self._session.emergency(reason, monotonic())
        self._pump()

    # The loop's callbacks ----------------------------------------------------------------------

    def _take_datagram(self, data: bytes) -> None:
        message = self._session.receive_data(data, monotonic())
        if message is not NO_DATA and self._takes_data:
            calls = self._calls
            calls[AGENT], calls[METHOD] = self._number, RECEIVE
            try:
                self._receive(message)
            except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
                self._fail(self.half.failure("receive", error))
            self._reactor.end_if_forked()
            calls[METHOD] = IDLE
            if not self._port.must_flush:
                return
        elif message is not NO_DATA:
            self._port.too_late += 1
        self._pump()

    def _session_due(self) -> None:
        began_s = monotonic()
        # What waits in the socket is heard before the host is blamed for silence.
        self._port.process.drain()
        heard_s = monotonic()
        self._spans(Span(Cause.RECEIVING, self._number, began_s, heard_s))
        if not self._is_closed:
            self._session.handle_timer(heard_s)
            self._pump()
        self._spans(Span(Cause.HOUSEKEEPING, self._number, heard_s, monotonic()))

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        session = self._session
        while (event := session.next_event()) is not None:
            self._handle(event)
        while (broken := session.next_broken_deadline()) is not None:
            self._journal.event("sync_deadline_broken", late_s=broken.late_s)
        if not self._is_closed:
            self._port.flush()

    def _handle(self, event: events.AgentSessionEvent) -> None:
        match event:
            case events.HostDataReceived(payload):
                self._take(payload)
            case events.ClockEstimated():
                if self._session.state is AgentState.RUN_SIMULATION:
                    self._records.clock(self._session.clock, monotonic())
                    if self._port.now_s() < 0.0:  # what is known better now moves the start
                        self._port.process.follow_clock()
                        self._device_time.tell()
            case events.AgentStateEntered(state):
                self._journal.event("state", state=state.value)
            case events.SetupReceived(initial, t_s):
                self._port.rejoin_at(t_s)
                self._set_up(initial)
            case events.StartReceived(t0_host_s):
                self._start_run(t0_host_s)
            case events.StopReceived():
                self._outcome = AgentOutcome(as_ordered=True, is_run_over=True)
                self._close_records()
            case events.EmergencyOrdered(who, reason):
                self._end_early(f"{who}: {reason}", is_own=who == self.name)
            case events.ExpelledFromRun(reason):
                self._end_early(f"expelled by the host: {reason}", is_own=True)
            case events.SessionEnded():
                self._close()
            case _:
                assert_never(event)

    # Carrying out ------------------------------------------------------------------------------

    def _take(self, message: Any) -> None:
        if isinstance(message, Delivery):
            self._port.mailbox.add(message)
        elif isinstance(message, FaultOrder):
            self._hardware.order_fault(message)
        elif isinstance(message, AgentFault):
            self._faults.take(message)
        elif not self._takes_data:
            self._port.too_late += 1  # its half is called no more
        elif isinstance(message, ActionOrder):
            self._actions.take(message)
        else:
            self._call("refused" if type(message) is TransmissionRefusal else "receive", message)

    def _set_up(self, initial: Any) -> None:
        context = PeerContext(
            name=self.name,
            config=self._config,
            parameters=self._program.parameters_of(self.name),
            journal=self._journal,
            now_s=self._port.now_s,
            send=self._port.send,
            mailbox=self._port.mailbox,
            hardware=self._hardware,
        )
        self._call("setup", context, initial)
        if self._session.state is AgentState.SIMULATION_SETUP:
            self._session.setup_finished(monotonic())

    def _start_run(self, t0_host_s: float) -> None:
        self._port.t0_host_s = t0_host_s
        now_s = self._port.now_s()
        self._recorder.set_t0(utc_at_iso(-now_s))
        self._journal.event("phase", phase_s=self._pack.phase_s)
        self._port.process.freeze()
        self._session.wait_for_ticks(self._ticks.period_s)
        self._ticks.begin(now_s)
        self._pack.arm()
        self._records.begin_usage(monotonic(), self._pack.phase_s / self._ticks.period_s)
        self._device_time.tell()
        self._usage_timer.reschedule(self._records.usage_due_s + self._session.ping_slack_s)

    def _ticks_over(self) -> None:
        self._device_time.follow()  # where a stop has made the end sooner
        self._last_answers.begin(self._port.local_s(self._ticks.over_s()))

    def _step_failed(self, error: BaseException) -> None:
        self._fail(self.half.failure("step", error))
        self._pump()

    def _prepare_tick(self, t_s: float) -> bool:
        """Hand in what comes with the tick at simulated time *t_s*; return whether the agent goes on."""
        if self._program.has_medium and not self._hear(t_s):
            return False
        return not self._hardware or self._look_at_devices()

    def _report_if_due(self, now_s: float) -> None:
        if now_s >= self._session.ping_due_s and not self._is_closed:
            self._session.handle_timer(now_s)
            self._pump()
            self._spans(Span(Cause.HOUSEKEEPING, self._number, now_s, monotonic()))
        if now_s >= self._records.usage_due_s:
            self._record_usage()

    def _hear(self, t_s: float) -> bool:
        """Hand in what other agents' messages bring in the tick at *t_s*; return whether the agent goes on."""
        for delivery in self._port.mailbox.due(t_s):
            self._call("hear", delivery)
            if self._session.state is not AgentState.RUN_SIMULATION:
                self._pump()
                return False
        return True

    def _look_at_devices(self) -> bool:
        """Tell the half whose status has changed; return whether the agent goes on."""
        self._device_time.follow()
        for name, status in self._hardware.changes():
            self._journal.event("device", device=name, status=status)
            self._call("device_changed", name, status)
            if self._session.state is not AgentState.RUN_SIMULATION:
                self._pump()
                return False
        return True

    def _finish_run(self) -> None:
        self._ticks.finish(self._port.now_s())
        self._takes_data = False  # what comes from now on is too late for the summary
        summary = self._call("finish")
        if self._session.state is AgentState.RUN_SIMULATION:
            self._session.run_finished(self._report.summary(summary), monotonic())
        self._pump()

    def _end_early(self, reason: str, *, is_own: bool) -> None:
        may_restart = is_own and not self._ticks.pacer.is_over  # no other start has a tick
        self._outcome = AgentOutcome(
            as_ordered=False, reason=reason, may_restart=may_restart, is_run_over=not is_own
        )
        self._takes_data = False
        self._cancel_timers()
        # Killed on purpose, it says no more than one that has a process of its own: this one goes on for others.
        if not self._faults.has_killed:
            self._journal.emergency(reason)
        self._actions.leave_clock()
        self.half.abandon()
        self._reactor.end_if_forked()
        self._on_left(self.name)
        self._close_records()

    def _close_records(self) -> None:
        messages = self._session.link.counters.to_mapping()
        self._records.device_losses(self._hardware.losses())
        counts = self._journal.close(self._config.timeouts.shutdown_s)
        records = self._report.last_counts(counts.to_mapping(), messages)
        self._session.records_closed(records, monotonic())

    def _close(self) -> None:
        self._is_closed = True
        self._cancel_timers()
        self._actions.close()
        self._pack.leave_out(self._ticks)
        self._port.close()
        self._on_ended(self.name, self._outcome)

    def _cancel_timers(self) -> None:
        for timer in (self._last_answers, self._usage_timer):
            timer.cancel()

    # Telling -----------------------------------------------------------------------------------

    def _record_usage(self) -> None:
        if self._session.state is AgentState.RUN_SIMULATION:
            began_s = monotonic()
            self._records.usage(began_s)
            self._port.process.account.look()
            self._device_time.tell()
            self._spans(Span(Cause.HOUSEKEEPING, self._number, began_s, monotonic()))
            self._usage_timer.reschedule(self._records.usage_due_s + self._session.ping_slack_s)

    # Towards the simulation ------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call the plug-in; what it raises, or returns against its contract, ends this agent by name."""
        self._calls[AGENT], self._calls[METHOD] = self._number, NUMBER_OF[name]
        try:
            return self.half.call(name, *arguments)
        except HalfFailed as failure:
            self._fail(failure)
            return None
        finally:
            self._reactor.end_if_forked()
            self._calls[METHOD] = IDLE

    def _fail(self, failure: HalfFailed) -> None:
        self._reactor.end_if_stray()  # by sys.exit, say: whoever forked it goes on
        self._takes_data = False  # what came with it is too late
        self._port.flush()  # what the half sent leaves first: the word of its end would overtake it
        self._session.emergency(str(failure), monotonic())
        self._port.must_flush = True
