"""
The operator's side of a run: one loop that tells the supervision what happens, and carries out what it decides.

`Supervision` decides; here are the descriptors, processes, threads and the clock. The operator of a detached run
leaves once the run is under way.
"""

from __future__ import annotations

import dataclasses
import os
import selectors
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch import actions, events
from cosmos_cli.launch import child as programs
from cosmos_cli.launch import run_events as happened
from cosmos_cli.launch.actions import Action
from cosmos_cli.launch.background import BackgroundTasks
from cosmos_cli.launch.child import ChildProgram, LocalChild, RemoteProgram
from cosmos_cli.launch.children import HOST
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.manual_line import ManualLine
from cosmos_cli.launch.order_socket import SelectorReaders
from cosmos_cli.launch.remote_child import RemoteChild
from cosmos_cli.launch.reporter import Reporter
from cosmos_cli.launch.request import LaunchOutcome, LaunchRequest, View
from cosmos_cli.launch.run_events import RunEvent
from cosmos_cli.launch.signals import OperatorSignals
from cosmos_cli.launch.supervision import Supervision
from madns_runtime.hardware.order_socket import Fault, OrderSocket
from madns_runtime.timing.granted_clock import GrantedClock

HOST_MODULE = "madns_runtime.host"
AGENT_MODULE = "madns_runtime.agent"
LOCKSTEP_ENVIRONMENT: Mapping[str, str] = {"PYTHONHASHSEED": "0"}
"""With it the order of a set of names is the same in every run."""
STALL_S = 5.0
"""A turn of the loop that took this long means that the operator was stopped (Ctrl-Z), not its children."""
STOOD_STILL = (
    "this computer slept, or this command was stopped, for {stood_s:.0f} s; in real time who is silent for"
    " timeouts.silence_s is lost: keep it awake, or let a board have the run (--detach --host MACHINE)"
)
SELECT_MAX_S = 1.0
"""Longest wait of the loop: a wake-up lost to a bug costs this long, not the run."""
SELECT_MIN_S = 0.005  # while what is nearly due waits for a clock that stands
PUSH_INTERVAL_S = 0.02
"""While a line to another machine is full, it is tried again this often."""
BACKGROUND_END_S = 10.0
"""Time for questions to machines that are under way when the run is over."""
CLEAN_S = 3.0
FORCED_S = 3.0
"""Times for what a lost machine's earlier incarnation has left there: to end cleanly, then by force."""
NO_MACHINES: Mapping[str, RemoteMachine] = {}

