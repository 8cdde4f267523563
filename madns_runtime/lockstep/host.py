"""
The host of a lockstep run: simulated time goes on when everybody is done with it.

One script from beginning to end, unlike the host of a real-time run: it hands out a tick, waits for
all workers, hands their messages to the simulation's host half in the order of agents, and moves its
clock to what comes next. It waits in the loop alone, where the operator, a signal or the end of a
worker is heard at once.
"""

from __future__ import annotations

import contextlib
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, NoReturn, TypeVar

import orjson

from madns_runtime.config import HostLaunch
from madns_runtime.context import (
    JobContext,
    check_deadline,
    check_service,
    clean_text,
    describe_exception,
)
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.executor import JobFailed, JobRunner, make_executor
from madns_runtime.lockstep import frames
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.crew import Crew, WorkerProcess
from madns_runtime.lockstep.frames import encode_frame
from madns_runtime.lockstep.post import Allowance, decode, encode
from madns_runtime.lockstep.recorder import LockstepRecorder
from madns_runtime.lockstep.result import AgentAccount, totals
from madns_runtime.lockstep.shares import share_out
from madns_runtime.lockstep.watch import CallWatch
from madns_runtime.plugin import returned
from madns_runtime.plugin.api import HOST
from madns_runtime.plugin.registry import load_half, parse_parameters, resolve
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.messages import Service
from madns_runtime.protocol.states import HostEvent, HostState, host_machine
from madns_runtime.reactor.lines import OperatorLink
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import freeze_garbage, outlive_parent
from madns_runtime.reactor.watchdog import end_after_hang_up
from madns_runtime.timing.clock import utc_now_iso
from madns_runtime.timing.rate import Pacer

T = TypeVar("T")

