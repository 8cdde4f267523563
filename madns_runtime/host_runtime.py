"""
A run in real time, seen from the host: what its session tells, carried out with simulation, executor and records.

Nothing is computed here: what takes long is the executor's, and what is said on the wire the session's.
"""

from __future__ import annotations

import math
import signal
from collections.abc import Mapping
from concurrent.futures import Future
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.config import HostLaunch, RunConfig
from madns_runtime.context import JobContext
from madns_runtime.executor import JobRunner, make_executor
from madns_runtime.half import HalfFailed, HostHalf, Program
from madns_runtime.health.sampler import SAMPLER_TIMEOUT_S, start_sampler, stop_sampler
from madns_runtime.host_port import HostPort
from madns_runtime.host_result import HostReport, progress_report
from madns_runtime.plugin.api import HOST
from madns_runtime.protocol import host_events as told
from madns_runtime.protocol.host_events import Phase
from madns_runtime.protocol.states import HOST_LIVE, HostState
from madns_runtime.reactor.lines import OPERATOR_SIDE_GONE, OperatorLink
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.scheduling import freeze_garbage, outlive_parent
from madns_runtime.reactor.watchdog import end_after_hang_up, extend, tell_stack_on
from madns_runtime.recording.run_recorder import RunRecorder
from madns_runtime.result_file import hand_over
from madns_runtime.timing.clock import utc_at_iso

