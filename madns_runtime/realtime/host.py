"""
A run in real time, seen from the host: what its session tells, carried out with simulation, executor and records.

Nothing is computed here: what takes long is the executor's, and what is said on the wire the session's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, assert_never

from madns_runtime.conditions.reports import HostConditions
from madns_runtime.config import HostLaunch
from madns_runtime.health.sampler import SAMPLER_TIMEOUT_S, start_sampler
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.context import JobContext
from madns_runtime.plugin.executor import JobRunner, make_executor
from madns_runtime.plugin.half import HalfFailed, HostHalf, RoleProgram
from madns_runtime.plugin.host_calls import HostCalls
from madns_runtime.protocol import events
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.host_peers import Address
from madns_runtime.protocol.messages import ConditionMet, Service
from madns_runtime.protocol.states import HOST_LIVE, HostState
from madns_runtime.reactor.host_signals import heed_signals
from madns_runtime.reactor.operator_link import (
    OPERATOR_GONE,
    OPERATOR_SIDE_GONE,
    OperatorLink,
    tell_loading,
)
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.reattachment import way_back_of
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.reactor.watchdog import end_after_hang_up, extend
from madns_runtime.realtime.agent_losses import AgentLosses
from madns_runtime.realtime.announcements import Announcements
from madns_runtime.realtime.half_timer import HalfTimer
from madns_runtime.realtime.host_core import RealtimeCore
from madns_runtime.realtime.host_link import HostPort
from madns_runtime.realtime.host_result import HostReport
from madns_runtime.realtime.operator_orders import OperatorOrders
from madns_runtime.realtime.timeline import HostTimeline
from madns_runtime.realtime.unwatched_devices import UnwatchedDevices
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.result_file import hand_over
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.recording.writer_thread import WriterThread
from madns_runtime.timing.clock import utc_at_iso

PROGRESS_INTERVAL_S = 0.5
HANG_UP_WAIT_S = 0.5
"""On a busy computer, from the end of a dead operator's line to an agent until the end of that to the host."""
HANG_GRACE_S = 2.0
"""Time beyond that for shutdown: a loop that hangs in a plug-in, without an operator, ends by force."""


