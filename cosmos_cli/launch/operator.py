"""
The operator's side of a run: one loop over the children's lines, hand-started agents, signals and deadlines.

It starts the host, then one supervisor a machine, passes on who died, and leaves only when no process
of the run lives: first they are asked to stop, then `Reaper` ends them. Of a detached run it leaves
everything once it is under way.
"""

from __future__ import annotations

import os
import selectors
import signal
import time
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

from cosmos_cli.launch import events
from cosmos_cli.launch.children import Child
from cosmos_cli.launch.crew import Crew
from cosmos_cli.launch.deadlines import STALL_S
from cosmos_cli.launch.host_limits import OPEN_STATES, RUNNING_STATE, HostLimits
from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.machine_care import Company, Decisions, MachineCare
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.outcome import FIRST_LIFE, LaunchOutcome, LaunchRequest, Life, View
from cosmos_cli.launch.reaper import Reaper
from cosmos_cli.launch.roll import Roll
from cosmos_cli.launch.seats import Seats
from cosmos_cli.launch.signals import OperatorSignals
from cosmos_cli.launch.starter import HOST, Starter, Told
from cosmos_cli.launch.talk import Talk
from cosmos_cli.rundir import RunDirectory

STOP_GRACE_S = 2.0
"""From the host's end until supervisors are told to stop: agents that follow the host need less."""
END_MARGIN_S = 5.0
"""A supervisor kills its own late agents and names them; the operator's deadline comes after that."""
SELECT_MAX_S = 1.0
"""A wake-up lost to a bug costs this long, not the run."""
PUSH_INTERVAL_S = 0.02
"""While a line to another machine is full, it is tried again this often."""
BACKGROUND_END_S = 10.0
"""For what machines are still being asked when the run is over."""

HOST_EXIT_CODES = (0, 1)
"""Of a host that came to its end: the run was complete, or was not."""
NO_MACHINES: Mapping[str, RemoteMachine] = {}