PROGRESS_INTERVAL_S = 0.5
SLOW_CALL_S = 0.5
"""A call of the plug-in that takes this long while the run is on is told: agents lose a silent host."""
OPERATOR_GONE = "the operator's process is gone"
HANG_UP_WAIT_S = 0.5
"""On a busy computer, from the end of a dead operator's line to an agent until the end of that to the host."""
HANG_GRACE_S = 2.0
"""Beyond the time for shutdown: a loop that hangs in a plug-in, without an operator, ends by force."""


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
        self._line_fd, self._is_detached = fds[0], launch.is_detached
        self._directory = Path(launch.directory)
        program = Program.load(config, "host")
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
        self._operator = OperatorLink(
            self._reactor,
            fds,
            on_command=self._command,
            on_gone=self._operator_gone,
            pending=pending,
            is_detached=launch.is_detached,
        )
        self._port = HostPort(launch, reactor=self._reactor, on_due=self._session_due)
        self._session = self._port.session
        self._recorder = RunRecorder(self._directory, config, source=HOST, t_s=self._port.t_s)
        self._half = HostHalf(program.make, self._recorder.say)
        self._context = self._make_context(program.parameters)
        self._report = HostReport(config.time.duration_s)
        # Infinite is never: each timer is made once and moved.
        self._plugin_timer = self._reactor.call_at(math.inf, self._plugin_due)
        self._progress_timer = self._reactor.call_at(math.inf, self._progress)
        self._is_set_up = False
        self._awaits_jobs = False
        self._takes_data = True

    def _make_context(self, parameters: Any) -> JobContext:
        context = JobContext(
            name=HOST,
            config=self._config,
            parameters=parameters,
            recorder=self._recorder,
            now_s=self._port.now_s,
            send=self._port.send,
        )
        context.submit = self._jobs.submit
        context.wake = self._wake
        return context

    def run(self) -> int:
        """Run to the end and return the process's exit code."""
        config = self._config
        if self._is_detached:
            # Nobody is left who would end a loop that hangs in a plug-in.
            extend(_longest_s(config) + HANG_GRACE_S)
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        else:
            end_after_hang_up(self._line_fd, config.timeouts.shutdown_s + HANG_GRACE_S)
        outlive_parent()
        on_signal = self._reactor.on_signal
        tell_stack_on(signal.SIGTERM, lambda: on_signal(signal.SIGTERM, self._terminated))
        on_signal(signal.SIGINT, lambda: None)  # a terminal's Ctrl-C is the operator's
        self._recorder.start()
        self._report.scheduling = apply_scheduling(config.scheduling, is_host=True).to_mapping()
        socket = self._port.socket
        for warning in filter(None, (socket.warning, self._report.scheduling.get("warning"))):
            self._log("warning", str(warning))
        self._reactor.add_reader(socket.fileno(), self._readable)
        address, port = socket.address[:2]
        self._operator.emit({"event": "listening", "address": address, "port": port})
        self._operator.emit({"event": "state", "state": self._session.state.value})
        self._progress_timer.reschedule(monotonic() + PROGRESS_INTERVAL_S)
        self._pump()
        self._reactor.run()
        return self._close()

    # The loop's callbacks ----------------------------------------------------------------------

    def _readable(self) -> None:
        # One datagram, and back to the loop, which looks for more: most often there is one.
        received = self._port.socket.receive_from()
        if received is None:
            return
        message = self._session.receive_data(*received, monotonic())
        if message is not None and self._takes_data:
            self._call("receive", *message)
            if not self._port.must_pump:
                return
        self._pump()

    def _session_due(self) -> None:
        # What waits in the socket is heard before anybody is blamed for silence.
        for data, address in self._port.socket.receive_all():
            self._session.receive_datagram(data, address, monotonic())
        self._session.handle_timer(monotonic())
        self._pump()

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        while (event := self._session.next_event()) is not None:
            self._handle(event)
        self._port.must_pump = False
        self._port.flush()
        if self._port.is_in(HostState.EXIT):
            self._reactor.stop()
        else:
            self._port.arm()

    def _handle(self, event: told.HostSessionEvent) -> None:
        if isinstance(event, told.DataReceived):
            if self._takes_data:
                self._call("receive", event.agent, event.payload)
        elif isinstance(event, told.StateEntered):
            self._recorder.event("state", state=event.state.value)
            self._operator.emit({"event": "state", "state": event.state.value})
        elif isinstance(event, told.AgentMoved):
            self._agent_moved(event)
        elif isinstance(event, told.AgentsReady):
            self._set_up()
        elif isinstance(event, told.AgentsSimulationReady):
            self._start()
        elif isinstance(event, told.AgentLost):
            self._agent_lost(event)
        elif isinstance(event, told.AgentRejoining):
            self._send_setup(event.agent)
        elif isinstance(event, told.AgentRejoined):
            self._agent_rejoined(event.agent)
        elif isinstance(event, told.AgentsComplete):
            self._complete()
        elif isinstance(event, told.EmergencyDeclared):
            self._emergency(event)
        elif isinstance(event, told.SyncDeadlineBroken):
            late_s = event.broken.late_s
            self._recorder.event("sync_deadline_broken", agent=event.agent, late_s=late_s)
        else:
            self._agents_stopped(event.missing)

    # Carrying out ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        if not self._port.is_in(HostState.SIMULATION_SETUP):
            return  # an agent's last words came right behind its hello
        self._call("setup", self._context)
        self._is_set_up = True
        for agent in self._session.agents_in(Phase.LOST):
            if agent in self._report.lost:  # else the word of it comes just behind
                self._tell_lost(agent)
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
        self._port.t0_s = t0_s = monotonic() + lead_s
        self._report.t0_utc = utc_at_iso(lead_s)
        self._recorder.set_t0(self._report.t0_utc)
        self._session.start(t0_s, self._config.time.duration_s, now_s)
        self._call("start", -lead_s)
        self._plugin_due()

    def _plugin_due(self) -> None:
        if not self._port.is_in(HostState.SIMULATION_START):
            return
        self._guard(self._half.call_timer, self._port.now_s(), doing="timer")
        self._arm_plugin_timer()
        self._pump()

    def _wake(self, t_s: float) -> None:
        self._half.wake(t_s)
        self._arm_plugin_timer()

    def _arm_plugin_timer(self) -> None:
        t0_s, next_s = self._port.t0_s, self._half.next_s
        due_s = math.inf if t0_s is None or next_s is None else t0_s + next_s
        self._plugin_timer.reschedule(due_s)

    def _job_done(self, job: int, future: Future[Any]) -> None:
        if not self._takes_data:
            return  # too late for the summary
        self._guard(self._half.take_job, job, future, doing="result")
        self._continue_setup()
        self._pump()

    def _complete(self) -> None:
        self._report.completed(self._port.now_s())
        self._takes_data = False  # what comes from now on is too late for the summary
        self._report.simulation = self._call("finish") or {}
        if self._port.is_in(HostState.SIMULATION_COMPLETE):
            self._session.order_stop(monotonic())

    def _emergency(self, event: told.EmergencyDeclared) -> None:
        who, reason = event.who, event.reason
        self._takes_data = False
        wait_s = HANG_UP_WAIT_S if OPERATOR_SIDE_GONE in reason else 0.0
        if who in self._session.peers and self._operator.has_hung_up(wait_s):
            # An agent that ended with its operator may be heard before the operator's own silence.
            who, reason, self._report.ending_status = "operator", OPERATOR_GONE, "aborted"
        self._report.fail(who, reason)
        self._recorder.event("emergency", who=who, reason=reason)
        self._log("critical", f"emergency shutdown: {who}: {reason}")

    def _agents_stopped(self, missing: tuple[str, ...]) -> None:
        if missing:
            self._log("error", f"{', '.join(missing)}: no word that records are closed")
            self._recorder.event("not_stopped", agents=list(missing))
            self._report.not_stopped = missing
        self._jobs.close()
        health = stop_sampler(self._sampler, timeout_s=SAMPLER_TIMEOUT_S)
        self._session.cleaned_up()
        now_s = monotonic()
        counts = self._recorder.close(self._config.timeouts.shutdown_s)
        self._report.records = {**counts.to_mapping(), "health": health}
        self._session.records_closed(now_s)

    def _agent_moved(self, event: told.AgentMoved) -> None:
        peer = self._session.peers[event.agent]
        moved = {
            "agent": event.agent,
            "state": event.phase.value,
            "reason": event.reason,
            "incarnation": len(peer.incarnations_seen),
        }
        self._recorder.event("agent", **moved)
        self._operator.emit({"event": "agent", **moved})

    def _agent_lost(self, event: told.AgentLost) -> None:
        self._report.lost[event.agent] = event.reason
        self._log("error", f"{event.agent} is lost: {event.reason}")
        if self._is_set_up:  # else it is told of as soon as it can take it
            self._tell_lost(event.agent)

    def _tell_lost(self, agent: str) -> None:
        if self._takes_data and self._config.on_agent_loss == "continue":
            self._call("agent_lost", agent, self._report.lost[agent])

    def _agent_rejoined(self, agent: str) -> None:
        self._log("info", f"{agent} has rejoined at t = {self._port.now_s():.2f} s")
        self._recorder.event("agent_rejoined", agent=agent)
        if self._takes_data:
            self._call("agent_rejoined", agent)

    # Towards the operator -----------------------------------------------------------------------

    def _command(self, command: Mapping[str, Any]) -> None:
        if command.get("command") == "stop":
            reason = str(command.get("reason", "stopped by the operator"))
            self._end("operator", reason, str(command.get("status", "interrupted")))
        elif command.get("command") == "agent_exited":
            agent, how = str(command.get("agent")), str(command.get("how"))
            pid = command.get("pid")
            pid = None if pid is None else int(pid)
            self._session.agent_exited(agent, how, monotonic(), pid=pid)
            self._pump()

    def _operator_gone(self) -> None:
        # Waiting for agents, the sampler's close, the records: each has its own deadline.
        extend(2 * self._config.timeouts.shutdown_s + SAMPLER_TIMEOUT_S + HANG_GRACE_S)
        self._end("operator", OPERATOR_GONE, "aborted")

    def _terminated(self) -> None:
        """End on SIGTERM, which does not come from the operator: it has a line of its own."""
        self._end(HOST, "ended by SIGTERM", "interrupted")

    def _end(self, who: str, reason: str, status: str) -> None:
        if self._session.state in HOST_LIVE:
            self._report.ending_status = status
            self._session.emergency(who, reason, monotonic())
            self._pump()

    def _progress(self) -> None:
        self._progress_timer.reschedule(monotonic() + PROGRESS_INTERVAL_S)
        duration_s = self._config.time.duration_s
        self._operator.emit(progress_report(self._session, self._port.t_s(), duration_s))
        problems = {HOST: self._recorder.problem}
        problems |= {name: peer.report.get("problem") for name, peer in self._session.peers.items()}
        for name, problem in self._report.untold(problems):
            whose = "" if name == HOST else f"{name}: "
            self._log("error", f"{whose}records are being lost: {problem}")

    def _log(self, level: str, text: str) -> None:
        self._recorder.say(level, text)
        self._operator.emit({"event": "log", "level": level, "source": HOST, "text": text})

    def _close(self) -> int:
        network = self._port.socket.counters()
        result = self._report.result(self._session, network=network)
        code = hand_over(result, self._directory, self._operator)
        self._port.socket.close()
        self._reactor.close()
        return code

    # Towards the simulation ------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call the plug-in; what it raises, or returns against its contract, ends the run by name."""
        return self._guard(self._half.call, name, *arguments, doing=name)

    def _guard(self, call: Any, *arguments: Any, doing: str) -> Any:
        began_s = monotonic()
        try:
            return call(*arguments)
        except HalfFailed as failure:
            self._port.must_pump = True
            self._session.emergency(HOST, str(failure), monotonic())
            return None
        finally:
            took_s = monotonic() - began_s
            if took_s > SLOW_CALL_S and self._port.is_in(HostState.SIMULATION_START):
                self._log(
                    "warning",
                    f"{self._half.name}.{doing} took {took_s:.1f} s, and the host stood still;"
                    " hand long work to context.submit",
                )


def _longest_s(config: RunConfig) -> float:
    """Return how long a run may take at most: all its waits, one behind the other, s."""
    t = config.timeouts
    setup_s = t.agents_ready_s + t.host_setup_s + t.agent_setup_s + t.start_lead_s
    return setup_s + config.time.duration_s + t.complete_s + 4 * t.shutdown_s + SAMPLER_TIMEOUT_S
