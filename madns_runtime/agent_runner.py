"""One agent inside a loop that others may share: what its session, its pace and its half of the simulation come to."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.agent_port import AgentPort
from madns_runtime.agent_recorder import AgentRecorder
from madns_runtime.config import AgentLaunch, RunConfig
from madns_runtime.context import RunContext
from madns_runtime.half import Half, HalfFailed, Program
from madns_runtime.plugin.api import Tick
from madns_runtime.protocol import agent_events as told
from madns_runtime.protocol.codec import NO_DATA
from madns_runtime.protocol.states import AgentState
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import freeze_garbage
from madns_runtime.timing.clock import utc_at_iso
from madns_runtime.timing.rate import Pacer, RealTimeFactor, stagger

DRAIN_S = 0.1
"""After the last tick's period an agent listens this much longer for what is still under way."""


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
    Runs one agent.

    Args:
        name: The agent's name.
        launch: The run.
        program: What it runs.
        reactor: The loop.
        on_ended: Called once, with how it ended.

    Raises:
        MachineError: It cannot record, or there is no socket to be had.
        HalfFailed: Its half cannot be made.
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
        self.name = name
        self._config = config = launch.config
        self._program = program
        self._reactor = reactor
        self._on_ended = on_ended
        self._port = AgentPort(
            name, launch, reactor=reactor, on_due=self._session_due, report=self._report
        )
        self._session = self._port.session
        self._recorder = AgentRecorder(
            Path(launch.directory) / "agents" / name,
            config,
            source=name,
            t_s=self._port.t_s,
            life=program.life,
        )
        self._half = half = Half(program.make, self._recorder.say)
        # Called every tick: without a layer between.
        self._step, self._receive = half.simulation.step, half.simulation.receive
        self._record = self._recorder.record
        self._phase_s, self._pacer = _make_pacer(config, name)
        self._factor = RealTimeFactor()
        self._period_s = 1.0 / config.agents.tick_hz
        # Infinite is never: each timer is made once and moved.
        self._tick_timer = reactor.call_at(math.inf, self._tick)
        self._end_timer = reactor.call_at(math.inf, self._finish_run)
        self._usage_timer = reactor.call_at(math.inf, self._record_usage)
        self._scheduling: dict[str, Any] = {}
        self._outcome = Outcome(as_ordered=False, reason="did not end")
        self._is_closed = False
        self._takes_data = True

    def start(self) -> None:
        """Begin: says hello at once."""
        self._recorder.start()
        self._recorder.event("start", pid=os.getpid())
        if self._port.socket.warning:
            self._recorder.say("warning", self._port.socket.warning)
        self._reactor.add_reader(self._port.socket.fileno(), self._readable)
        self._pump()

    def set_scheduling(self, grant: Mapping[str, Any]) -> None:
        """Take note of what the kernel granted to the loop."""
        self._scheduling = dict(grant)
        self._recorder.event("scheduling", **self._scheduling)
        if grant.get("warning"):
            self._recorder.say("warning", str(grant["warning"]))

    def emergency(self, reason: str) -> None:
        """End at once, keep the records, tell the host."""
        self._session.emergency(reason, monotonic())
        self._pump()

    # The loop's callbacks ----------------------------------------------------------------------

    def _readable(self) -> None:
        # One datagram, and back to the loop, which looks for more: most often there is one.
        data = self._port.socket.receive()
        if data is None:
            return
        message = self._session.receive_data(data, monotonic())
        if message is not NO_DATA and self._takes_data:
            try:
                self._receive(message)
            except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
                self._fail(self._half.failure("receive", error))
            if not self._port.must_flush:
                return
        self._pump()

    def _session_due(self) -> None:
        # What waits in the socket is heard before the host is blamed for silence.
        for data, _ in self._port.socket.receive_all():
            self._session.receive_datagram(data, monotonic())
        self._session.handle_timer(monotonic())
        self._pump()

    def _pump(self) -> None:
        """Carry out the session's events, send what is due, arm its timer."""
        session = self._session
        while (event := session.next_event()) is not None:
            self._handle(event)
        while (broken := session.next_broken_deadline()) is not None:
            self._recorder.event("sync_deadline_broken", late_s=broken.late_s)
        if not self._is_closed:
            self._port.flush()

    def _handle(self, event: told.AgentSessionEvent) -> None:
        if isinstance(event, told.DataReceived):
            if self._takes_data:
                self._call("receive", event.payload)
        elif isinstance(event, told.ClockEstimated):
            self._record_clock()
        elif isinstance(event, told.StateEntered):
            self._recorder.event("state", state=event.state.value)
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
            recorder=self._recorder,
            now_s=self._port.now_s,
            send=self._port.send,
        )
        self._call("setup", context, initial)
        if self._session.state is AgentState.SIMULATION_SETUP:
            self._session.setup_finished(monotonic())

    def _start_run(self, t0_host_s: float) -> None:
        self._port.t0_host_s = t0_host_s
        now_s = self._port.now_s()
        self._recorder.set_t0(utc_at_iso(-now_s))
        self._recorder.event("phase", phase_s=self._phase_s)
        if now_s > 0:
            self._pacer.skip_to(now_s)
        freeze_garbage()  # what set-up made stays: no collection walks it in mid-run
        self._arm_tick()
        self._recorder.begin_usage()
        self._usage_timer.reschedule(monotonic() + self._config.health.period_s)

    def _arm_tick(self) -> None:
        deadline_s = self._pacer.next_deadline_s()
        if deadline_s is None:
            end_s = self._config.time.duration_s + DRAIN_S
            self._end_timer.reschedule(self._port.local_s(end_s))
        else:
            self._tick_timer.reschedule(self._port.local_s(deadline_s))

    def _tick(self) -> None:
        pacer, port = self._pacer, self._port
        if self._session.state is not AgentState.RUN_SIMULATION:
            return
        began_s = port.now_s()
        timing = pacer.begin(began_s)
        if timing is not None:
            index, t_s, deadline_s, lateness_s, missed = timing
            self._factor.add(t_s, began_s)
            try:
                self._step(Tick(index, t_s, self._period_s, lateness_s, missed, deadline_s))
            except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
                self._fail(self._half.failure("step", error))
                self._pump()
                return
            if port.must_flush:
                # What the step sent leaves before anything else is done.
                port.flush()
            margin_s = pacer.end(port.now_s())
            values = (index, int(lateness_s * 1e6), int(margin_s * 1e6), missed)
            self._record("ticks", values)
        self._arm_tick()

    def _finish_run(self) -> None:
        if self._session.state is not AgentState.RUN_SIMULATION:
            return
        self._pacer.finish(self._port.now_s())
        self._takes_data = False  # what comes from now on is too late for the summary
        summary = self._call("finish")
        if self._session.state is AgentState.RUN_SIMULATION:
            self._session.run_finished(self._summary(summary), monotonic())
        self._pump()

    def _end_early(self, reason: str, *, is_own: bool) -> None:
        self._outcome = Outcome(as_ordered=False, reason=reason, may_restart=is_own)
        self._takes_data = False
        self._cancel_timers()
        self._recorder.event("emergency", reason=reason)
        self._recorder.say("critical", f"emergency shutdown: {reason}")
        self._close_records()

    def _close_records(self) -> None:
        messages = self._session.link.counters.to_mapping()
        counts = self._recorder.close(self._config.timeouts.shutdown_s)
        records = {
            **counts.to_mapping(),
            "messages": messages,
            "network": self._port.socket.counters(),
            "held_dropped": self._session.held_dropped_count,
            "malformed": self._session.malformed_count,
        }
        self._session.records_closed(records, monotonic())

    def _close(self) -> None:
        self._is_closed = True
        self._cancel_timers()
        self._port.close()
        self._on_ended(self.name, self._outcome)

    def _cancel_timers(self) -> None:
        for timer in (self._tick_timer, self._end_timer, self._usage_timer):
            timer.cancel()

    # Telling -----------------------------------------------------------------------------------

    def _record_clock(self) -> None:
        if self._session.state is AgentState.RUN_SIMULATION:
            self._recorder.clock(self._session.clock, monotonic())

    def _record_usage(self) -> None:
        if self._session.state is AgentState.RUN_SIMULATION:
            self._recorder.usage()
            self._usage_timer.reschedule(monotonic() + self._config.health.period_s)

    def _report(self) -> Mapping[str, Any]:
        report = self._recorder.report()
        if self._port.t0_host_s is not None:
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

    def _summary(self, simulation: Any) -> dict[str, Any]:
        clock, now_s = self._session.clock, monotonic()
        return {
            "ticks": dict(self._pacer.summary()),
            "rtf": self._real_time_factor(),
            "clock": {
                "offset_us": clock.offset_s(now_s) * 1e6,
                "drift_ppm": clock.drift_ppm,
                "uncertainty_us": clock.uncertainty_s(now_s) * 1e6,
                "steps": clock.steps,
                "rejected": clock.rejected,
            }
            if clock.is_valid
            else None,
            "scheduling": self._scheduling,
            "simulation": simulation or {},
        }

    def _real_time_factor(self) -> float | None:
        factor = self._factor.value()
        return None if factor is None else round(factor, 9)

    # Towards the simulation ------------------------------------------------------------------------

    def _call(self, name: str, *arguments: Any) -> Any:
        """Call the plug-in; what it raises, or returns against its contract, ends this agent by name."""
        try:
            return self._half.call(name, *arguments)
        except HalfFailed as failure:
            self._fail(failure)
            return None

    def _fail(self, failure: HalfFailed) -> None:
        self._session.emergency(str(failure), monotonic())
        self._port.must_flush = True


def _make_pacer(config: RunConfig, name: str) -> tuple[float, Pacer]:
    """Return the agent's share of the period by which its ticks are put off, s, and its pace."""
    agents = config.agents
    index = agents.resolved_names().index(name)
    phase_s = stagger(index, agents.count, agents.tick_hz, phase=agents.phase)
    return phase_s, Pacer(
        tick_hz=agents.tick_hz,
        phase_s=phase_s,
        duration_s=config.time.duration_s,
        tolerance_s=config.deadline.tolerance_ms * 1e-3,
    )