class Operator:
    """
    Runs one launch to its end, or until it can be left alone.

    Args:
        request: What to start.
        view: Where talk goes.
        signals: Entered by the caller, so that it also covers what comes after the loop.
        remote: The machines that are other computers; the caller closes them.
    """

    def __init__(
        self,
        request: LaunchRequest,
        view: View,
        signals: OperatorSignals,
        remote: Mapping[str, RemoteMachine] = NO_MACHINES,
    ) -> None:
        self._request = request
        self._run = RunDirectory(request.directory)
        self._timeouts = request.config.timeouts
        self._view = view
        self._talk = Talk(view)
        self._signals = signals
        self._loop = Loop.make()
        self._deadlines = self._loop.deadlines
        self._reaper = Reaper(self._deadlines, self._problem_of)
        self._starter = Starter(request, remote, self._loop)
        self._crew = Crew()
        self._roll = Roll(request)
        self._care = self._make_care(remote)
        self._watch = self._care.watch
        self._limits = HostLimits(
            self._deadlines,
            request.config,
            give_up=self._give_up_on_host,
            stop=partial(self._ask_host_to_stop, "failed"),
        )
        self._seats = Seats(
            self._loop,
            on_line=self._said,
            on_left=self._seat_left,
            talk=self._talk,
            within_s=self._timeouts.agents_ready_s,
        )
        self._listening: events.Listening | None = None
        self._host_result: Mapping[str, Any] | None = None
        self._has_host_finished = False
        self._is_closing = False
        self._is_detached = False
        self._interruption: Literal["no", "clean", "at once"] = "no"

    def _make_care(self, remote: Mapping[str, RemoteMachine]) -> MachineCare:
        company = Company(self._loop, self._crew, self._roll, self._reaper, self._talk)
        decisions = Decisions(
            is_open=self._is_open,
            agents_lost=self._agents_lost,
            host_lost=partial(self._close_down, grace_s=0.0),
            start_supervisor=self._start_supervisor,
        )
        return MachineCare(self._request, remote, company, decisions)

    def run(self) -> LaunchOutcome:
        """Start everything, wait for the end of everything, and say how it went."""
        self._loop.selector.register(self._signals, selectors.EVENT_READ, self._signalled)
        try:
            self._start_host()
            while not self._is_over():
                self._turn()
        finally:
            leftovers = self._let_go() if self._is_detached else self._clear_up()
        return LaunchOutcome(
            host_result=self._host_result or self._run.read_left_result(),
            interruption=self._interruption,
            problems=self._talk.problems,
            leftovers=leftovers,
            is_detached=self._is_detached,
        )

    def _turn(self) -> None:
        turned_s = time.monotonic()
        for key, mask in self._loop.selector.select(self._wait_s(turned_s)):
            # An earlier callback of this round may have closed this one's descriptor.
            if self._loop.selector.get_map().get(key.fd) is key:
                key.data(mask)
        for child in self._crew.newly_exited():
            self._child_exited(child)
        now_s = time.monotonic()
        if now_s - turned_s > STALL_S:
            self._deadlines.postpone(now_s - turned_s)
        self._deadlines.fire(now_s)

    def _wait_s(self, now_s: float) -> float:
        wait_s = self._deadlines.wait_s(now_s)
        limit_s = PUSH_INTERVAL_S if self._crew.push() else SELECT_MAX_S
        return limit_s if wait_s is None else min(wait_s, limit_s)

    def _is_over(self) -> bool:
        is_ended = all(map(self._reaper.has_ended, self._crew.everybody()))
        is_quiet = not self._seats and not self._watch.is_trying
        return self._is_detached or (is_ended and is_quiet)

    def _is_open(self) -> bool:
        """Tell whether agents may still join the run."""
        return self._limits.is_open and not self._is_closing and self._interruption == "no"

    def _let_go(self) -> tuple[int, ...]:
        """Leave a detached run to itself; nobody is left over from it."""
        for child in self._crew.everybody():
            child.release()
        self._loop.background.close(BACKGROUND_END_S)
        self._loop.selector.close()
        return ()

    def _clear_up(self) -> tuple[int, ...]:
        self._seats.close()
        self._watch.stop_seeking()
        leftovers = self._reaper.kill_whatever_lives(self._crew.everybody())
        if leftovers:
            self._talk.problem(f"processes {', '.join(map(str, leftovers))} outlived SIGKILL")
        self._loop.background.close(BACKGROUND_END_S)
        self._loop.selector.close()
        self._talk.noise_in_all()
        return leftovers

    def _problem_of(self, child: Child, text: str) -> None:
        self._talk.problem(text, self._crew.machine_of(child.name))

    def _start_host(self) -> None:
        machine = self._request.host_machine
        if machine is not None:
            self._crew.place(HOST, machine)
        try:
            child = self._starter.start_host(self._told(HOST, machine))
        except OSError as error:
            self._cannot_start(HOST, error)
            return
        self._crew.add(child)
        if machine is not None:
            self._watch.add(machine, child, is_host=True)
        self._limits.started(is_here=machine is None)

    def _start_agents(self, listening: events.Listening) -> None:
        self._listening = listening
        for machine, names in self._request.machines.items():
            started = tuple(name for name in names if name not in self._request.manual)
            if started:
                self._start_supervisor(machine, started)
            for name in names:
                if name in self._request.manual:
                    launch = self._request.agent_launch(machine, (name,), listening)
                    self._seats.open(name, launch)
        if self._request.nice:  # after the children, who would inherit it
            os.nice(self._request.nice)

    def _start_supervisor(
        self, machine: str, agents: tuple[str, ...], life: Life = FIRST_LIFE
    ) -> None:
        assert self._listening is not None
        name = f"agents@{machine}" + (f" ({life.number})" if life.number > 1 else "")
        self._crew.place(name, machine)
        launch = self._request.agent_launch(machine, agents, self._listening, life)
        try:
            told = self._told(name, machine)
            child = self._starter.start_agents(name, machine, launch, told)
        except OSError as error:
            self._cannot_start(name, error)
            return
        self._crew.add(child)
        self._limits.not_alone()
        self._watch.add(machine, child, is_host=False)

    def _told(self, name: str, machine: str | None) -> Told:
        return Told(
            on_line=partial(self._said, name),
            on_unreachable=lambda why: self._care.machine_gone(machine or ""),
        )

    def _cannot_start(self, name: str, error: OSError) -> None:
        reason = f"{name} cannot be started: {error}"
        self._talk.problem(reason, self._crew.machine_of(name))
        self._ask_host_to_stop("failed", reason)

    def _said(self, name: str, line: bytes) -> None:
        event = events.parse_event(line)
        if isinstance(event, events.Logged):
            self._talk.logged(name, event)
        elif isinstance(event, events.Noise):
            self._talk.noise(name, event)
        elif isinstance(event, events.Pong):
            self._watch.pong(self._crew.machine_of(name) or "", name, event.n)
        elif name == HOST:
            self._host_said(event)
        else:
            self._supervisor_said(event)

    def _host_said(self, event: events.Event) -> None:
        if isinstance(event, events.Progress):
            self._view.progress(event)
            self._limits.heard()
        elif isinstance(event, events.AgentChanged):
            self._view.agent(event)
        elif isinstance(event, events.StateChanged):
            self._view.state(event.state)
            self._limits.entered(event.state)
            if event.state not in OPEN_STATES:
                self._watch.expect_ends()
            if event.state == RUNNING_STATE and self._interruption == "no":
                self._is_detached = self._request.is_detached
        elif isinstance(event, events.Listening):
            self._limits.expect_next_state()
            if self._listening is None and self._interruption == "no":
                self._start_agents(event)
        elif isinstance(event, events.Finished):
            self._host_finished(event.result)

    def _host_finished(self, result: Mapping[str, Any] | None) -> None:
        self._host_result = result or self._run.read_left_result()
        self._has_host_finished = True
        self._close_down(grace_s=STOP_GRACE_S)

    def _supervisor_said(self, event: events.Event) -> None:
        if isinstance(event, events.AgentStarted):
            self._roll.started(event.agent, event.incarnation)
        elif isinstance(event, events.AgentExited):
            self._roll.exited(event.agent, is_abnormal=event.is_abnormal)
            if event.is_abnormal:
                self._tell_host_exited(event.agent, event.how, event.pid)

    def _tell_host_exited(self, agent: str, how: str, pid: int | None = None) -> None:
        if not self._has_host_finished:
            command = {"command": "agent_exited", "agent": agent, "how": how, "pid": pid}
            self._crew.tell_host(command)

    def _seat_left(self, agent: str) -> None:
        if agent not in self._roll.ended:
            self._tell_host_exited(agent, "its hand-started process is gone")

    def _ask_host_to_stop(self, status: str, reason: str) -> None:
        if self._crew.host is not None and not self._is_closing:
            self._crew.tell_host({"command": "stop", "reason": reason, "status": status})
            self._limits.told_to_stop()

    def _give_up_on_host(self, what: str) -> None:
        host = self._crew.host
        assert host is not None, "a host that was not started has no deadline"
        self._reaper.end(host, what)
        self._talk.last_words(host)
        self._close_down(grace_s=0.0)

    def _child_exited(self, child: Child) -> None:
        machine = self._crew.machine_of(child.name)
        if machine is not None and child.loss() is not None:
            self._watch.lose(machine, child.loss() or "")
            return
        self._crew.mark_exited(child)
        child.drain()
        self._reaper.leader_ended(child)
        if machine is not None:
            self._watch.remove(machine, child)
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
            how = child.describe_exit()
            self._problem_of(child, f"host (pid {child.pid}) {how} before the run was over")
            self._talk.last_words(child)
            self._close_down(grace_s=0.0)

    def _supervisor_exited(self, child: Child) -> None:
        if self._is_closing:
            return
        machine = self._crew.machine_of(child.name) or ""
        left = self._roll.left_on(machine)
        if left:
            how = f"{child.name} (pid {child.pid}) {child.describe_exit()}"
            self._problem_of(child, f"{how} before its agents {', '.join(left)} were done")
            self._talk.last_words(child)
            self._agents_lost(left, f"its supervisor {how}")
        self._care.supervisor_ended(machine)
        if self._crew.are_supervisors_over() and not self._seats:
            self._limits.alone()

    def _agents_lost(self, agents: tuple[str, ...], how: str) -> None:
        for agent in () if self._is_closing else agents:
            self._roll.exited(agent, is_abnormal=True)
            self._tell_host_exited(agent, how)

    def _close_down(self, *, grace_s: float) -> None:
        """The host is done or gone: the rest has to end too, in the time that shutdown is given."""
        if self._is_closing:
            return
        self._is_closing = True
        self._limits.over()
        self._watch.stop_seeking()
        now_s = time.monotonic()
        self._deadlines.set("stop", now_s + grace_s, self._tell_stop)
        limit_s = grace_s + self._timeouts.shutdown_s + END_MARGIN_S
        late = f"has not ended within {limit_s:g} s of the end of the run"
        for child in self._crew.everybody():
            is_due = child.name != HOST or self._has_host_finished
            if is_due and not self._reaper.has_ended(child):
                self._reaper.expect_end(child, now_s + limit_s, late)
        self._seats.end(now_s + limit_s)

    def _tell_stop(self) -> None:
        command = {"command": "stop", "reason": "the run is over"}
        self._crew.tell_supervisors(command)
        self._seats.send(command)

    def _signalled(self, mask: int) -> None:
        for number in self._signals.take():
            if self._interruption == "no":
                self._interrupt(number)
            elif self._interruption == "clean" and number is not signal.SIGHUP:
                self._end_at_once()  # a closing terminal sends two SIGHUP: that is no second word

    def _interrupt(self, number: signal.Signals) -> None:
        self._interruption = "clean"
        self._watch.stop_seeking()
        self._talk.say("stopping; press Ctrl-C again to end at once", "warning")
        by = "the operator" if number is signal.SIGINT else number.name
        self._ask_host_to_stop("interrupted", f"interrupted by {by}")

    def _end_at_once(self) -> None:
        self._interruption = "at once"
        self._talk.say("ending at once", "warning")
        self._is_closing = True
        self._limits.over()
        self._deadlines.cancel("stop")
        self._seats.close()
        for child in self._crew.everybody():
            if not self._reaper.has_ended(child):
                self._reaper.kill(child, "was ended at once on the operator's word")
