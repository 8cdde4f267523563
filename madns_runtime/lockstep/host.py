"""
The host of a lockstep run: simulated time goes on when everybody is done with it.

One script from beginning to end, unlike the host of a real-time run: it hands out a tick, waits for
all workers, hands their messages to the simulation's host half in the order of agents, and moves its
clock to what comes next. Nothing in it depends on the wall clock but how long it waits for whom.
"""

from __future__ import annotations

import contextlib
import signal
from pathlib import Path
from time import monotonic
from typing import Any

import orjson

from madns_runtime.config import HostLaunch
from madns_runtime.context import JobContext, check_deadline, check_service
from madns_runtime.errors import PluginError
from madns_runtime.executor import make_executor
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.crew import Crew
from madns_runtime.lockstep.half import HostHalf
from madns_runtime.lockstep.meeting import Meeting, RunEnds
from madns_runtime.lockstep.post import Allowance, decode, encode
from madns_runtime.lockstep.recorder import LockstepRecorder
from madns_runtime.lockstep.result import Ending, RunAccount
from madns_runtime.lockstep.shares import processors_here, share_out
from madns_runtime.plugin import returned
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.registry import load_half, parse_parameters, resolve
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import HostEvent, host_machine
from madns_runtime.reactor.scheduling import freeze_garbage, outlive_parent
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.timing.clock import utc_now_iso
from madns_runtime.timing.rate import Pacer

FLUSH_TIMEOUT_S = 5.0
HANG_GRACE_S = 2.0
"""Beyond twice the time for shutdown: a host that hangs, without an operator, ends by force."""
TIMER_REPEATS_MAX = 100_000
"""Calls of the half's timer at one simulated time; more means that it never lets time go on."""
DRAIN_ROUNDS_MAX = 16
"""Answers to answers that are handed out after the last tick."""
RESULT_BYTES_MAX = 1024 * 1024
"""A longer result is not sent to the operator, only named."""
RESULT_FILE = "result.json"


