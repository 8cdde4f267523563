"""
The operator's side of a run: one loop over the children's pipes, hand-started agents, signals and deadlines.

It starts the host, then one supervisor a machine, passes on who died, and leaves only when no process
of the run lives: first they are asked to stop, then `Reaper` ends them.
"""

from __future__ import annotations

import os
import selectors
import signal
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

from cosmos_cli.launch import children
from cosmos_cli.launch.children import Child, Program
from cosmos_cli.launch.deadlines import (
    HOST_SILENCE_S,
    LISTEN_TIMEOUT_S,
    MARGIN_S,
    STALL_S,
    Deadlines,
    state_limit_s,
)
from cosmos_cli.launch.events import (
    AgentChanged,
    AgentExited,
    AgentStarted,
    Event,
    Finished,
    Listening,
    Logged,
    Noise,
    Progress,
    StateChanged,
    parse_event,
)
from cosmos_cli.launch.manual import ManualSeat
from cosmos_cli.launch.outcome import LaunchOutcome, LaunchRequest, View
from cosmos_cli.launch.reaper import Reaper
from cosmos_cli.launch.signals import OperatorSignals
from cosmos_cli.problem import Problem
from cosmos_cli.rundir import RunDirectory

STOP_GRACE_S = 2.0
"""From the host's end until supervisors are told to stop: agents that follow the host need less."""
END_MARGIN_S = 5.0
"""A supervisor kills its own late agents and names them; the operator's deadline comes after that."""
SELECT_MAX_S = 1.0
"""A wake-up lost to a bug costs this long, not the run."""
NOISE_LINES_MAX = 20
"""Lines of a child that are no events are shown this often, then only counted."""
PROBLEMS_MAX = 200

HOST = "host"
HOST_EXIT_CODES = (0, 1)
"""Of a host that came to its end: the run was complete, or was not."""
RUNNING_STATE = "SIMULATION_START"