_boot_s = partial(time.clock_gettime, getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
"""The time that goes on while the computer is suspended, s."""

Child = LocalChild | RemoteChild
"""One started program, here or on another machine; none of its methods waits."""


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
        self._remote = remote
        self._run = RunDirectory(request.directory)
        self._view = view
        self._reporter = Reporter(view)
        self._signals = signals
        self._selector = selectors.DefaultSelector()
        self._background = BackgroundTasks(self._selector)
        self._supervision = Supervision(request, remote)
        self._children: dict[str, Child] = {}
        self._is_lockstep = request.config.time.is_lockstep
        # In lockstep nobody is late because the computer is busy: while the host, or anything that it started,
        # waits for a processor, none of the operator's limits comes closer.
        self._now_s = GrantedClock(self._living).now_s if self._is_lockstep else time.monotonic
        self._exited: set[str] = set()
        self._manual_lines: dict[str, ManualLine] = {}
        self._orders: OrderSocket | None = None
        self._events: deque[RunEvent] = deque()
        self._is_handling = False
        self._do: Mapping[type, Callable[[Any], object]] = {
            actions.StartHost: lambda _: self._start(
                HOST, request.host_machine, request.host_launch()
            ),
            actions.StartAgents: self._start_agents,
            actions.StepBack: lambda action: os.nice(action.nice),
            actions.Send: lambda action: self._children[action.name].send(action.command),
            actions.Terminate: lambda action: self._children[action.name].terminate(),
            actions.Kill: self._kill,
            actions.LookAtGroup: self._look_at_group,
            actions.CloseChild: self._close_child,
            actions.Reattach: lambda action: self._children[action.name].reattach(),
            actions.QuoteLastWords: self._quote_last_words,
            actions.FindLastCall: self._find_last_call,
            actions.AskMachine: self._ask_machine,
            actions.ReachMachine: self._reach_machine,
            actions.OpenManualLine: self._open_manual_line,
            actions.SendOnManualLine: lambda action: self._manual_lines[action.agent].send(
                action.command
            ),
            actions.StopListening: lambda action: self._manual_lines[action.agent].stop_listening(),
            actions.CloseManualLine: lambda action: self._manual_lines.pop(action.agent).close(),
            actions.AnswerOrder: self._answer_order,
            actions.Say: lambda action: self._view.say(action.text, action.level),
            actions.ReportProblem: lambda a: self._reporter.problem(a.text, a.machine),
            actions.Show: lambda action: self._reporter.show(action.name, action.event),
        }

    def run(self) -> LaunchOutcome:
        """Start everything, wait for the end of everything, and say how it went."""
        self._selector.register(self._signals, selectors.EVENT_READ, self._signalled)
        supervision = self._supervision
        try:
            self._listen_for_orders()
            self._post(happened.Begun())
            while not supervision.is_over:
                self._turn()
        finally:
            if self._orders is not None:
                self._orders.close()
                self._orders = None
            if supervision.is_detached:
                self._let_go()
            else:
                self._clear_up()
            self._background.close(BACKGROUND_END_S)
            self._selector.close()
        result = supervision.host_result or self._run.read_left_result()
        return LaunchOutcome(
            host_result=result,
            interruption=supervision.interruption,
            problems=self._reporter.problems(result),
            is_detached=supervision.is_detached,
        )

    # The loop -------------------------------------------------------------------------------------

    def _turn(self) -> None:
        turned_s, turned_boot_s = self._now_s(), _boot_s()
        for key, mask in self._selector.select(self._wait_s(turned_s)):
            # An earlier callback of this round may have closed this one's descriptor.
            if self._selector.get_map().get(key.fd) is key:
                key.data(mask)
        for name, child in tuple(self._children.items()):
            if name not in self._exited and child.has_exited():
                self._child_exited(name, child)
        now_s = self._now_s()
        if now_s - turned_s > STALL_S:
            self._supervision.postpone(now_s - turned_s)
        if not self._is_lockstep and (stood_s := _boot_s() - turned_boot_s) > STALL_S:
            self._reporter.stood_still(STOOD_STILL.format(stood_s=stood_s))
        self._carry_out(self._supervision.tick(now_s))
        self._handle_events()

    def _wait_s(self, now_s: float) -> float:
        wait_s = self._supervision.wait_s(now_s)
        waits = [child.push() for child in self._children.values()]
        limit_s = PUSH_INTERVAL_S if any(waits) else SELECT_MAX_S
        return limit_s if wait_s is None else min(max(wait_s, SELECT_MIN_S * bool(wait_s)), limit_s)

    def _post(self, event: RunEvent) -> None:
        """Tell the supervision of an event; one that comes of carrying out another waits for its turn."""
        self._events.append(event)
        if not self._is_handling:
            self._handle_events()

    def _handle_events(self) -> None:
        while self._events:
            self._carry_out(self._supervision.handle(self._events.popleft(), self._now_s()))

    def _carry_out(self, decided: list[Action]) -> None:
        self._is_handling = True
        try:
            for action in decided:
                self._do[type(action)](action)
        finally:
            self._is_handling = False

    def _living(self) -> Iterator[int]:
        """Yield the processes that the run's clock waits for."""
        for name, child in self._children.items():
            if not child.has_exited():
                yield from () if child.pid is None else (child.pid,)
            elif not self._supervision.has_ended(name):
                yield from child.members()

    def _let_go(self) -> None:
        """Leave a detached run to itself."""
        for child in self._children.values():
            child.release()

    def _clear_up(self) -> None:
        """End whatever lives, outside of the loop: the last resort, also when the loop itself has failed."""
        for line in self._manual_lines.values():
            line.close()
        self._carry_out(self._supervision.stop_seeking())
        children = tuple(self._children.values())
        with ThreadPoolExecutor(max(1, len(children))) as pool:
            ended = pool.map(lambda child: child.end_by_force(), children)
            leftovers = [pid for pids in ended for pid in pids]
        for child in children:
            child.close()
        if leftovers:
            self._reporter.problem(f"processes {', '.join(map(str, leftovers))} outlived SIGKILL")
        self._reporter.noise_in_all()

    # Events ---------------------------------------------------------------------------------------

    def _signalled(self, mask: int) -> None:
        for number in self._signals.take():
            self._post(happened.Signalled(number))

    def _listen_for_orders(self) -> None:
        """Open the socket for faults that are to be inserted, where a run has devices that take them."""
        is_hosts = self._request.is_detached  # it goes on when this process leaves
        if self._is_lockstep or is_hosts or not any(self._request.devices.values()):
            return
        try:
            self._orders = OrderSocket(
                self._run.path, SelectorReaders(self._selector), self._ordered
            )
        except OSError as error:
            self._view.say(f"no fault can be inserted in this run: {error}", "warning")

    def _ordered(self, number: int, fault: Fault) -> None:
        self._post(happened.FaultOrdered(number, *fault))

    def _answer_order(self, action: actions.AnswerOrder) -> None:
        if self._orders is not None:
            self._orders.answer(action.number, action.refusal)

    def _said(self, name: str, line: bytes) -> None:
        event = events.parse_event(line)
        if name == HOST and isinstance(event, events.Finished) and event.result is None:
            event = dataclasses.replace(event, result=self._run.read_left_result())
        self._post(happened.ChildSaid(name, event))

    def _child_exited(self, name: str, child: Child) -> None:
        self._exited.add(name)
        if child.loss is not None:
            self._post(happened.ChildLost(name, child.loss))
            return
        child.drain()
        result = self._run.read_left_result() if name == HOST else None
        how, code = child.describe_exit(), child.returncode()
        self._post(happened.ChildExited(name, how, code, result))

    # Actions --------------------------------------------------------------------------------------

    def _start_agents(self, action: actions.StartAgents) -> None:
        launch = self._request.agent_launch(
            action.machine, action.agents, action.listening, action.start
        )
        self._start(action.name, action.machine, launch)

    def _start(self, name: str, machine: str | None, launch: Mapping[str, Any]) -> None:
        try:
            if machine is not None and machine in self._remote:
                started: Child = self._start_there(name, machine, launch)
            else:
                started = self._start_here(name, machine, launch)
        except OSError as error:
            self._post(happened.StartFailed(name, machine, str(error)))
        else:
            self._children[name] = started
            self._post(happened.ChildStarted(name, machine, started.pid))

    def _start_here(self, name: str, machine: str | None, launch: Mapping[str, Any]) -> LocalChild:
        directory = self._request.directory
        program = ChildProgram(
            name=name,
            arguments=programs.HOST_PROGRAM if name == HOST else programs.AGENT_PROGRAM,
            stderr=directory / _stderr_of(name, machine),
            run_directory=str(directory),
            environment=LOCKSTEP_ENVIRONMENT if self._is_lockstep else {},
        )
        return LocalChild(program, self._selector, launch=launch, on_line=partial(self._said, name))

    def _start_there(self, name: str, machine: str, launch: Mapping[str, Any]) -> RemoteChild:
        program = RemoteProgram(
            name=name,
            module=HOST_MODULE if name == HOST else AGENT_MODULE,
            run_directory=self._request.place_of(machine).directory,
            stderr=_stderr_of(name, machine),
            access=self._request.config.recording.access,
        )
        return RemoteChild(
            program,
            self._remote[machine],
            self._background,
            launch=launch,
            on_line=partial(self._said, name),
            tell=self._post,
        )

    def _kill(self, action: actions.Kill) -> None:
        child = self._children[action.name]
        self._post(happened.GroupKilled(action.name, action.why, tuple(child.members())))
        child.kill()

    def _look_at_group(self, action: actions.LookAtGroup) -> None:
        child = self._children[action.name]
        members, age_s = tuple(child.members()), child.members_age_s()
        self._post(happened.GroupSeen(action.name, members, age_s))

    def _close_child(self, action: actions.CloseChild) -> None:
        self._exited.add(action.name)
        self._children[action.name].close()

    def _quote_last_words(self, action: actions.QuoteLastWords) -> None:
        child = self._children[action.name]

        def show(lines: list[str]) -> None:
            if lines:
                shown = "\n".join(f"  | {line}" for line in lines)
                self._view.say(f"the last lines of {child.stderr}:\n{shown}", "error")

        child.tell_last_words(show)

    def _find_last_call(self, action: actions.FindLastCall) -> None:
        self._children[action.name].tell_last_call(
            self._request.session_hex,
            lambda where: self._post(happened.LastCallFound(action.name, action.how, where)),
        )

    def _ask_machine(self, action: actions.AskMachine) -> None:
        def answered(is_alive: bool | None, failure: MachineFailure | None) -> None:
            event = happened.MachineAsked(action.machine, bool(is_alive))
            self._post(dataclasses.replace(event, why=failure.text) if failure else event)

        self._background.submit(self._remote[action.machine].is_alive, answered)

    def _reach_machine(self, action: actions.ReachMachine) -> None:
        directory = self._request.place_of(action.machine).directory
        self._background.submit(
            partial(
                self._remote[action.machine].return_to,
                directory,
                clean_s=CLEAN_S,
                forced_s=FORCED_S,
            ),
            lambda _, failure: self._post(
                happened.MachineReached(
                    action.machine, failure is None, "" if failure is None else str(failure)
                )
            ),
        )

    def _open_manual_line(self, action: actions.OpenManualLine) -> None:
        agent = action.agent
        line = self._manual_lines[agent] = ManualLine(
            agent,
            self._selector,
            launch=self._request.agent_launch(action.machine, (agent,), action.listening),
            on_line=partial(self._said, agent),
            on_presence=lambda is_here: self._post(
                happened.ManualAgentJoined(agent) if is_here else happened.ManualAgentLeft(agent)
            ),
        )
        try:
            command = line.open()
        except OSError as error:
            self._post(happened.StartFailed(agent, None, f"no socket for it: {error}"))
            return
        within_s = self._request.config.timeouts.agents_ready_s
        named = self._request.labels.named(agent)
        text = f"start {named} by hand within {within_s:g} s, in another terminal:"
        self._view.say(f"{text}\n  {command}", "manual")


def _stderr_of(name: str, machine: str | None) -> str:
    """Return the file of a child's standard error, below the run directory."""
    return f"{HOST if name == HOST else f'machines/{machine}'}/stderr.txt"