class HostRuntime:
    """
    One run in real time.

    Args:
        launch: What to run.
        fds: Where the operator's commands come from and events go to.
        pending: What had already come behind the launch document.

    Raises:
        MadnsError: The simulation cannot be loaded, the executor not be had, the port is taken.
    """

    def __init__(self, launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> None:
        self._config = config = launch.config
        self._launch, self._line_fd = launch, fds[0]
        self._directory = Path(launch.directory)
        self._program = program = RoleProgram.load(
            config, "host", tell=partial(tell_loading, fds[1])
        )
        self._calls = calls = HostCalls(launch.session_hex)
        self._sampler = start_sampler(
            self._directory,
            run=config.run,
            machine=HOST,
            settings=config.health,
            recording=config.recording,
        )
        executor = make_executor(config.executor)  # both fork: before every thread
        self._reactor = Reactor()
        self._jobs = JobRunner(self._reactor, executor, self._job_done)
        self._operator = self._open_line(fds, pending)
        self._port = HostPort(launch, reactor=self._reactor, on_due=self._session_due)
        self._session = self._port.session
        files = RecordFiles(self._directory, run=config.run, source=HOST)
        self._conditions = HostConditions(
            config.conditions,
            tick_hz=config.agents.tick_hz,
            now_s=self._port.now_s,
            end=self._end,
            on_heard=self._port.want_pump,
        )
        self._writer = WriterThread(config.recording)
        writer, tap = self._writer.writes(files), self._conditions.tap
        recorder = self._recorder = Recorder(files, config.recording, writer, tap=tap)
        self._journal = RunJournal(recorder, config.recording.verbosity, t_s=self._port.t_s)
        self._announced = Announcements(self._journal, self._operator.emit)
        self._log = self._announced.log
        self._orders = OperatorOrders(
            self._session, self._journal, end=self._end, refuse=self._operator.refuse
        )
        calls.t_s, calls.warn = self._port.t_s, partial(self._log, "warning")
        self._half = HostHalf(program, self._journal.say, carrier=self._port.carrier, calls=calls)
        core = RealtimeCore(
            launch=launch,
            reactor=self._reactor,
            port=self._port,
            journal=self._journal,
            half=self._half,
            guard=self._guard,
            pump=self._pump,
            end=self._end,
        )
        self._devices = UnwatchedDevices(core)
        self._half_timer = HalfTimer(core)
        self._report = HostReport(config.time.duration_s, program.columns)
        self._timeline = HostTimeline(core, program, self._report, self._conditions)
        self._losses = AgentLosses(
            core,
            self._report,
            faults=self._timeline.faults,
            announced=self._announced,
            call=self._call_of_loss,
        )
        # Infinite is never: the timer is made once and moved.
        self._progress_timer = self._reactor.call_at(math.inf, self._progress)
        self._is_set_up = self._awaits_jobs = self._has_failed = False
        self._takes_data = True

    def _open_line(self, fds: tuple[int, int], pending: bytes) -> OperatorLink:
        return OperatorLink(
            self._reactor,
            fds,
            on_command=self._command,
            on_gone=self._operator_gone,
            pending=pending,
            is_detached=self._launch.is_detached,
            way_back=way_back_of(self._launch, self._directory),
            on_attached=self._watch_line,
        )

    def run(self) -> int:
        """Run to the end and return the process's exit code."""
        if self._launch.is_detached:
            # Nobody is left who would end a loop that hangs in a plug-in.
            extend(self._config.longest_s + SAMPLER_TIMEOUT_S + HANG_GRACE_S)
        else:
            self._watch_line()
        terminated = partial(self._end, HOST, "ended by SIGTERM", "interrupted")
        heed_signals(self._reactor, terminated, is_detached=self._launch.is_detached)
        self._recorder.start()
        grant = apply_scheduling(self._config.scheduling, is_host=True)
        self._writer.follow(grant.priority)
        self._report.scheduling = grant.to_mapping()
        socket = self._port.socket
        for warning in filter(None, (socket.warning, grant.warning)):
            self._log("warning", warning)
        self._reactor.add_reader(socket.fileno(), partial(self._port.read, self._take_datagram))
        self._operator.emit(self._port.listening())
        self._operator.emit({"event": "state", "state": self._session.state.value})
        self._progress_timer.reschedule(monotonic() + PROGRESS_INTERVAL_S)
        self._pump()
        self._reactor.run()
        return self._close()

    # The loop's callbacks ----------------------------------------------------------------------

    def _take_datagram(self, data: bytes, address: Address) -> None:
        message = self._session.receive_data(data, address, monotonic())
        if message is not None and self._takes_data:
            self._guard(self._half.take, *message, Service.BEST)
            if not self._port.must_pump:
                return
        self._pump()

    def _session_due(self) -> None:
        # What waits in the socket is heard before anybody is blamed for silence.
        for data, address in self._port.waiting():
            self._session.receive_datagram(data, address, monotonic())
        self._session.handle_timer(monotonic())
        self._pump()

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        while (event := self._session.next_event()) is not None:
            self._handle(event)
        self._port.must_pump = False
        self._conditions.settle(self._journal)
        self._port.flush()
        if self._port.is_in(HostState.EXIT):
            self._reactor.stop()
        else:
            self._port.arm()

    def _handle(self, event: events.HostSessionEvent) -> None:
        match event:
            case events.AgentDataReceived(agent, ConditionMet(number, t_s)):
                self._conditions.hear(agent, number, t_s)
            case events.AgentDataReceived(agent, payload, service):
                if self._takes_data:
                    self._guard(self._half.take, agent, payload, service)
            case events.HostStateEntered(state):
                self._announced.state(state)
            case events.AgentMoved():
                self._losses.moved(event)
            case events.AgentsReady():
                self._set_up()
            case events.AgentsSimulationReady():
                self._start()
            case events.AgentLost():
                self._losses.lost(event, may_tell=self._is_set_up)
            case events.AgentRejoining(agent):
                self._send_setup(agent)
            case events.AgentRejoined(agent):
                self._losses.rejoined(agent)
                self._timeline.resume(agent)
            case events.AgentsComplete():
                self._complete()
            case events.EmergencyDeclared(who, reason):
                self._emergency(who, reason)
            case events.SyncDeadlineBroken(agent, broken):
                self._journal.event("sync_deadline_broken", agent=agent, late_s=broken.late_s)
            case events.AgentsStopped(missing):
                self._agents_stopped(missing)
            case _:
                assert_never(event)

    # Carrying out ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        if not self._port.is_in(HostState.SIMULATION_SETUP):
            return  # an agent's last words came right behind its hello
        context = JobContext(
            name=HOST,
            config=self._config,
            parameters=self._program.parameters,
            agent_parameters=self._program.agent_parameters,
            journal=self._journal,
            now_s=self._port.now_s,
            send=self._port.send,
            half=self._half,
            submit=self._jobs.submit,
            wake=self._half_timer.wake,
        )
        self._guard(self._half.set_up, context)
        self._is_set_up = True
        for agent in self._session.agents_in(Phase.LOST):
            self._losses.tell(agent)  # or the word of it comes just behind
        self._awaits_jobs = True
        self._continue_setup()

    def _continue_setup(self) -> None:
        """Once every job that set-up submitted is done, the agents get their initial data."""
        if not self._awaits_jobs or self._jobs.pending_count:
            return
        self._awaits_jobs = False
        initial = {}
        for agent in self._session.agents_in(Phase.READY):
            if not self._port.is_in(HostState.SIMULATION_SETUP):
                return  # the call before raised
            initial[agent] = self._call("initial_data", agent)
        if self._port.is_in(HostState.SIMULATION_SETUP):
            self._session.setup_finished(initial, monotonic())

    def _send_setup(self, agent: str) -> None:
        initial = self._call("initial_data", agent)
        if self._session.state in HOST_LIVE:
            self._session.send_setup(agent, initial, monotonic())

    def _start(self) -> None:
        if not self._port.is_in(HostState.HOST_SIMULATION_READY):
            return  # an agent's last words came right behind its readiness
        now_s = monotonic()
        lead_s = self._config.timeouts.start_lead_s
        freeze_garbage()
        self._port.t0_s = monotonic() + lead_s
        self._report.t0_utc = utc_at_iso(lead_s)
        self._recorder.set_t0(self._report.t0_utc)
        self._port.tell_start(now_s)
        self._calls.is_counting = True
        self._call("start", -lead_s)
        self._half.begin_timer(-lead_s)
        self._half_timer.call()
        self._timeline.begin(self._directory.parent, self._log)

    def _job_done(self, job: int, future: Future[Any]) -> None:
        if not self._takes_data:
            return  # too late for the summary
        self._guard(self._half.take_job, job, future)
        self._continue_setup()
        self._pump()

    def _complete(self) -> None:
        self._report.completed_s = self._port.now_s()
        self._takes_data = self._calls.is_counting = False  # what comes now is too late
        self._jobs.tell_dropped(self._log)
        self._report.simulation = self._call("finish") or {}
        if self._port.is_in(HostState.SIMULATION_COMPLETE):
            self._session.order_stop(monotonic())

    def _emergency(self, who: str, reason: str) -> None:
        self._takes_data = False
        wait_s = HANG_UP_WAIT_S if OPERATOR_SIDE_GONE in reason else 0.0
        if who in self._session.peers and self._operator.has_hung_up(wait_s):
            # An agent that ended with its operator may be heard before the operator's own silence.
            who, reason, self._report.ending_status = "operator", OPERATOR_GONE, "aborted"
        self._report.fail(who, reason)
        self._journal.event("emergency", who=who, reason=reason)
        self._log("critical", f"emergency shutdown: {who}: {reason}")

    def _agents_stopped(self, missing: tuple[str, ...]) -> None:
        if missing:
            self._log("error", f"{', '.join(missing)}: no word that records are closed")
            self._journal.event("not_stopped", agents=list(missing))
            self._report.not_stopped = missing
        self._jobs.close()
        health = self._sampler.wait(SAMPLER_TIMEOUT_S)
        self._session.cleaned_up()
        now_s = monotonic()
        counts = self._journal.close(self._config.timeouts.shutdown_s)
        self._report.records = {**counts.to_mapping(), "health": health}
        self._session.records_closed(now_s)

    # Towards the operator -----------------------------------------------------------------------

    def _command(self, command: Mapping[str, Any]) -> None:
        self._orders.obey(command)
        self._pump()

    def _watch_line(self) -> None:
        grace_s = self._launch.reattach_s + self._config.timeouts.shutdown_s + HANG_GRACE_S
        end_after_hang_up(self._line_fd, grace_s)

    def _operator_gone(self) -> None:
        # Waiting for agents, the sampler's close, the records: each has its own deadline.
        extend(2 * self._config.timeouts.shutdown_s + SAMPLER_TIMEOUT_S + HANG_GRACE_S)
        self._end("operator", OPERATOR_GONE, "aborted")

    def _end(self, who: str, reason: str, status: str) -> None:
        if self._session.state in HOST_LIVE:
            self._report.ending_status = status
            self._session.emergency(who, reason, monotonic())
            self._pump()

    def _progress(self) -> None:
        self._progress_timer.reschedule(monotonic() + PROGRESS_INTERVAL_S)
        self._operator.emit(self._report.progress(self._session, self._port.t_s()))
        self._devices.look()
        self._conditions.tap.look(self._port.now_s())
        for text in self._report.new_troubles(self._session, self._recorder.problem):
            self._log("error", text)

    def _close(self) -> int:
        self._devices.close()
        self._timeline.close()
        network = self._port.socket.counters()
        carried = self._port.carrier.to_mapping()
        result = self._report.result(
            self._session, network=network, carried=carried, intended=self._timeline.faults.intended
        )
        result["malformed_messages"] += self._conditions.unknown_count
        result["faults"] = self._timeline.faults.to_mapping()
        result["host_calls"] = self._calls.to_mapping()
        code = hand_over(result, self._directory, self._operator)
        self._calls.close()
        self._port.socket.close()
        self._reactor.close()
        return code

    # Towards the simulation ------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call the plug-in; what it raises, or returns against its contract, ends the run by name."""
        return self._guard(self._half.call, name, *arguments)

    def _call_of_loss(self, name: str, *arguments: Any) -> None:
        if self._takes_data and self._config.on_agent_loss == "continue":
            self._call(name, *arguments)

    def _guard(self, call: Any, *arguments: Any) -> Any:
        try:  # a half that has failed is called no more
            return None if self._has_failed else call(*arguments)
        except HalfFailed as failure:
            self._port.must_pump = self._has_failed = True
            self._session.emergency(HOST, str(failure), monotonic())
            return None
