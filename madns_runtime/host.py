"""
The host process: one loop that joins socket, session, simulation, executor and records.

Started by `cosmos run`, which writes a HostLaunch to standard input and reads events from standard
output. It ends by itself when that line closes.
"""

from __future__ import annotations

import contextlib
import math
import os
import signal
import sys
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

import orjson

from madns_runtime.config import HostLaunch, RunConfig, from_mapping
from madns_runtime.context import (
    JobContext,
    check_deadline,
    check_service,
    clean_text,
    describe_exception,
)
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.executor import JobFailed, JobRunner, make_executor
from madns_runtime.health.sampler import SAMPLER_TIMEOUT_S, start_sampler, stop_sampler
from madns_runtime.host_result import HostReport, progress_report
from madns_runtime.plugin import returned
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.registry import load_half, parse_parameters, resolve
from madns_runtime.processes import register
from madns_runtime.protocol import host_events as told
from madns_runtime.protocol.host_events import Phase
from madns_runtime.protocol.host_session import HostSession
from madns_runtime.protocol.link import LinkLimits
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import HOST_LIVE, HostState
from madns_runtime.protocol.wire import Wire
from madns_runtime.reactor.lines import OPERATOR_SIDE_GONE, OperatorLink, read_launch
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import apply as apply_scheduling
from madns_runtime.reactor.scheduling import die_with_parent, freeze_garbage, outlive_parent
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.reactor.watchdog import end_after_hang_up, extend
from madns_runtime.recording.records import EVENTS, LOG
from madns_runtime.recording.writer import Recorder
from madns_runtime.timing.clock import utc_at_iso, utc_now_iso

T = TypeVar("T")

BEST, SYNC = Service.BEST, Service.SYNC

PROGRESS_INTERVAL_S = 0.5
SLOW_CALL_S = 0.5
"""A call of the plug-in that takes this long while the run is on is told: agents lose a silent host."""
FLUSH_TIMEOUT_S = 5.0
PACE_TOTAL_BYTES_PER_S = 100e6
"""What all agents together are sent in RELIABLE fragments, beyond bursts: most of a gigabit network."""
OPERATOR_GONE = "the operator's process is gone"
HANG_UP_WAIT_S = 0.5
"""On a busy computer, from the end of a dead operator's line to an agent until the end of that to the host."""
HANG_GRACE_S = 2.0
"""Beyond the time for shutdown: a loop that hangs in a plug-in, without an operator, ends by force."""
RESULT_BYTES_MAX = 1024 * 1024
"""A longer result is not sent to the operator, only named."""
RESULT_FILE = "result.json"
"""Beside the host's records: the result, also of a run whose operator is gone, stopped or slow."""


def _as_it_is(value: Any) -> Any:
    return value


