"""One agent inside a loop: its socket, its session, its pace, its half of the simulation, its records."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from madns_runtime import __version__
from madns_runtime.agent_records import AgentRecords
from madns_runtime.config import AgentLaunch
from madns_runtime.context import (
    RunContext,
    check_deadline,
    check_service,
    clean_text,
    describe_exception,
)
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.health.probe import process_usage
from madns_runtime.plugin import returned
from madns_runtime.plugin.api import HOST, AgentSimulation, Tick
from madns_runtime.protocol import agent_session as told
from madns_runtime.protocol.agent_session import AgentIdentity, AgentSession
from madns_runtime.protocol.codec import NO_DATA
from madns_runtime.protocol.link import LinkLimits
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import AgentState
from madns_runtime.protocol.wire import Wire
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.reactor.udp import UdpSocket
from madns_runtime.timing.clock import utc_at_iso
from madns_runtime.timing.rate import Pacer, stagger

T = TypeVar("T")

BEST, SYNC = Service.BEST, Service.SYNC

DRAIN_S = 0.1
"""After the last tick's period an agent listens this much longer for what is still under way."""
AGENT_RECEIVE_BUFFER_BYTES = 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What every agent of a process runs, loaded once, and in which life."""

    simulation: Callable[[], AgentSimulation]
    parameters: Any
    incarnation: int = 1
    """Which process of these agents this is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How an agent ended."""

    as_ordered: bool
    """By the host's order at the end of a run."""
    reason: str = ""
    may_restart: bool = False
    """It failed by itself while the run may go on: another try makes sense."""