class Operator:
    """
    Runs one launch to its end.

    Args:
        request: What to start.
        view: Where talk goes.
        signals: Entered by the caller, so that it also covers what comes after the loop.
    """

    def __init__(self, request: LaunchRequest, view: View, signals: OperatorSignals) -> None:
        self._request = request
        self._run = RunDirectory(request.directory)
        self._timeouts = request.config.timeouts
        self._view = view
        self._signals = signals
        self._selector = selectors.DefaultSelector()
        self._deadlines = Deadlines()
        self._reaper = Reaper(self._deadlines, self._problem_of)
        self._children: dict[str, Child] = {}
        self._machines: dict[str, str] = {}
        self._seats: dict[str, ManualSeat] = {}
        self._agents_ended: set[str] = set()
        self._exited: set[str] = set()
        self._host_state = "HOST_STARTUP"
        self._host_result: Mapping[str, Any] | None = None
        self._has_host_finished = False
        self._is_closing = False
        self._interruption: Literal["no", "clean", "at once"] = "no"
        self._problems: list[Problem] = []
        self._noise: dict[str, int] = {}

    def run(self) -> LaunchOutcome:
        """Start everything, wait for the end of everything, and say how it went."""
        self._selector.register(self._signals, selectors.EVENT_READ, self._signalled)
        try:
            self._start_host()
            while not self._is_over():
                self._turn()
        finally:
            leftovers = self._clear_up()
        return LaunchOutcome(
            host_result=self._host_result or self._run.read_left_result(),
            interruption=self._interruption,
            problems=tuple(self._problems),
            leftovers=leftovers,
        )

    # The loop -------------------------------------------------------------------------------------

    def _turn(self) -> None:
        turned_s = time.monotonic()
        wait_s = self._deadlines.wait_s(turned_s)
        timeout_s = SELECT_MAX_S if wait_s is None else min(wait_s, SELECT_MAX_S)
        for key, mask in self._selector.select(timeout_s):
            # An earlier callback of this round may have closed this one's descriptor.
            if self._selector.get_map().get(key.fd) is key:
                key.data(mask)
        for name, child in list(self._children.items()):
            if name not in self._exited and child.returncode() is not None:
                self._child_exited(child)
        now_s = time.monotonic()
        if now_s - turned_s > STALL_S:
            self._deadlines.postpone(now_s - turned_s)
        self._deadlines.fire(now_s)

    def _is_over(self) -> bool:
        return not self._seats and all(map(self._reaper.has_ended, self._children.values()))

    def _clear_up(self) -> tuple[int, ...]:
        for seat in self._seats.values():
            seat.close()
        leftovers = self._reaper.kill_whatever_lives(list(self._children.values()))
        if leftovers:
            self._problem(f"processes {', '.join(map(str, leftovers))} outlived SIGKILL")
        self._selector.close()
        for name, count in self._noise.items():
            if count > NOISE_LINES_MAX:
                self._view.say(f"{name}: {count} lines in all that are no events", "warning")
        return leftovers

    def _problem(self, text: str, machine: str | None = None) -> None:
        if len(self._problems) < PROBLEMS_MAX:
            self._problems.append(Problem(text=text, machine=machine))
        self._view.say(text, "error")

    def _problem_of(self, child: Child, text: str) -> None:
        self._problem(text, self._machines.get(child.name))

    # Starting -------------------------------------------------------------------------------------

    def _start_host(self) -> None:
        self._start(HOST, children.HOST_PROGRAM, HOST, launch=self._request.host_launch())
        self._limit_phase(LISTEN_TIMEOUT_S, "has not listened within {:g} s")

    def _start_agents(self, listening: Listening) -> None:
        launch_of = partial(
            self._request.agent_launch, address=listening.address, port=listening.port
        )
        for machine, names in self._request.machines.items():
            started = tuple(name for name in names if name not in self._request.manual)
            if started:
                child = f"agents@{machine}"
                self._machines[child] = machine
                launch = launch_of(machine, started)
                self._start(child, children.AGENT_PROGRAM, f"machines/{machine}", launch=launch)
            for name in names:
                if name in self._request.manual:
                    self._open_seat(name, launch_of(machine, (name,)))
        if self._request.nice:  # after the children, who would inherit it
            os.nice(self._request.nice)

    def _start(
        self, name: str, arguments: tuple[str, ...], folder: str, *, launch: Mapping[str, Any]
    ) -> None:
        stderr = self._request.directory / folder / "stderr.txt"
        try:
            self._children[name] = Child(
                Program(name=name, arguments=arguments, stderr=stderr),
                self._selector,
                launch=launch,
                on_line=partial(self._said, name),
            )
        except OSError as error:
            reason = f"{name} cannot be started: {error}"
            self._problem(reason, self._machines.get(name))
            self._ask_host_to_stop("failed", reason)

    def _open_seat(self, agent: str, launch: Mapping[str, Any]) -> None:
        seat = ManualSeat(
            agent,
            self._selector,
            launch=launch,
            on_line=partial(self._said, agent),
            on_left=partial(self._seat_left, agent),
        )
        self._seats[agent] = seat
        limit_s = self._timeouts.agents_ready_s
        self._view.say(
            f"start {agent} by hand within {limit_s:g} s, in another terminal:\n  {seat.command()}",
            "manual",
        )

    # What children say ----------------------------------------------------------------------------

    def _said(self, name: str, line: bytes) -> None:
        event = parse_event(line)
        if isinstance(event, Logged):
            self._view.say(f"{event.source or name}: {event.text}", event.level)
        elif isinstance(event, Noise):
            self._noise[name] = self._noise.get(name, 0) + 1
            if self._noise[name] <= NOISE_LINES_MAX:
                self._view.say(f"{name}: {event.text}", "info")
        elif name == HOST:
            self._host_said(event)
        else:
            self._supervisor_said(event)

    def _host_said(self, event: Event) -> None:
        if isinstance(event, Progress):
            self._view.progress(event)
            self._expect_sign_of_life()
        elif isinstance(event, AgentChanged):
            self._view.agent(event)
        elif isinstance(event, StateChanged):
            self._host_state = event.state
            self._view.state(event.state)
            self._expect_next_state()
            self._expect_sign_of_life()
        elif isinstance(event, Listening):
            self._expect_next_state()
            if len(self._children) == 1 and self._interruption == "no":
                self._start_agents(event)
        elif isinstance(event, Finished):
            self._host_finished(event.result)

    def _host_finished(self, result: Mapping[str, Any] | None) -> None:
        self._host_result, self._has_host_finished = result or self._run.read_left_result(), True
        self._close_down(grace_s=STOP_GRACE_S)

    def _supervisor_said(self, event: Event) -> None:
        if isinstance(event, AgentStarted):
            self._agents_ended.discard(event.agent)
        elif isinstance(event, AgentExited):
            self._agents_ended.add(event.agent)
            if event.is_abnormal:
                self._tell_host_exited(event.agent, event.how, event.pid)

    def _tell_host_exited(self, agent: str, how: str, pid: int | None = None) -> None:
        if not self._has_host_finished:
            command = {"command": "agent_exited", "agent": agent, "how": how, "pid": pid}
            self._children[HOST].channel.send(command)

    def _seat_left(self, agent: str) -> None:
        if self._is_closing:
            self._close_seat(agent)
        elif agent not in self._agents_ended:
            self._tell_host_exited(agent, "its hand-started process is gone")

    # Deadlines of the host ------------------------------------------------------------------------

    def _limit_phase(self, limit_s: float, late: str) -> None:
        """Give up on the host unless its state changes within *limit_s*; *late* says what it did not do."""
        action = partial(self._give_up_on_host, late.format(limit_s))
        self._deadlines.set("phase", time.monotonic() + limit_s, action)

    def _expect_next_state(self) -> None:
        if not self._is_closing:
            limit_s = state_limit_s(self._host_state, self._request.config)
            self._limit_phase(limit_s, f"has been in {self._host_state} for {{:g}} s")

    def _expect_sign_of_life(self) -> None:
        if self._host_state != RUNNING_STATE or self._is_closing:
            self._deadlines.cancel("silence")
            return
        action = partial(self._give_up_on_host, f"has said nothing for {HOST_SILENCE_S:g} s")
        self._deadlines.set("silence", time.monotonic() + HOST_SILENCE_S, action)

    def _expect_end_of_host(self) -> None:
        """Nobody is left whom the host could wait for."""
        t = self._timeouts
        limit_s = t.silence_s + t.complete_s + t.shutdown_s + MARGIN_S
        reason = f"the host has gone on without agents for {limit_s:g} s"
        action = partial(self._ask_host_to_stop, "failed", reason)
        self._deadlines.set("alone", time.monotonic() + limit_s, action)

    def _ask_host_to_stop(self, status: str, reason: str) -> None:
        host = self._children.get(HOST)
        if host is None or self._is_closing:
            return
        host.channel.send({"command": "stop", "reason": reason, "status": status})
        limit_s = self._timeouts.shutdown_s + MARGIN_S
        self._limit_phase(limit_s, "has not stopped within {:g} s of being told to")

    def _give_up_on_host(self, what: str) -> None:
        host = self._children[HOST]
        self._reaper.end(host, what)
        self._show_last_words(host)
        self._close_down(grace_s=0.0)

    # The end of children --------------------------------------------------------------------------

    def _child_exited(self, child: Child) -> None:
        self._exited.add(child.name)
        child.channel.drain()
        child.channel.close()
        self._reaper.leader_ended(child)
        if child.name != HOST:
            self._supervisor_exited(child)
        elif not self._has_host_finished and not self._is_closing:
            self._host_exited(child)

    def _host_exited(self, child: Child) -> None:
        """The host is gone and nothing was heard of its result: too long for a line, or cut off."""
        result = self._run.read_left_result()
        if result is not None and child.returncode() in HOST_EXIT_CODES:
            self._host_finished(result)
        else:
            self._problem(f"host (pid {child.pid}) {child.describe_exit()} before the run was over")
            self._show_last_words(child)
            self._close_down(grace_s=0.0)

    def _supervisor_exited(self, child: Child) -> None:
        if self._is_closing:
            return
        names = self._request.machines[self._machines[child.name]]
        left = set(names) - self._agents_ended - set(self._request.manual)
        if left:
            how = f"{child.name} (pid {child.pid}) {child.describe_exit()}"
            self._problem_of(child, f"{how} before its agents {', '.join(sorted(left))} were done")
            self._show_last_words(child)
            for agent in sorted(left):
                self._agents_ended.add(agent)
                self._tell_host_exited(agent, f"its supervisor {how}")
        if self._machines.keys() <= self._exited and not self._seats:
            self._expect_end_of_host()

    def _close_down(self, *, grace_s: float) -> None:
        """The host is done or gone: the rest has to end too, in the time that shutdown is given."""
        if self._is_closing:
            return
        self._is_closing = True
        self._deadlines.cancel("phase", "silence", "alone")
        now_s = time.monotonic()
        self._deadlines.set("stop", now_s + grace_s, self._tell_stop)
        limit_s = grace_s + self._timeouts.shutdown_s + END_MARGIN_S
        late = f"has not ended within {limit_s:g} s of the end of the run"
        for name, child in self._children.items():
            if name != HOST or self._has_host_finished:
                self._reaper.expect_end(child, now_s + limit_s, late)
        for agent, seat in list(self._seats.items()):
            seat.stop_listening()
            if seat.is_taken:
                action = partial(self._abandon_seat, agent)
                self._deadlines.set(f"seat {agent}", now_s + limit_s, action)
            else:
                self._close_seat(agent)

    def _tell_stop(self) -> None:
        command = {"command": "stop", "reason": "the run is over"}
        for name in self._machines:
            self._children[name].channel.send(command)
        for seat in self._seats.values():
            seat.send(command)

    def _abandon_seat(self, agent: str) -> None:
        self._problem(f"{agent}, started by hand, is still connected: its line is being closed")
        self._close_seat(agent)

    def _close_seat(self, agent: str) -> None:
        self._deadlines.cancel(f"seat {agent}")
        self._seats.pop(agent).close()

    def _show_last_words(self, child: Child) -> None:
        lines = child.last_words()
        if lines:
            shown = "\n".join(f"  | {line}" for line in lines)
            self._view.say(f"the last lines of {child.stderr}:\n{shown}", "error")

    # The person -----------------------------------------------------------------------------------

    def _signalled(self, mask: int) -> None:
        for number in self._signals.take():
            if self._interruption == "no":
                self._interrupt(number)
            elif self._interruption == "clean" and number is not signal.SIGHUP:
                self._end_at_once()  # a closing terminal sends two SIGHUP: that is no second word

    def _interrupt(self, number: signal.Signals) -> None:
        self._interruption = "clean"
        self._view.say("stopping; press Ctrl-C again to end at once", "warning")
        by = "the operator" if number is signal.SIGINT else number.name
        self._ask_host_to_stop("interrupted", f"interrupted by {by}")

    def _end_at_once(self) -> None:
        self._interruption = "at once"
        self._view.say("ending at once", "warning")
        self._is_closing = True
        self._deadlines.cancel("phase", "silence", "alone", "stop")
        for agent in list(self._seats):
            self._close_seat(agent)
        for child in self._children.values():
            if not self._reaper.has_ended(child):
                self._reaper.kill(child, "was ended at once on the operator's word")