class HostRuntime:
    """
    One run, seen from the host.

    Args:
        launch: What to run.
        fds: Where the operator's commands come from and events go to.
        pending: What had already come behind the launch document.
    """

    def __init__(self, launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> None:
        config = launch.config
        self._config = config
        self._names = config.agents.resolved_names()
        base = Path(config.base_directory)
        descriptor = resolve(config.simulation, base)
        parameters = parse_parameters(descriptor, config.parameters)
        self._simulation = load_half(descriptor, "host", base)()
        self._simulation_name = type(self._simulation).__name__
        self._directory = directory = Path(launch.directory)
        self._sampler = start_sampler(
            directory,
            run=config.run,
            machine=HOST,
            settings=config.health,
            recording=config.recording,
        )
        executor = make_executor(config.executor)  # both fork: before every thread
        self._reactor = Reactor()
        self._jobs = JobRunner(self._reactor, executor, self._job_done)
        self._recorder = Recorder(directory, run=config.run, source=HOST, settings=config.recording)
        self._recorder.open_stream(EVENTS)
        self._recorder.open_stream(LOG)
        self._line_fd = fds[0]
        self._operator = OperatorLink(
            self._reactor,
            fds,
            on_command=self._command,
            on_gone=self._operator_gone,
            pending=pending,
            is_detached=launch.is_detached,
        )
        self._is_detached = launch.is_detached
        self._socket = UdpSocket.bind(
            config.network.address,
            config.network.port,
            receive_buffer_bytes=config.network.receive_buffer_bytes,
        )
        limits = LinkLimits(
            receive_window_bytes=window_bytes(self._socket.receive_buffer_bytes, len(self._names)),
            pace_bytes_per_s=PACE_TOTAL_BYTES_PER_S / len(self._names),
        )
        self._session = HostSession(
            self._names,
            Wire(
                run_key=bytes.fromhex(launch.run_key_hex),
                session=bytes.fromhex(launch.session_hex),
                limits=limits,
            ),
            timeouts=config.timeouts,
            on_agent_loss=config.on_agent_loss,
            now_s=self._reactor.now_s(),
        )
        self._context = JobContext(
            name=HOST,
            config=config,
            parameters=parameters,
            recorder=self._recorder,
            now_s=self._simulated_s,
            send=self._send,
        )
        self._context.submit = self._jobs.submit
        self._context.wake = self._wake
        self._report = HostReport(config.time.duration_s)
        self._t0_s: float | None = None
        # Infinite is never: each timer is made once and moved.
        self._session_timer = self._reactor.call_at(math.inf, self._session_due)
        self._plugin_timer = self._reactor.call_at(math.inf, self._plugin_due)
        self._progress_timer = self._reactor.call_at(math.inf, self._progress)
        self._awaits_jobs = False
        self._must_pump = False
        self._takes_data = True
        self._is_terminated = False

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
        self._reactor.on_signal(signal.SIGTERM, self._terminated)
        self._reactor.on_signal(
            signal.SIGINT, lambda: None
        )  # a terminal's Ctrl-C is the operator's
        self._recorder.start()
        self._report.scheduling = apply_scheduling(config.scheduling, is_host=True).to_mapping()
        for warning in filter(None, (self._socket.warning, self._report.scheduling.get("warning"))):
            self._log("warning", str(warning))
        self._reactor.add_reader(self._socket.fileno(), self._readable)
        address, port = self._socket.address[:2]
        self._operator.emit({"event": "listening", "address": address, "port": port})
        self._operator.emit({"event": "state", "state": self._session.state.value})
        self._progress_timer.reschedule(self._reactor.now_s() + PROGRESS_INTERVAL_S)
        self._pump()
        self._reactor.run()
        return self._close()

    # The loop's callbacks ----------------------------------------------------------------------

    def _readable(self) -> None:
        # One datagram, and back to the loop, which looks for more: most often there is one.
        received = self._socket.receive_from()
        if received is None:
            return
        message = self._session.receive_data(*received, monotonic())
        if message is not None and self._takes_data:
            self._call("receive", self._simulation.receive, *message)
            if not self._must_pump:
                return
        self._pump()

    def _session_due(self) -> None:
        # What waits in the socket is heard before anybody is blamed for silence.
        for data, address in self._socket.receive_all():
            self._session.receive_datagram(data, address, self._reactor.now_s())
        self._session.handle_timer(self._reactor.now_s())
        self._pump()

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        session = self._session
        while (event := session.next_event()) is not None:
            self._handle(event)
        self._must_pump = False
        self._send_datagrams()
        if session.state is HostState.EXIT:
            self._reactor.stop()
            return
        due_s = session.get_timer()
        self._session_timer.reschedule(math.inf if due_s is None else due_s)

    def _send_datagrams(self) -> None:
        for data, address in self._session.datagrams_to_send(monotonic()):
            self._socket.send(data, address)

    def _handle(self, event: told.HostSessionEvent) -> None:
        if isinstance(event, told.DataReceived):
            if self._takes_data:
                self._call("receive", self._simulation.receive, event.agent, event.payload)
        elif isinstance(event, told.StateEntered):
            self._event("state", state=event.state.value)
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
            self._log("info", f"{event.agent} has rejoined at t = {self._simulated_s():.2f} s")
            self._event("agent_rejoined", agent=event.agent)
            self._call("agent_rejoined", self._simulation.agent_rejoined, event.agent)
        elif isinstance(event, told.AgentsComplete):
            self._complete()
        elif isinstance(event, told.EmergencyDeclared):
            self._emergency(event)
        elif isinstance(event, told.SyncDeadlineBroken):
            self._event("sync_deadline_broken", agent=event.agent, late_s=event.broken.late_s)
        else:
            self._agents_stopped(event.missing)

    # Carrying out ------------------------------------------------------------------------------

    def _set_up(self) -> None:
        if self._session.state is not HostState.SIMULATION_SETUP:
            return  # an agent's last words came right behind its hello
        self._call("setup", self._simulation.setup, self._context)
        self._awaits_jobs = True
        self._continue_setup()

    def _continue_setup(self) -> None:
        """Once every job that set-up submitted is done, the agents get their initial data."""
        if not self._awaits_jobs or self._jobs.pending_count:
            return
        self._awaits_jobs = False
        initial = {}
        for agent in self._session.agents_in(Phase.READY):
            if not self._is_in(HostState.SIMULATION_SETUP):
                return  # the call before raised
            initial[agent] = self._initial_data(agent)
        if self._is_in(HostState.SIMULATION_SETUP):
            self._session.setup_finished(initial, self._reactor.now_s())

    def _is_in(self, state: HostState) -> bool:
        return self._session.state is state

    def _initial_data(self, agent: str) -> Any:
        call = self._simulation.initial_data
        return self._call("initial_data", call, agent, check=returned.initial_data)

    def _send_setup(self, agent: str) -> None:
        initial = self._initial_data(agent)
        if self._session.state in HOST_LIVE:
            self._session.send_setup(agent, initial, self._reactor.now_s())

    def _start(self) -> None:
        if self._session.state is not HostState.HOST_SIMULATION_READY:
            return  # an agent's last words came right behind its readiness
        now_s = self._reactor.now_s()
        lead_s = self._config.timeouts.start_lead_s
        freeze_garbage()
        self._t0_s = self._reactor.now_s() + lead_s
        self._report.t0_utc = utc_at_iso(lead_s)
        self._recorder.set_t0(self._report.t0_utc)
        self._session.start(self._t0_s, self._config.time.duration_s, now_s)
        self._call("start", self._simulation.start, -lead_s)
        self._plugin_due()

    def _plugin_due(self) -> None:
        if self._session.state is not HostState.SIMULATION_START:
            return
        timer = self._simulation.timer
        next_s = self._call("timer", timer, self._simulated_s(), check=returned.next_time)
        if next_s is not None and self._t0_s is not None:
            self._plugin_timer.reschedule(self._t0_s + next_s)
        self._pump()

    def _wake(self, t_s: float) -> None:
        due_s = math.inf if self._t0_s is None else self._t0_s + t_s
        if not self._plugin_timer.is_pending or due_s < self._plugin_timer.when_s:
            self._plugin_timer.reschedule(due_s)

    def _job_done(self, job: int, future: Future[Any]) -> None:
        error = future.exception()
        if error is not None:
            doing = f"{self._simulation_name}: job {job}"
            is_told = isinstance(error, JobFailed)
            reason = f"{doing}: {error}" if is_told else describe_exception(error, doing)
            self._plugin_failed(reason, error)
        else:
            self._call("result", self._simulation.result, job, future.result())
        self._continue_setup()
        self._pump()

    def _complete(self) -> None:
        self._report.completed(self._simulated_s())
        self._takes_data = False  # what comes from now on is too late for the summary
        finish = self._simulation.finish
        self._report.simulation = self._call("finish", finish, check=returned.summary) or {}
        if self._session.state is HostState.SIMULATION_COMPLETE:
            self._session.order_stop(self._reactor.now_s())

    def _emergency(self, event: told.EmergencyDeclared) -> None:
        who, reason = event.who, event.reason
        self._takes_data = False
        wait_s = HANG_UP_WAIT_S if OPERATOR_SIDE_GONE in event.reason else 0.0
        if event.who in self._names and self._operator.has_hung_up(wait_s):
            # An agent that ended with its operator may be heard before the operator's own silence.
            who, reason, self._report.ending_status = "operator", OPERATOR_GONE, "aborted"
        self._report.fail(who, reason)
        self._event("emergency", who=who, reason=reason)
        self._log("critical", f"emergency shutdown: {who}: {reason}")

    def _agents_stopped(self, missing: tuple[str, ...]) -> None:
        if missing:
            self._log("error", f"{', '.join(missing)}: no word that records are closed")
            self._event("not_stopped", agents=list(missing))
            self._report.not_stopped = missing
        self._jobs.close()
        health = stop_sampler(self._sampler, timeout_s=SAMPLER_TIMEOUT_S)
        self._session.cleaned_up()
        now_s = self._reactor.now_s()
        self._event("end")
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
        self._event("agent", **moved)
        self._operator.emit({"event": "agent", **moved})

    def _agent_lost(self, event: told.AgentLost) -> None:
        self._report.lost[event.agent] = event.reason
        self._log("error", f"{event.agent} is lost: {event.reason}")
        if self._config.on_agent_loss == "continue":
            self._call("agent_lost", self._simulation.agent_lost, event.agent, event.reason)

    # Towards the operator -----------------------------------------------------------------------

    def _command(self, command: Mapping[str, Any]) -> None:
        if command.get("command") == "stop":
            reason = str(command.get("reason", "stopped by the operator"))
            self._end("operator", reason, str(command.get("status", "interrupted")))
        elif command.get("command") == "agent_exited":
            agent, how = str(command.get("agent")), str(command.get("how"))
            pid = command.get("pid")
            self._session.agent_exited(
                agent, how, self._reactor.now_s(), pid=None if pid is None else int(pid)
            )
            self._pump()

    def _operator_gone(self) -> None:
        # Waiting for agents, the sampler's close, the records: each has its own deadline.
        extend(2 * self._config.timeouts.shutdown_s + SAMPLER_TIMEOUT_S + HANG_GRACE_S)
        self._end("operator", OPERATOR_GONE, "aborted")

    def _terminated(self) -> None:
        """End on SIGTERM, which does not come from the operator: it has a line of its own."""
        self._is_terminated = True
        self._end("host", "ended by SIGTERM", "interrupted")

    def _end(self, who: str, reason: str, status: str) -> None:
        if self._session.state in HOST_LIVE:
            self._report.ending_status = status
            self._session.emergency(who, reason, self._reactor.now_s())
            self._pump()

    def _progress(self) -> None:
        self._progress_timer.reschedule(self._reactor.now_s() + PROGRESS_INTERVAL_S)
        report = progress_report(self._session, self._t_s_or_none(), self._config.time.duration_s)
        self._operator.emit(report)
        problems = {HOST: self._recorder.problem}
        problems |= {name: peer.report.get("problem") for name, peer in self._session.peers.items()}
        for name, problem in problems.items():
            if problem and name not in self._report.problems_told:
                self._report.problems_told.add(name)
                whose = "" if name == HOST else f"{name}: "
                self._log("error", f"{whose}records are being lost: {problem}")

    def _log(self, level: str, text: str) -> None:
        self._recorder.log(level, text, self._t_s_or_none())
        self._operator.emit({"event": "log", "level": level, "source": HOST, "text": text})

    def _event(self, event: str, **values: Any) -> None:
        if self._session.state not in (HostState.WAITING_SERVER_STOP, HostState.EXIT):
            self._recorder.record(
                "events",
                {"t_s": self._t_s_or_none(), "utc": utc_now_iso(), "event": event, **values},
            )

    # Towards the simulation ------------------------------------------------------------------------

    def _simulated_s(self) -> float:
        if self._t0_s is None:
            return -self._config.timeouts.start_lead_s
        return self._reactor.now_s() - self._t0_s

    def _t_s_or_none(self) -> float | None:
        return None if self._t0_s is None else round(self._simulated_s(), 6)

    def _send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        now_s = monotonic()
        if service is BEST:
            sealed = self._session.seal_data(to, message, now_s)
            if sealed is not None:
                self._socket.send(*sealed)
                return
        if to not in self._session.peers:
            raise PluginError(f"no agent is called {to!r}")
        due_s = None
        if deadline_s is not None:
            check_deadline(service, is_running=self._t0_s is not None)
            due_s = (self._t0_s or 0.0) + deadline_s
        check_service(service)
        self._session.send(to, message, service, now_s, deadline_s=due_s)
        self._must_pump = True
        if service is SYNC:
            self._send_datagrams()

    def _call(
        self,
        name: str,
        method: Callable[..., Any],
        *arguments: Any,
        check: Callable[[Any], T] = _as_it_is,
    ) -> T | None:
        """Call the plug-in; what it raises, or returns against its contract, ends the run by name."""
        began_s = monotonic()
        doing = f"{self._simulation_name}.{name}"
        try:
            value = method(*arguments)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
            self._must_pump = True
            self._plugin_failed(describe_exception(error, doing), error)
            return None
        finally:
            took_s = monotonic() - began_s
            if took_s > SLOW_CALL_S and self._session.state is HostState.SIMULATION_START:
                self._log(
                    "warning",
                    f"{self._simulation_name}.{name} took {took_s:.1f} s, and the host stood still;"
                    " hand long work to context.submit",
                )
        try:
            return check(value)
        except PluginError as error:
            self._must_pump = True
            self._plugin_failed(f"{doing} returned {clean_text(str(error))}", error)
            return None

    def _plugin_failed(self, reason: str, error: BaseException) -> None:
        text = "".join(traceback.format_exception(error))
        self._recorder.log("critical", text, self._t_s_or_none())
        self._session.emergency(HOST, reason, self._reactor.now_s())

    def _close(self) -> int:
        network = self._socket.counters()
        result = self._report.result(self._session, network=network)
        result["events_dropped"] = self._operator.dropped_count
        text = orjson.dumps(result, option=orjson.OPT_SERIALIZE_NUMPY)
        is_left = self._leave(text)
        if is_left and len(text) > RESULT_BYTES_MAX:
            self._operator.emit({"event": "finished", "result": None, "file": RESULT_FILE})
        else:
            self._operator.emit({"event": "finished", "result": result})
        self._operator.flush(FLUSH_TIMEOUT_S)
        self._operator.close()
        self._socket.close()
        self._reactor.close()
        return 0 if result["status"] == "complete" else 1

    def _leave(self, text: bytes) -> bool:
        """Write the result beside the records: no operator who is gone, or slow, costs it."""
        path = self._directory / RESULT_FILE
        try:
            path.with_suffix(".tmp").write_bytes(text)
            path.with_suffix(".tmp").replace(path)
        except OSError:  # a full disk, say: then the line to the operator is all there is
            path.with_suffix(".tmp").unlink(missing_ok=True)
            return False
        return True


def _longest_s(config: RunConfig) -> float:
    """Return how long a run may take at most: all its waits, one behind the other, s."""
    t = config.timeouts
    setup_s = t.agents_ready_s + t.host_setup_s + t.agent_setup_s + t.start_lead_s
    return setup_s + config.time.duration_s + t.complete_s + 4 * t.shutdown_s + SAMPLER_TIMEOUT_S


def window_bytes(receive_buffer_bytes: int, peers: int) -> int:
    """Return the window granted to each of *peers*, so that all together fit the socket's buffer."""
    # The kernel charges a small datagram with more than its bytes: half the buffer is kept for that.
    return max(4 * 1400, receive_buffer_bytes // 2 // max(1, peers))


def main() -> None:
    """Entry point of `madns-host`."""
    out_fd = os.dup(1)
    os.dup2(2, 1)  # what a plug-in prints must not mix with the events
    die_with_parent()  # until the loop runs: loading a plug-in may take for ever
    try:
        document, pending = read_launch(0)
        launch = from_mapping(HostLaunch, document)
        with register(launch.config.run, "host", HOST, Path(launch.directory).parent):
            code = _run(launch, (0, out_fd), pending)
    except MadnsError as error:
        code = _fail(out_fd, str(error))
    except BaseException as error:  # noqa: BLE001 - the last frame of a process; it is told below
        traceback.print_exc()
        code = _fail(out_fd, describe_exception(error, "madns-host"))
    sys.stderr.flush()
    os._exit(code)  # no executor's or plug-in's thread may hold the process


def _run(launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> int:
    if launch.config.time.is_lockstep:
        from madns_runtime.lockstep.host import LockstepHost  # a real-time run needs none of it

        return LockstepHost(launch, fds, pending).run()
    return HostRuntime(launch, fds, pending).run()


def _fail(out_fd: int, reason: str) -> int:
    """Tell the operator why there will be no run, or no more of it; returns the exit code."""
    sys.stderr.write(f"madns-host: {reason}\n")
    result = {"status": "failed", "who": HOST, "reason": reason}
    with contextlib.suppress(OSError):  # nobody may be left to hear it
        os.write(out_fd, orjson.dumps({"event": "finished", "result": result}) + b"\n")
    return 1


if __name__ == "__main__":
    main()