class AgentRunner:
    """
    Runs one agent in a loop that others may share.

    Args:
        name: The agent's name.
        launch: The run.
        program: What it runs.
        reactor: The loop.
        on_ended: Called once, with how it ended.
    """

    def __init__(
        self,
        name: str,
        launch: AgentLaunch,
        program: Program,
        *,
        reactor: Reactor,
        on_ended: Callable[[str, Outcome], None],
    ) -> None:
        config = launch.config
        self.name = name
        self._config = config
        self._program = program
        self._reactor = reactor
        self._on_ended = on_ended
        self._index = config.agents.resolved_names().index(name)
        self._records = AgentRecords(
            Path(launch.directory) / "agents" / name,
            config,
            source=name,
            t_s=self._t_s_or_none,
            incarnation=program.incarnation,
        )
        self._record = self._records.recorder.record
        self._t0_host_s: float | None = None
        self._socket = UdpSocket.connect(
            launch.host_address,
            launch.host_port,
            receive_buffer_bytes=AGENT_RECEIVE_BUFFER_BYTES,
        )
        self._session = AgentSession(
            AgentIdentity(
                name=name,
                index=self._index + 1,
                incarnation=int.from_bytes(os.urandom(4)),
                runtime_version=__version__,
                pid=os.getpid(),
            ),
            Wire(
                run_key=bytes.fromhex(launch.run_key_hex),
                session=bytes.fromhex(launch.session_hex),
                limits=LinkLimits(receive_window_bytes=self._socket.receive_buffer_bytes // 4),
            ),
            timeouts=config.timeouts,
            report=self._report,
            now_s=reactor.now_s(),
        )
        self._simulation = program.simulation()
        self._simulation_name = type(self._simulation).__name__
        self._pacer: Pacer | None = None
        self._step = self._simulation.step
        self._receive = self._simulation.receive
        self._must_pump = False
        self._period_s = 1.0 / config.agents.tick_hz
        self._first: tuple[float, float] | None = None
        self._newest: tuple[float, float] | None = None
        # Infinite is never: each timer is made once and moved.
        self._session_timer = reactor.call_at(math.inf, self._session_due)
        self._tick_timer = reactor.call_at(math.inf, self._tick)
        self._end_timer = reactor.call_at(math.inf, self._finish_run)
        self._usage_timer = reactor.call_at(math.inf, self._record_usage)
        self._scheduling: dict[str, Any] = {}
        self._outcome = Outcome(as_ordered=False, reason="did not end")
        self._is_closed = False
        self._takes_data = True

    def start(self) -> None:
        """Begin: says hello at once."""
        self._records.recorder.start()
        self._records.event("start", pid=os.getpid())
        if self._socket.warning:
            self._records.log("warning", self._socket.warning)
        self._reactor.add_reader(self._socket.fileno(), self._readable)
        self._pump()

    def set_scheduling(self, grant: Mapping[str, Any]) -> None:
        """Take note of what the kernel granted to the loop."""
        self._scheduling = dict(grant)
        self._records.event("scheduling", **self._scheduling)
        if grant.get("warning"):
            self._records.log("warning", str(grant["warning"]))

    def emergency(self, reason: str) -> None:
        """End at once, keep the records, tell the host."""
        self._session.emergency(reason, self._reactor.now_s())
        self._pump()

    # The loop's callbacks ----------------------------------------------------------------------

    def _readable(self) -> None:
        # One datagram, and back to the loop, which looks for more: most often there is one.
        data = self._socket.receive()
        if data is None:
            return
        message = self._session.receive_data(data, monotonic())
        if message is not NO_DATA and self._takes_data:
            try:
                self._receive(message)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
                self._plugin_failed("receive", error)
            if not self._must_pump:
                return
        self._pump()

    def _session_due(self) -> None:
        # What waits in the socket is heard before the host is blamed for silence.
        for data, _ in self._socket.receive_all():
            self._session.receive_datagram(data, self._reactor.now_s())
        self._session.handle_timer(self._reactor.now_s())
        self._pump()

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        session = self._session
        while (event := session.next_event()) is not None:
            self._handle(event)
        while (broken := session.next_broken_deadline()) is not None:
            self._records.event("sync_deadline_broken", late_s=broken.late_s)
        if self._is_closed:
            return
        self._send_datagrams()

    def _send_datagrams(self) -> None:
        self._must_pump = False
        session, send = self._session, self._socket.send
        for data in session.datagrams_to_send(self._reactor.now_s()):
            send(data)
        due_s = session.get_timer()
        self._session_timer.reschedule(math.inf if due_s is None else due_s)

    def _handle(self, event: told.AgentSessionEvent) -> None:
        if isinstance(event, told.DataReceived):
            if self._takes_data:
                self._call("receive", self._simulation.receive, event.payload)
        elif isinstance(event, told.ClockEstimated):
            self._record_clock()
        elif isinstance(event, told.StateEntered):
            self._records.event("state", state=event.state.value)
        elif isinstance(event, told.SetupReceived):
            self._set_up(event.initial)
        elif isinstance(event, told.StartReceived):
            self._start_run(event.t0_host_s)
        elif isinstance(event, told.StopReceived):
            self._outcome = Outcome(as_ordered=True)
            self._close_records()
        elif isinstance(event, told.EmergencyDeclared):
            self._end_early(f"{event.who}: {event.reason}", is_own=event.who == self.name)
        elif isinstance(event, told.ExpelledFromRun):
            self._end_early(f"expelled by the host: {event.reason}", is_own=True)
        else:
            self._close()

    # Carrying out ------------------------------------------------------------------------------

    def _set_up(self, initial: Any) -> None:
        context = RunContext(
            name=self.name,
            config=self._config,
            parameters=self._program.parameters,
            recorder=self._records.recorder,
            now_s=self._simulated_s,
            send=self._send,
        )
        self._call("setup", self._simulation.setup, context, initial)
        if self._session.state is AgentState.SIMULATION_SETUP:
            self._session.setup_finished(self._reactor.now_s())

    def _start_run(self, t0_host_s: float) -> None:
        self._t0_host_s = t0_host_s
        agents = self._config.agents
        phase_s = 0.0
        if agents.phase == "staggered":
            phase_s = stagger(self._index, agents.count, agents.tick_hz)
        self._pacer = Pacer(
            tick_hz=agents.tick_hz,
            phase_s=phase_s,
            duration_s=self._config.time.duration_s,
            tolerance_s=self._config.deadline.tolerance_ms * 1e-3,
        )
        now_s = self._simulated_s()
        self._records.recorder.set_t0(utc_at_iso(-now_s))
        self._records.event("phase", phase_s=phase_s)
        if now_s > 0:
            self._pacer.skip_to(now_s)
        freeze_garbage()  # what set-up made stays: no collection walks it in mid-run
        self._arm_tick()
        process_usage()
        self._usage_timer.reschedule(self._reactor.now_s() + self._config.health.period_s)

    def _arm_tick(self) -> None:
        pacer = self._pacer
        if pacer is None:
            return
        deadline_s = pacer.next_deadline_s()
        if deadline_s is None:
            end_s = self._config.time.duration_s + DRAIN_S
            self._end_timer.reschedule(self._local_s(end_s))
        else:
            self._tick_timer.reschedule(self._local_s(deadline_s))

    def _tick(self) -> None:
        pacer = self._pacer
        if pacer is None or self._session.state is not AgentState.RUN_SIMULATION:
            return
        began_s = self._simulated_s()
        timing = pacer.begin(began_s)
        if timing is not None:
            if self._first is None:
                self._first = (timing.t_s, began_s)
            self._newest = (timing.t_s, began_s)
            tick = Tick(
                timing.index,
                timing.t_s,
                self._period_s,
                timing.lateness_s,
                timing.missed,
                timing.deadline_s,
            )
            try:
                self._step(tick)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
                self._plugin_failed("step", error)
                self._pump()
                return
            if self._must_pump:
                # What the step sent leaves before anything else is done.
                self._send_datagrams()
            margin_s = pacer.end(self._simulated_s())
            self._record(
                "ticks",
                (
                    timing.index,
                    int(timing.lateness_s * 1e6),
                    int(margin_s * 1e6),
                    timing.missed,
                ),
            )
        self._arm_tick()

    def _finish_run(self) -> None:
        if self._pacer is None or self._session.state is not AgentState.RUN_SIMULATION:
            return
        self._pacer.finish(self._simulated_s())
        self._takes_data = False  # what comes from now on is too late for the summary
        summary = self._call("finish", self._simulation.finish, check=returned.summary)
        if self._session.state is AgentState.RUN_SIMULATION:
            self._session.run_finished(self._summary(summary), self._reactor.now_s())
        self._pump()

    def _summary(self, simulation: Any) -> dict[str, Any]:
        clock, now_s = self._session.clock, self._reactor.now_s()
        return {
            "ticks": dict(self._pacer.summary()) if self._pacer else {},
            "rtf": self._real_time_factor(),
            "clock": {
                "offset_us": clock.offset_s(now_s) * 1e6,
                "drift_ppm": clock.drift_ppm,
                "uncertainty_us": clock.uncertainty_s(now_s) * 1e6,
            }
            if clock.is_valid
            else None,
            "scheduling": self._scheduling,
            "simulation": simulation or {},
        }

    def _real_time_factor(self) -> float | None:
        """Simulated seconds per wall second between the first and the newest tick."""
        if self._first is None or self._newest is None or self._newest[1] <= self._first[1]:
            return None
        return round((self._newest[0] - self._first[0]) / (self._newest[1] - self._first[1]), 9)

    def _end_early(self, reason: str, *, is_own: bool) -> None:
        self._outcome = Outcome(as_ordered=False, reason=reason, may_restart=is_own)
        self._takes_data = False
        for timer in (self._tick_timer, self._end_timer, self._usage_timer):
            timer.cancel()
        self._records.event("emergency", reason=reason)
        self._records.log("critical", f"emergency shutdown: {reason}")
        self._close_records()

    def _close_records(self) -> None:
        messages = self._session.link.counters.to_mapping()
        counts = self._records.close(self._config.timeouts.shutdown_s)
        records = {
            **counts,
            "messages": messages,
            "network": self._socket.counters(),
            "held_dropped": self._session.held_dropped_count,
        }
        self._session.records_closed(records, self._reactor.now_s())

    def _close(self) -> None:
        self._is_closed = True
        self._send_datagrams()
        for timer in (self._session_timer, self._tick_timer, self._end_timer, self._usage_timer):
            timer.cancel()
        self._reactor.remove_reader(self._socket.fileno())
        self._socket.close()
        self._on_ended(self.name, self._outcome)

    # Records ---------------------------------------------------------------------------------------

    def _record_clock(self) -> None:
        if self._session.state is AgentState.RUN_SIMULATION:
            self._records.clock(self._session.clock, self._reactor.now_s())

    def _record_usage(self) -> None:
        if self._session.state is AgentState.RUN_SIMULATION:
            self._records.usage()
            due_s = self._reactor.now_s() + self._config.health.period_s
            self._usage_timer.reschedule(due_s)

    def _report(self) -> Mapping[str, Any]:
        report = self._records.report()
        if self._pacer is not None:
            summary = self._pacer.summary()
            report.update(
                ticks=summary["run"],
                missed=summary["missed"],
                late_p50_us=summary["lateness_us_p50"],
                late_p99_us=summary["lateness_us_p99"],
                rtf=self._real_time_factor(),
                lost=self._session.link.counters.best.lost,
            )
        return report

    # Towards the simulation ------------------------------------------------------------------------

    def _simulated_s(self) -> float:
        if self._t0_host_s is None:
            return -self._config.timeouts.start_lead_s
        return self._session.clock.to_host_s(monotonic()) - self._t0_host_s

    def _t_s_or_none(self) -> float | None:
        return None if self._t0_host_s is None else self._simulated_s()

    def _local_s(self, t_s: float) -> float:
        t0_s = self._t0_host_s
        if t0_s is None:
            raise MadnsError("simulated time has not begun")
        return self._session.clock.to_local_s(t0_s + t_s)

    def _send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        if to != HOST:
            raise PluginError(f"an agent sends to {HOST!r}, not to {to!r}")
        now_s = monotonic()
        if deadline_s is not None:
            check_deadline(service, is_running=self._t0_host_s is not None)
        if service is BEST:
            datagram = self._session.seal_data(message, now_s)
            if datagram is not None:
                self._socket.send(datagram)
                return
        due_s = None if deadline_s is None else self._local_s(deadline_s)
        check_service(service)
        self._session.send(message, service, now_s, deadline_s=due_s)
        self._must_pump = True
        if service is SYNC:
            self._send_datagrams()

    def _call(
        self,
        name: str,
        method: Callable[..., Any],
        *arguments: Any,
        check: Callable[[Any], T] | None = None,
    ) -> T | None:
        """Call the plug-in; what it raises, or returns against its contract, ends this agent by name."""
        try:
            value = method(*arguments)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
            self._plugin_failed(name, error)
            return None
        try:
            return None if check is None else check(value)
        except PluginError as error:
            reason = f"{self._simulation_name}.{name} returned {clean_text(str(error))}"
            self._session.emergency(reason, self._reactor.now_s())
            self._must_pump = True
            return None

    def _plugin_failed(self, name: str, error: BaseException) -> None:
        self._must_pump = True
        self._records.failure(error)
        reason = describe_exception(error, f"{self._simulation_name}.{name}")
        self._session.emergency(reason, self._reactor.now_s())