class LockstepHost:
    """
    One run.

    Args:
        launch: What to run.
        fds: Where the operator's commands come from and events go to.
        pending: What had already come behind the launch document.
    """

    def __init__(self, launch: HostLaunch, fds: tuple[int, int], pending: bytes) -> None:
        config = launch.config
        self._config, self._launch, self._fds = config, launch, fds
        self._names = names = config.agents.resolved_names()
        self._index = {name: number for number, name in enumerate(names)}
        self._directory = Path(launch.directory)
        _allow_many_files()
        shares = share_out(config.agents, processors_here())
        # Everything that forks comes before every thread; workers load their half at the same time.
        self._crew = Crew(config, self._directory.parent, shares)
        base = Path(config.base_directory)
        descriptor = resolve(config.simulation, base)
        parameters = parse_parameters(descriptor, config.parameters)
        simulation = load_half(descriptor, "host", base)()
        executor = make_executor(config.executor)
        self._clock = SimulatedClock(-config.timeouts.start_lead_s)
        self._account = RunAccount(names=names, duration_s=config.time.duration_s)
        self._account.workers = len(shares)
        self._recorder = LockstepRecorder(self._directory, config, source=HOST, clock=self._clock)
        self._meeting = Meeting(
            launch, self._crew, account=self._account, clock=self._clock, fds=fds, pending=pending
        )
        self._operator = self._meeting.operator
        self._half = HostHalf(
            simulation,
            config=config,
            meeting=self._meeting,
            executor=executor,
            recorder=self._recorder,
            on_hang=self._leave_hanging,
        )
        self._context = JobContext(
            name=HOST,
            config=config,
            parameters=parameters,
            recorder=self._recorder,
            now_s=self._clock.now_s,
            send=self._send,
            is_lockstep=True,
        )
        self._context.submit = self._half.submit
        self._context.wake = self._wake
        self._machine = host_machine()
        self._boxes: list[list[tuple[int, bytes]]] = [[] for _ in shares]
        self._box_of = [self._boxes[number] for number, share in enumerate(shares) for _ in share]
        self._allowances = [Allowance() for _ in names]
        self._timer_s: float | None = None
        self._timer_repeats = 0

    def run(self) -> int:
        """Run to the end and return the process's exit code."""
        if self._launch.is_detached:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        else:
            end_after_hang_up(self._fds[0], 2 * self._config.timeouts.shutdown_s + HANG_GRACE_S)
        outlive_parent()
        meeting = self._meeting
        end_by_term = lambda: meeting.end(HOST, "ended by SIGTERM", status="interrupted")  # noqa: E731
        meeting.reactor.on_signal(signal.SIGTERM, end_by_term)
        meeting.reactor.on_signal(
            signal.SIGINT, lambda: None
        )  # a terminal's Ctrl-C is the operator's
        self._operator.emit({"event": "state", "state": self._machine.state.value})
        try:
            with contextlib.suppress(RunEnds):
                self._script()
            self._shut_down()
        finally:
            self._crew.end_left()
        return self._close()

    # The script -----------------------------------------------------------------------------------

    def _script(self) -> None:
        self._set_up()
        self._start()
        for number in range(self._tick_count()):
            self._advance(number / self._config.agents.tick_hz)
            self._meeting.exchange((frames.TICK, number), self._boxes)
            self._account.ticks = number + 1
            self._take_messages()
        self._advance(self._config.time.duration_s)
        self._drain()
        self._finish()

    def _set_up(self) -> None:
        timeouts, meeting = self._config.timeouts, self._meeting
        meeting.await_all(timeouts.agents_ready_s, "has not loaded the agent's half")
        self._account.set_states("ready")
        self._fire(HostEvent.AGENTS_READY)
        limit_s = timeouts.host_setup_s
        self._half.call("setup", self._context, limit_s=limit_s)
        initial = []
        for number, name in enumerate(self._names):
            data = self._half.call(
                "initial_data", name, check=returned.initial_data, limit_s=limit_s
            )
            initial.append((number, pack(data)))
        self._fire(HostEvent.SETUP_FINISHED)
        for worker in self._crew.workers:
            meeting.order(worker, frames.SETUP, [initial[number] for number in worker.agents])
        meeting.await_all(timeouts.agent_setup_s, "has not set itself up")
        self._take_messages()

    def _start(self) -> None:
        self._fire(HostEvent.AGENTS_SIMULATION_READY)
        self._account.set_states("running")
        freeze_garbage()  # what set-up made stays: no collection walks it in mid-run
        self._account.t0_utc = utc_now_iso()
        self._account.began_s = monotonic()
        self._half.call("start", self._clock.t_s)
        self._call_timer()

    def _tick_count(self) -> int:
        time, tick_hz = self._config.time, self._config.agents.tick_hz
        pacer = Pacer(tick_hz=tick_hz, phase_s=0.0, duration_s=time.duration_s, tolerance_s=0.0)
        return pacer.tick_count

    def _advance(self, t_s: float) -> None:
        """Let simulated time go on to *t_s*, and do all that the half wants done until then."""
        while self._timer_s is not None and self._timer_s <= t_s:
            self._clock.t_s = max(self._clock.t_s, self._timer_s)
            self._call_timer()
            self._meeting.serve()
        self._clock.t_s = t_s

    def _wake(self, t_s: float) -> None:
        if self._timer_s is None or t_s < self._timer_s:
            self._timer_s = t_s

    def _call_timer(self) -> None:
        now_s = self._clock.t_s
        self._timer_s = self._half.call("timer", now_s, check=returned.next_time)
        is_again = self._timer_s is not None and self._timer_s <= now_s
        self._timer_repeats = self._timer_repeats + 1 if is_again else 0
        if self._timer_repeats > TIMER_REPEATS_MAX:
            times = f"{TIMER_REPEATS_MAX} times in a row"
            self._half.refuse(f"timer asked {times} for t = {now_s:g} s: simulated time stands")

    def _drain(self) -> None:
        """Hand out what was answered to the last tick, and the answers to that."""
        for _ in range(DRAIN_ROUNDS_MAX):
            if not any(self._boxes):
                break
            self._meeting.exchange((frames.DRAIN,), self._boxes)
            self._take_messages()
        for box in self._boxes:
            for number, _ in box:
                self._account.agents[number].too_late += 1
            box.clear()

    def _finish(self) -> None:
        timeouts, account = self._config.timeouts, self._account
        account.wall_s = monotonic() - (account.began_s or 0.0)
        self._fire(HostEvent.AGENTS_COMPLETE)
        for worker in self._crew.workers:
            self._meeting.order(worker, frames.FINISH)
        limit_s = max(timeouts.complete_s, timeouts.tick_s)
        self._meeting.await_all(limit_s, "has not summed itself up")
        for answer in self._crew.answers():
            for number, summary, deadlines_broken in answer[1]:
                account.agents[number].summary = summary
                account.agents[number].deadlines_broken += deadlines_broken
        account.set_states("complete")
        account.simulation = self._half.call("finish", check=returned.summary)

    # Messages -------------------------------------------------------------------------------------

    def _take_messages(self) -> None:
        """Hand what the agents sent to the half, in the order of agents and of sending."""
        names, accounts, half = self._names, self._account.agents, self._half
        for number, service, body in self._meeting.messages():
            accounts[number].up[service] += 1
            half.call("receive", names[number], decode(body))

    def _send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        number = self._index.get(to)
        if number is None:
            raise PluginError(f"no agent is called {to!r}")
        check_service(service)
        t_s = self._clock.t_s
        if deadline_s is not None:
            check_deadline(service, is_running=self._account.began_s is not None)
        body = encode(message, service)
        self._allowances[number].take(len(body), t_s)
        account = self._account.agents[number]
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            account.deadlines_broken += 1
            self._recorder.event("sync_deadline_broken", agent=to, late_s=t_s - deadline_s)
        account.down[int(service)] += 1
        self._box_of[number].append((number, body))

    # The end --------------------------------------------------------------------------------------

    def _shut_down(self) -> None:
        ending = self._account.ending = self._meeting.ending
        if ending is None:
            self._fire(HostEvent.STOP_ORDERED)
        else:
            self._declare(ending)
        reason = None if ending is None else f"{ending.who}: {ending.reason}"
        missing = self._account.not_stopped = self._meeting.stop_workers(reason)
        if missing:
            self._log("error", f"{', '.join(missing)}: no word that records are closed")
        self._fire(HostEvent.AGENTS_STOPPED)
        self._half.close()
        self._fire(HostEvent.CLEANED_UP)
        self._account.records = self._recorder.close().to_mapping()
        self._fire(HostEvent.RECORDS_CLOSED)
        self._fire(HostEvent.SERVER_STOPPED)

    def _declare(self, ending: Ending) -> None:
        self._fire(HostEvent.EMERGENCY)
        self._recorder.event("emergency", who=ending.who, reason=ending.reason)
        self._log("critical", f"emergency shutdown: {ending.who}: {ending.reason}")

    def _close(self) -> int:
        result = self._account.result()
        result["events_dropped"] = self._operator.dropped_count
        text = orjson.dumps(result, option=orjson.OPT_SERIALIZE_NUMPY)
        if self._leave(text) and len(text) > RESULT_BYTES_MAX:
            self._operator.emit({"event": "finished", "result": None, "file": RESULT_FILE})
        else:
            self._operator.emit({"event": "finished", "result": result})
        self._operator.flush(FLUSH_TIMEOUT_S)
        self._operator.close()
        self._meeting.reactor.close()
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

    def _leave_hanging(self, reason: str) -> None:
        """Leave a result although the half hangs; called in another thread, before the process ends."""
        self._account.ending = Ending(who=HOST, reason=reason)
        self._leave(orjson.dumps(self._account.result(), option=orjson.OPT_SERIALIZE_NUMPY))

    # Telling --------------------------------------------------------------------------------------

    def _fire(self, event: HostEvent) -> None:
        state = self._machine.fire(event).value
        self._recorder.event("state", state=state)
        self._operator.emit({"event": "state", "state": state})

    def _log(self, level: str, text: str) -> None:
        self._recorder.log(level, text, self._recorder.t_s)
        self._operator.emit({"event": "log", "level": level, "source": HOST, "text": text})


def _allow_many_files() -> None:
    """Raise the number of open files to what the system allows: a worker holds those of many agents."""
    import resource  # Does not exist everywhere.

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