PROGRESS_INTERVAL_S = 0.5
SERVE_INTERVAL_S = 0.2
"""A host that is busy with its own timers hears the operator this often."""
FLUSH_TIMEOUT_S = 5.0
HANG_GRACE_S = 2.0
TIMER_REPEATS_MAX = 100_000
"""Calls of the host half's timer at one simulated time; more means that it never lets time go on."""
DRAIN_ROUNDS_MAX = 16
"""Answers to answers that are handed out after the last tick."""
OPERATOR_GONE = "the operator's process is gone"
RESULT_BYTES_MAX = 1024 * 1024
RESULT_FILE = "result.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """Why a run ends before its time."""

    who: str
    reason: str
    status: str = "failed"


class RunEnds(Exception):
    """The run cannot go on; why is in the host's `_ending`."""


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
        self._config = config
        self._names = config.agents.resolved_names()
        self._index = {name: number for number, name in enumerate(self._names)}
        self._directory = Path(launch.directory)
        _allow_many_files()
        shares = share_out(config.agents, len(os.sched_getaffinity(0)))
        # Everything that forks comes before every thread; workers load their half at the same time.
        self._crew = Crew(config, self._directory.parent, shares)
        base = Path(config.base_directory)
        descriptor = resolve(config.simulation, base)
        parameters = parse_parameters(descriptor, config.parameters)
        self._simulation = load_half(descriptor, "host", base)()
        self._simulation_name = type(self._simulation).__name__
        executor = make_executor(config.executor)
        self._reactor = Reactor()
        self._jobs = JobRunner(self._reactor, executor, self._job_done)
        self._outstanding: deque[int] = deque()
        self._finished_jobs: dict[int, Future[Any]] = {}
        self._clock = SimulatedClock(-config.timeouts.start_lead_s)
        self._recorder = LockstepRecorder(self._directory, config, source=HOST, clock=self._clock)
        self._fds = fds
        self._is_detached = launch.is_detached
        self._operator = OperatorLink(
            self._reactor,
            fds,
            on_command=self._command,
            on_gone=lambda: self._end(
                Ending(who="operator", reason=OPERATOR_GONE, status="aborted")
            ),
            pending=pending,
            is_detached=launch.is_detached,
        )
        self._crew.listen(self._reactor, on_frame=self._said, on_lost=self._worker_lost)
        self._context = JobContext(
            name=HOST,
            config=config,
            parameters=parameters,
            recorder=self._recorder,
            now_s=self._clock.now_s,
            send=self._send,
            is_lockstep=True,
        )
        self._context.submit = self._submit
        self._watch = CallWatch(self._hangs)
        self._machine = host_machine()
        self._tick_count = Pacer(
            tick_hz=config.agents.tick_hz,
            phase_s=0.0,
            duration_s=config.time.duration_s,
            tolerance_s=0.0,
        ).tick_count
        self._accounts = [AgentAccount() for _ in self._names]
        self._outboxes: list[list[tuple[int, bytes]]] = [[] for _ in self._crew.workers]
        self._outbox_of = [
            self._outboxes[number] for number, share in enumerate(shares) for _ in share
        ]
        self._allowances = [Allowance() for _ in self._names]
        self._ending: Ending | None = None
        self._late: tuple[float, Callable[[], Ending]] | None = None
        self._lost: dict[str, str] = {}
        self._not_stopped: tuple[str, ...] = ()
        self._ticks_done = 0
        self._timer_s: float | None = None
        self._timer_repeats = 0
        self._served_s = monotonic()
        self._is_running = False
        self._t0_utc: str | None = None
        self._wall: tuple[float, float] | None = None
        self._summary: Mapping[str, Any] = {}
        self._records: Mapping[str, Any] = {}
        self._progress_timer = self._reactor.call_at(0.0, self._progress)

    def run(self) -> int:
        """Run to the end and return the process's exit code."""
        if self._is_detached:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        else:
            end_after_hang_up(self._fds[0], self._config.timeouts.shutdown_s * 2 + HANG_GRACE_S)
        outlive_parent()
        terminated = Ending(who=HOST, reason="ended by SIGTERM", status="interrupted")
        self._reactor.on_signal(signal.SIGTERM, lambda: self._end(terminated))
        self._reactor.on_signal(
            signal.SIGINT, lambda: None
        )  # a terminal's Ctrl-C is the operator's
        self._operator.emit({"event": "state", "state": self._machine.state.value})
        with contextlib.suppress(RunEnds):
            self._script()
        try:
            self._shut_down()
        finally:
            self._crew.end_left()
        return self._close()

    # The script ---------------------------------------------------------------------------------

    def _script(self) -> None:
        self._set_up()
        self._start()
        for number in range(self._tick_count):
            t_s = number / self._config.agents.tick_hz
            self._advance(t_s)
            self._exchange(frames.TICK, number)
            self._ticks_done = number + 1
            self._take_messages()
        self._advance(self._config.time.duration_s)
        self._clock.t_s = self._config.time.duration_s
        self._drain()
        self._finish()

    def _set_up(self) -> None:
        timeouts = self._config.timeouts
        self._await(timeouts.agents_ready_s, "has not loaded the agent's half")
        self._set_states("ready")
        self._fire(HostEvent.AGENTS_READY)
        self._call("setup", self._simulation.setup, self._context, limit_s=timeouts.host_setup_s)
        packed = [(number, self._initial(name)) for number, name in enumerate(self._names)]
        self._fire(HostEvent.SETUP_FINISHED)
        for worker in self._crew.workers:
            own = [packed[number] for number in worker.agents]
            self._order(worker, encode_frame(frames.SETUP, own))
        self._await(timeouts.agent_setup_s, "has not set itself up")
        self._take_messages()

    def _initial(self, agent: str) -> bytes:
        call = self._simulation.initial_data
        limit_s = self._config.timeouts.host_setup_s
        value = self._call(
            "initial_data", call, agent, check=returned.initial_data, limit_s=limit_s
        )
        return pack(value)

    def _start(self) -> None:
        self._fire(HostEvent.AGENTS_SIMULATION_READY)
        self._set_states("running")
        freeze_garbage()
        self._is_running = True
        self._t0_utc = utc_now_iso()
        self._wall = (monotonic(), monotonic())
        self._call("start", self._simulation.start, self._clock.t_s)
        self._call_timer()

    def _advance(self, t_s: float) -> None:
        """Let simulated time go on to *t_s*, with all that the host's half wants done until then."""
        while self._timer_s is not None and self._timer_s <= t_s:
            self._clock.t_s = max(self._clock.t_s, self._timer_s)
            self._call_timer()
            if monotonic() - self._served_s > SERVE_INTERVAL_S:
                self._serve()
        self._clock.t_s = t_s

    def _call_timer(self) -> None:
        now_s = self._clock.t_s
        self._timer_s = self._call("timer", self._simulation.timer, now_s, check=returned.next_time)
        is_again = self._timer_s is not None and self._timer_s <= now_s
        self._timer_repeats = self._timer_repeats + 1 if is_again else 0
        if self._timer_repeats > TIMER_REPEATS_MAX:
            text = f"asked {TIMER_REPEATS_MAX} times in a row for t = {now_s:g} s, so that time stands still"
            self._fail(HOST, f"{self._simulation_name}.timer {text}")

    def _drain(self) -> None:
        """Hand out what was answered to the last tick, and the answers to that."""
        for _ in range(DRAIN_ROUNDS_MAX):
            if not any(self._outboxes):
                return
            self._exchange(frames.DRAIN)
            self._take_messages()

    def _finish(self) -> None:
        timeouts = self._config.timeouts
        for account in self._accounts:
            account.too_late = 0
        for box in self._outboxes:
            for number, _ in box:
                self._accounts[number].too_late += 1
            box.clear()
        self._wall = (self._wall[0], monotonic()) if self._wall else None
        self._fire(HostEvent.AGENTS_COMPLETE)
        for worker in self._crew.workers:
            self._order(worker, encode_frame(frames.FINISH))
        self._await(max(timeouts.complete_s, timeouts.tick_s), "has not summed itself up")
        for answer in self._crew.answers():
            for number, summary, deadlines_broken in answer[1]:
                account = self._accounts[number]
                account.summary = summary
                account.deadlines_broken += deadlines_broken
        self._set_states("complete")
        finish = self._simulation.finish
        self._summary = self._call("finish", finish, check=returned.summary, settles=False)

    # Waiting -------------------------------------------------------------------------------------

    def _exchange(self, *order: int) -> None:
        """Give every worker what waits for its agents, and wait until all have answered."""
        for worker, box in zip(self._crew.workers, self._outboxes, strict=True):
            self._order(worker, encode_frame(*order, box))
            box.clear()
        self._await(self._config.timeouts.tick_s, "")

    def _order(self, worker: WorkerProcess, data: bytes) -> None:
        try:
            self._crew.order(worker, data, self._config.timeouts.tick_s)
        except TimeoutError:
            self._end(self._blame(worker, "does not read", self._config.timeouts.tick_s))
            raise RunEnds from None

    def _await(self, limit_s: float, late: str) -> None:
        """Wait until every worker has answered; *late* says what one has not done."""

        def blame() -> Ending:
            worker = self._crew.awaited
            assert worker is not None, "somebody is awaited"
            return self._blame(worker, late, limit_s)

        self._wait(lambda: self._crew.are_all_answered, limit_s, blame)
        for answer in self._crew.answers():
            if answer[0] == frames.FAILED:
                self._fail(self._names[answer[1]], answer[2])

    def _wait(
        self, is_done: Callable[[], bool], limit_s: float, late: Callable[[], Ending]
    ) -> None:
        self._late = (monotonic() + limit_s, late)
        while self._ending is None and not is_done():
            self._reactor.run()
        self._late = None
        self._served_s = monotonic()
        if self._ending is not None:
            raise RunEnds

    def _serve(self) -> None:
        """Hear the operator, without waiting."""
        self._reactor.call_at(0.0, self._reactor.stop)
        self._reactor.run()
        self._served_s = monotonic()
        if self._ending is not None:
            raise RunEnds

    def _settle(self) -> None:
        """Hand out the values of all submitted jobs, in order: simulated time stands until they are there."""
        limit_s = self._config.timeouts.host_setup_s
        while self._outstanding:
            job = self._outstanding[0]
            late = Ending(
                who=HOST,
                reason=f"{self._simulation_name}: job {job} has not ended within {limit_s:g} s",
            )
            self._wait(
                partial(self._finished_jobs.__contains__, job), limit_s, partial(_same, late)
            )
            self._outstanding.popleft()
            future = self._finished_jobs.pop(job)
            error = future.exception()
            if error is not None:
                doing = f"{self._simulation_name}: job {job}"
                is_told = isinstance(error, JobFailed)
                text = f"{doing}: {error}" if is_told else describe_exception(error, doing)
                self._log_traceback(error)
                self._fail(HOST, text)
            self._call("result", self._simulation.result, job, future.result(), settles=False)

    # The loop's callbacks ------------------------------------------------------------------------

    def _said(self, worker: WorkerProcess, frame: list[Any]) -> None:
        kind = frame[0]
        if kind == frames.CLOSED:
            account = self._accounts[frame[1]]
            account.records = frame[2]
            account.state = "stopped"
            self._late = self._late and (
                monotonic() + self._config.timeouts.shutdown_s,
                self._late[1],
            )
            self._reactor.stop()
            return
        if kind == frames.FAILED and worker.answer is not None:  # it was not asked
            self._end(Ending(who=self._names[frame[1]], reason=frame[2]))
        worker.answer = frame
        if self._crew.are_all_answered:
            self._reactor.stop()

    def _worker_lost(self, worker: WorkerProcess, how: str) -> None:
        self._reactor.stop()
        if self._machine.state not in _LIVE:
            return
        number, method = worker.at
        name = self._names[number]
        where = f" in the agent's {method}" if method else ""
        reason = (
            f"its process (pid {worker.pid}, {self._people(worker)}) {how}{where}{self._when()}"
        )
        for other in worker.agents:
            self._lost[self._names[other]] = reason
        self._end(Ending(who=name, reason=reason))

    def _job_done(self, job: int, future: Future[Any]) -> None:
        self._finished_jobs[job] = future
        self._reactor.stop()

    def _command(self, command: Mapping[str, Any]) -> None:
        if command.get("command") == "stop":
            self._end(
                Ending(
                    who="operator",
                    reason=str(command.get("reason", "stopped by the operator")),
                    status=str(command.get("status", "interrupted")),
                )
            )

    def _end(self, ending: Ending) -> None:
        """End the run as soon as the script waits again; the first cause stands."""
        self._ending = self._ending or ending
        self._reactor.stop()

    def _fail(self, who: str, reason: str) -> NoReturn:
        self._end(Ending(who=who, reason=reason))
        raise RunEnds

    def _progress(self) -> None:
        now_s = monotonic()
        self._progress_timer = self._reactor.call_at(now_s + PROGRESS_INTERVAL_S, self._progress)
        self._operator.emit(self._progress_report(now_s))
        if self._late is not None and now_s > self._late[0]:
            late, self._late = self._late[1], None
            self._end(late())

    def _progress_report(self, now_s: float) -> dict[str, Any]:
        counts = {
            state: sum(account.state == state for account in self._accounts)
            for state in ("ready", "running", "complete")
        }
        return {
            "event": "progress",
            "is_lockstep": True,
            "t_s": round(self._clock.t_s, 3) if self._is_running else None,
            "rtf": self._speed(now_s),
            **counts,
            "lost": len(self._lost),
            "ticks": self._ticks_done * len(self._names),
        }

    def _speed(self, now_s: float) -> float | None:
        """Return simulated seconds per wall second since the start."""
        if self._wall is None or now_s <= self._wall[0] or not self._is_running:
            return None
        return round(max(self._clock.t_s, 0.0) / (now_s - self._wall[0]), 3)

    # Blame --------------------------------------------------------------------------------------

    def _blame(self, worker: WorkerProcess, late: str, limit_s: float) -> Ending:
        """Return who of a worker that does not answer is to blame, and end it."""
        number, method = worker.at
        if method:
            text = f"the agent's {method} has not returned within {limit_s:g} s"
        else:
            text = f"its process (pid {worker.pid}, {self._people(worker)}) {late or 'has not answered'}"
            text += f" within {limit_s:g} s"
        self._crew.tell_stack(worker)
        self._lost = {self._names[other]: text for other in worker.agents}
        return Ending(
            who=self._names[number],
            reason=f"{text}{self._when()}; host/stderr.txt shows where it hung",
        )

    def _people(self, worker: WorkerProcess) -> str:
        first, last = self._names[worker.agents[0]], self._names[worker.agents[-1]]
        return first if len(worker.agents) == 1 else f"{first} to {last}"

    def _when(self) -> str:
        return f", at t = {self._clock.t_s:g} s" if self._is_running else ""

    def _hangs(self, call: str, limit_s: float) -> None:
        """Tell that the host's half hangs, from another thread, and end this process: nothing else can."""
        reason = (
            f"{call} has not returned within {limit_s:g} s{self._when()};"
            " host/stderr.txt shows where it hung"
        )
        self._ending = Ending(who=HOST, reason=reason)
        text = orjson.dumps(self._result(), option=orjson.OPT_SERIALIZE_NUMPY)
        self._leave(text)
        with contextlib.suppress(OSError):
            os.set_blocking(self._fds[1], True)
            os.write(self._fds[1], b'{"event":"finished","result":null}\n')
        os._exit(1)

    # Towards the simulation ------------------------------------------------------------------------

    def _take_messages(self) -> None:
        """Hand what the agents sent to the host's half, in the order of agents and of sending."""
        receive = self._simulation.receive
        for answer in self._crew.answers():
            for number, service, body in answer[1]:
                self._accounts[number].up[service] += 1
                self._call("receive", receive, self._names[number], decode(body))

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
            check_deadline(service, is_running=self._is_running)
        body = encode(message, service)
        self._allowances[number].take(len(body), t_s)
        account = self._accounts[number]
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            account.deadlines_broken += 1
            self._recorder.event("sync_deadline_broken", agent=to, late_s=t_s - deadline_s)
        account.down[int(service)] += 1
        self._outbox_of[number].append((number, body))

    def _submit(self, function: Callable[..., Any], *arguments: Any) -> int:
        job = self._jobs.submit(function, *arguments)
        self._outstanding.append(job)
        return job

    def _call(
        self,
        name: str,
        method: Callable[..., Any],
        *arguments: Any,
        check: Callable[[Any], T] | None = None,
        limit_s: float | None = None,
        settles: bool = True,
    ) -> Any:
        """Call the plug-in, and have its jobs done; what it raises or returns against its contract ends the run."""
        doing = f"{self._simulation_name}.{name}"
        self._watch.began(doing, limit_s or self._config.timeouts.tick_s)
        try:
            value = method(*arguments)
        except MachineError as error:
            self._fail(HOST, str(error))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a plug-in may raise anything
            self._log_traceback(error)
            self._fail(HOST, describe_exception(error, doing))
        finally:
            self._watch.ended()
        if check is not None:
            try:
                value = check(value)
            except PluginError as error:
                self._fail(HOST, f"{doing} returned {clean_text(str(error))}")
        if settles and self._outstanding:
            self._settle()
        return value

    # The end -------------------------------------------------------------------------------------

    def _shut_down(self) -> None:
        if self._ending is None:
            self._fire(HostEvent.STOP_ORDERED)
            reason = None
        else:
            ending, self._ending = self._ending, None
            self._declare(ending)
            reason = f"{ending.who}: {ending.reason}"
        self._stop_workers(reason)
        self._fire(HostEvent.AGENTS_STOPPED)
        self._jobs.close()
        self._fire(HostEvent.CLEANED_UP)
        self._records = self._recorder.close().to_mapping()
        self._fire(HostEvent.RECORDS_CLOSED)
        self._fire(HostEvent.SERVER_STOPPED)

    def _declare(self, ending: Ending) -> None:
        self._declared = ending
        self._fire(HostEvent.EMERGENCY)
        self._recorder.event("emergency", who=ending.who, reason=ending.reason)
        self._log("critical", f"emergency shutdown: {ending.who}: {ending.reason}")

    def _stop_workers(self, reason: str | None) -> None:
        limit_s = self._config.timeouts.shutdown_s
        self._crew.stop(reason, limit_s)
        late = Ending(who=HOST, reason="not stopped")
        while not all(worker.has_ended for worker in self._crew.workers):
            try:
                self._wait(self._are_all_closed, limit_s, partial(_same, late))
                break
            except RunEnds:
                is_late, self._ending = self._ending is late, None
                if is_late:
                    break
        left = [w for w in self._crew.workers if not self._has_closed(w)]
        self._not_stopped = tuple(
            self._names[n] for w in left for n in w.agents if self._is_open(n)
        )
        if self._not_stopped:
            self._log("error", f"{', '.join(self._not_stopped)}: no word that records are closed")

    def _are_all_closed(self) -> bool:
        return all(w.has_ended or self._has_closed(w) for w in self._crew.workers)

    def _has_closed(self, worker: WorkerProcess) -> bool:
        return not any(self._is_open(number) for number in worker.agents)

    def _is_open(self, number: int) -> bool:
        return self._accounts[number].state != "stopped"

    def _close(self) -> int:
        result = self._result()
        result["events_dropped"] = self._operator.dropped_count
        text = orjson.dumps(result, option=orjson.OPT_SERIALIZE_NUMPY)
        is_left = self._leave(text)
        if is_left and len(text) > RESULT_BYTES_MAX:
            self._operator.emit({"event": "finished", "result": None, "file": RESULT_FILE})
        else:
            self._operator.emit({"event": "finished", "result": result})
        self._operator.flush(FLUSH_TIMEOUT_S)
        self._operator.close()
        self._reactor.close()
        return 0 if result["status"] == "complete" else 1

    _declared: Ending | None = None

    def _result(self) -> dict[str, Any]:
        ending = self._declared or self._ending
        by_name = dict(zip(self._names, self._accounts, strict=True))
        duration_s = self._config.time.duration_s
        wall_s = self._wall[1] - self._wall[0] if self._wall else 0.0
        is_complete = ending is None
        return {
            "status": "complete" if ending is None else ending.status,
            "who": ending.who if ending else None,
            "reason": ending.reason if ending else None,
            "t0_utc": self._t0_utc,
            "duration_s": duration_s,
            "completed_s": duration_s if is_complete else None,
            "wall_s": round(wall_s, 6) if is_complete else None,
            "rtf": round(duration_s / wall_s, 3) if is_complete and wall_s > 0 else None,
            "workers": len(self._crew.workers),
            "agents": {
                name: account.to_mapping(self._ticks_done, self._lost.get(name))
                for name, account in by_name.items()
            },
            "lost": sorted(self._lost),
            "not_stopped": list(self._not_stopped),
            "network": {},
            "messages": totals(by_name),
            "refused": {},
            "records": dict(self._records),
            "simulation": dict(self._summary),
            "scheduling": {},
        }

    def _leave(self, text: bytes) -> bool:
        """Write the result beside the records."""
        path = self._directory / RESULT_FILE
        try:
            path.with_suffix(".tmp").write_bytes(text)
            path.with_suffix(".tmp").replace(path)
        except OSError:
            path.with_suffix(".tmp").unlink(missing_ok=True)
            return False
        return True

    # Telling -------------------------------------------------------------------------------------

    def _fire(self, event: HostEvent) -> None:
        state = self._machine.fire(event).value
        self._recorder.event("state", state=state)
        self._operator.emit({"event": "state", "state": state})

    def _set_states(self, state: str) -> None:
        for account in self._accounts:
            account.state = state

    def _log(self, level: str, text: str) -> None:
        self._recorder.log(level, text, self._clock.t_s)
        self._operator.emit({"event": "log", "level": level, "source": HOST, "text": text})

    def _log_traceback(self, error: BaseException) -> None:
        text = "".join(traceback.format_exception(error))
        self._recorder.log("critical", text, self._clock.t_s)


_LIVE = frozenset(
    {
        HostState.HOST_STARTUP,
        HostState.SIMULATION_SETUP,
        HostState.HOST_SIMULATION_READY,
        HostState.SIMULATION_START,
        HostState.SIMULATION_COMPLETE,
    }
)


def _same(ending: Ending) -> Ending:
    return ending


def _allow_many_files() -> None:
    """Raise the number of open files to what the system allows: a worker holds those of many agents."""
    import resource  # Does not exist everywhere.

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
