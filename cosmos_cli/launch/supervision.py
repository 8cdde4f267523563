"""
The supervision of a run, as one pure object: it takes events and the time, and returns actions.

It starts the host, then one supervisor per machine, tells the host which processes died, and gives a machine that
returns its agents again. It is over when no process of the run lives: all are asked to stop, then ended by force
(`Children`). Every wait is a moment on its agenda. No clock, socket or process here: the operator's loop acts.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Literal

from cosmos_cli.launch import actions, events
from cosmos_cli.launch import run_events as happened
from cosmos_cli.launch.actions import Action, Agenda
from cosmos_cli.launch.child_commands import STOP, agent_exited, device_changed, stop_host
from cosmos_cli.launch.children import HOST, ChildRecord, Children
from cosmos_cli.launch.device_watch import DeviceWatch, with_devices
from cosmos_cli.launch.fault_orders import FaultOrders
from cosmos_cli.launch.host_limits import OPEN_STATES, RUNNING_STATE, HostLimits
from cosmos_cli.launch.machine_watch import SILENCE_S, MachineWatch
from cosmos_cli.launch.manual_agents import ManualAgents
from cosmos_cli.launch.request import LaunchRequest
from cosmos_cli.launch.restarts import Restarts
from cosmos_cli.launch.run_events import RunEvent

STOP_GRACE_S = 2.0
"""Time from the host's end until supervisors are told to stop: agents that follow the host need less."""
END_MARGIN_S = 5.0
"""A supervisor kills its own late agents and names them; the operator's deadline comes after that."""
HOST_EXIT_CODES = (0, 1)
"""Exit codes of a host that came to its end: the run was complete, or was not."""


class Supervision:
    """
    Decides what is done in one run, from its beginning to its end.

    Args:
        request: What to start.
        remote: Names of the machines that are other computers.
    """

    def __init__(self, request: LaunchRequest, remote: Iterable[str] = ()) -> None:
        self._request = request
        self._timeouts = request.config.timeouts
        self._agenda = agenda = Agenda()
        self._children = Children(agenda)
        self._restarts = Restarts(request)
        self._limits = HostLimits(
            agenda,
            request.config,
            overdue=self._give_up_on_host,
            alone=partial(self._ask_host_to_stop, "failed"),
        )
        self._watch = MachineWatch(
            remote, self._children, agenda, timeouts=self._timeouts, lost=self._machine_lost
        )
        self._manual = ManualAgents(agenda)
        self._devices = DeviceWatch(
            agenda,
            request.config.hardware.on_device_loss,
            record=lambda event: self._children.tell_host(device_changed(event)),
            abort=self._device_lost,
        )
        self._orders = FaultOrders(agenda, self._children, request.devices)
        self._listening: events.Listening | None = None
        self._has_host_finished = False
        self._is_closing = False
        self.host_result: Mapping[str, Any] | None = None
        """The host's report at its end, or the one that it left."""
        self.interruption: Literal["no", "clean", "at once"] = "no"
        self.is_detached = False
        """Whether the run goes on without its operator from now on."""
        self._handlers: Mapping[type, Callable[[Any], None]] = {
            happened.Begun: self._begin,
            happened.ChildStarted: self._child_started,
            happened.StartFailed: self._start_failed,
            happened.ChildSaid: self._child_said,
            happened.ChildExited: self._child_exited,
            happened.ChildLost: lambda event: self._machine_lost(
                self._children[event.name].machine or "", event.why
            ),
            happened.LineBroke: self._watch.broke,
            happened.Reattached: self._watch.reattached,
            happened.ReattachFailed: self._watch.reattach_failed,
            happened.GroupSeen: self._children.group_seen,
            happened.GroupKilled: self._children.killed,
            happened.LastCallFound: self._children.last_call_found,
            happened.MachineAsked: self._machine_asked,
            happened.MachineReached: self._machine_reached,
            happened.SignalUndelivered: lambda event: self._watch.give_up(event.machine),
            happened.ManualAgentJoined: self._manual.joined,
            happened.ManualAgentLeft: self._manual_agent_left,
            happened.FaultOrdered: self._orders.ordered,
            happened.Signalled: self._signalled,
        }

    # What the loop asks ---------------------------------------------------------------------------

    def handle(self, event: RunEvent, now_s: float) -> list[Action]:
        """Return what is to be done about an event, in this order."""
        self._agenda.now_s = now_s
        self._handlers[type(event)](event)
        return self._agenda.take()

    def tick(self, now_s: float) -> list[Action]:
        """Return what is to be done about the moments that have come by now."""
        self._agenda.now_s = now_s
        for decide in self._agenda.due(now_s):
            decide()
        return self._agenda.take()

    def wait_s(self, now_s: float) -> float | None:
        """Return the time until `tick` has something to do; None for never."""
        return self._agenda.wait_s(now_s)

    def postpone(self, by_s: float) -> None:
        """Move all moments: for time in which the operator itself was stopped."""
        self._agenda.postpone(by_s)

    @property
    def is_over(self) -> bool:
        """Whether nothing of the run lives, or it goes on by itself."""
        is_at_rest = not self._manual and not self._watch.is_trying
        return self.is_detached or (is_at_rest and not self._children.living)

    def has_ended(self, name: str) -> bool:
        """Tell whether none of a child's group lives, or nothing more can be done about it."""
        child = self._children.find(name)
        return child is not None and child.has_ended

    def stop_seeking(self) -> list[Action]:
        """Look for lost machines no more, and return what is to be said of them."""
        self._watch.stop_seeking()
        return self._agenda.take()

    # Starting -------------------------------------------------------------------------------------

    def _begin(self, event: happened.Begun) -> None:
        self._watch.check_later(self._check_signs_of_life)
        self._agenda.do(actions.StartHost())

    def _child_started(self, event: happened.ChildStarted) -> None:
        self._children.started(event)
        self._watch.add(event.machine, event.name)
        if event.name == HOST:
            self._limits.started()
        else:
            self._limits.not_alone()

    def _start_failed(self, event: happened.StartFailed) -> None:
        why = f"{event.name} cannot be started: {event.why}"
        self._agenda.problem(why, event.machine)
        self._ask_host_to_stop("failed", why)

    def _start_agents(self, listening: events.Listening) -> None:
        self._listening = listening
        for machine, names in self._request.machines.items():
            if supervised := self._restarts.supervised_on(machine):
                self._agenda.do(actions.StartAgents(machine, supervised, listening))
            for name in names:
                if name in self._request.manual:
                    self._manual.open(name, machine, listening)
        if self._request.nice:  # after the children, who would inherit it
            self._agenda.do(actions.StepBack(self._request.nice))

    # What children say ----------------------------------------------------------------------------

    def _child_said(self, said: happened.ChildSaid) -> None:
        name, event, child = said.name, said.event, self._children.find(said.name)
        if isinstance(event, events.Logged | events.Noise):
            self._agenda.do(actions.Show(name, event))
        elif child is None:
            self._supervisor_said(event)  # an agent started by hand is its own
        elif isinstance(event, events.Loading):
            child.doing = event.doing
        elif isinstance(event, events.ProcessKnown):
            child.pid = event.pid
        elif isinstance(event, events.PingAnswered):
            self._watch.pong(child.machine, name, event.n)
        elif name == HOST:
            self._host_said(event)
        else:
            self._supervisor_said(event)

    def _host_said(self, event: events.Event) -> None:
        if isinstance(event, events.Progress | events.StateChanged):
            self._agenda.do(actions.Show(HOST, event))
        if isinstance(event, events.Progress):
            self._limits.heard()
        elif isinstance(event, events.StateChanged):
            self._limits.entered(event.state)
            if event.state not in OPEN_STATES:
                self._watch.expect_ends()
                self._devices.over()
            elif event.state == RUNNING_STATE:
                self._devices.running()
            if event.state == RUNNING_STATE and self.interruption == "no":
                self.is_detached = self._request.is_detached
        elif isinstance(event, events.Listening):
            self._limits.expect_next_state()
            if self._listening is None and self.interruption == "no":
                self._start_agents(event)
        elif isinstance(event, events.Finished):
            self._host_finished(event.result)

    def _host_finished(self, result: Mapping[str, Any] | None) -> None:
        earlier = self.host_result or {}  # from a copy of the host that its plug-in forked
        self.host_result = earlier if earlier.get("status") == "failed" else result
        self._has_host_finished = True
        self._close_down(grace_s=STOP_GRACE_S)

    def _supervisor_said(self, event: events.Event) -> None:
        if isinstance(event, events.AgentStarted):
            self._restarts.started(event.agent, event.incarnation)
        elif isinstance(event, events.AgentExited):
            if event.is_on_purpose:
                self._restarts.killed(event.agent, will_return=event.will_restart)
            else:
                self._restarts.exited(event.agent, is_abnormal=event.is_abnormal)
            if event.is_abnormal:
                self._tell_host_exited(event.agent, event.how, event.pid)
        elif isinstance(event, events.DeviceChanged):
            self._devices.heard(event)
        elif isinstance(event, events.FaultInserted):
            self._orders.answered(event)

    def _device_lost(self, device: str, why: str) -> None:
        self._agenda.say(f"{device}: {why}: the run ends (hardware.on_device_loss: abort)", "error")
        self._ask_host_to_stop("failed", why, who=device)

    def _tell_host_exited(self, agent: str, how: str, pid: int | None = None) -> None:
        if not self._has_host_finished:
            self._children.tell_host(agent_exited(agent, how, pid))

    def _manual_agent_left(self, event: happened.ManualAgentLeft) -> None:
        if self._manual.left(event.agent) and event.agent not in self._restarts.ended:
            self._tell_host_exited(event.agent, "its hand-started process is gone")

    # The end of children --------------------------------------------------------------------------

    def _child_exited(self, event: happened.ChildExited) -> None:
        child = self._children[event.name]
        if child.has_exited:  # given up with its machine
            return
        self._watch.forget_line(child)
        self._children.leader_ended(child)
        self._watch.remove(child.machine, child.name)
        if child.name != HOST:
            self._supervisor_exited(child, event.how)
        elif not self._has_host_finished and not self._is_closing:
            self._host_exited(event)

    def _host_exited(self, event: happened.ChildExited) -> None:
        """Judge a host that ended without a word of its result: too long for a line, or cut off."""
        if event.result is not None and event.code in HOST_EXIT_CODES:
            self._host_finished(event.result)
        else:
            self._agenda.do(actions.FindLastCall(HOST, event.how), actions.QuoteLastWords(HOST))
            self._close_down(grace_s=0.0)

    def _supervisor_exited(self, child: ChildRecord, how: str) -> None:
        if self._is_closing:
            return
        machine = child.machine or ""
        if left := self._restarts.left_on(machine):
            how = f"{child} {how}{child.meanwhile}"
            self._agenda.problem(f"{how} before its agents {', '.join(left)} were done", machine)
            self._agenda.do(actions.QuoteLastWords(child.name))
            self._agents_lost(left, f"its supervisor {how}")
        if self._is_wanted(machine):
            self._watch.revive(machine)
        if all(child.has_exited for child in self._children.supervisors) and not self._manual:
            self._limits.alone()

    def _agents_lost(self, agents: tuple[str, ...], how: str) -> None:
        for agent in () if self._is_closing else agents:
            self._restarts.exited(agent, is_abnormal=True)
            self._tell_host_exited(agent, how)

    def _give_up_on_host(self, late: str) -> None:
        host = self._children[HOST]  # one that was not started has no deadline
        self._children.end(host, late + host.meanwhile)
        self._agenda.do(actions.FindLastCall(HOST), actions.QuoteLastWords(HOST))
        self._close_down(grace_s=0.0)

    # Machines -------------------------------------------------------------------------------------

    def _check_signs_of_life(self) -> None:
        self._watch.check_later(self._check_signs_of_life)
        for machine, child in self._watch.check():
            if child is None:
                self._machine_lost(machine, f"no sign of life for {SILENCE_S:g} s")
            else:  # its machine also runs the host, which does give signs of life
                self._children.kill(self._children[child], "gives no sign of life")

    def _machine_asked(self, event: happened.MachineAsked) -> None:
        """Try another connection where one gives no sign of life: that it broke may be known a moment later."""
        for name in self._watch.asked(event):
            self._watch.broke(happened.LineBroke(name, event.why))

    def _machine_lost(self, machine: str, why: str) -> None:
        """Give up what runs there, tell the host whose agents they were, and look for the machine."""
        if not self._watch.lose(machine):
            return
        text = f"machine {machine} is lost: {why}"
        devices = self._request.devices.get(machine, ())
        self._agenda.problem(f"{text}{with_devices(devices, machine)}", machine)
        lost = [child for child in self._children.living if child.machine == machine]
        for child in lost:
            self._watch.forget_line(child)
            self._children.abandon(child)
        if any(child.name == HOST for child in lost):
            self._close_down(grace_s=0.0)
        self._agents_lost(self._restarts.left_on(machine), text)
        self._devices.machine_lost(devices, machine, text)
        self._watch.reach(machine)

    def _machine_reached(self, event: happened.MachineReached) -> None:
        may_try_again = self._watch.reached(event)
        if event.is_reached:
            self._machine_back(event.machine)
        elif may_try_again and self._is_wanted(event.machine):
            self._watch.reach_later(event.machine)
        else:
            self._watch.give_up(event.machine)

    def _machine_back(self, machine: str) -> None:
        """Give a returned machine its agents again, if the run still goes on."""
        if not self._is_wanted(machine):
            self._agenda.say(f"{machine} answers; nothing of the run lives there any more")
            return
        agents = self._restarts.restartable_on(machine)
        self._agenda.say(
            f"{machine} has returned; its agents {', '.join(agents)} rejoin", "warning"
        )
        assert self._listening is not None
        start = self._restarts.next_start_on(machine)
        self._restarts.handed_over(agents)
        self._agenda.do(actions.StartAgents(machine, agents, self._listening, start))

    def _is_wanted(self, machine: str) -> bool:
        """Tell whether a lost machine that returns would be given its agents again."""
        is_open = self._limits.is_open and not self._is_closing and self.interruption == "no"
        return is_open and bool(self._restarts.restartable_on(machine))

    # The end of the run ---------------------------------------------------------------------------

    def _ask_host_to_stop(self, status: str, why: str, who: str = "operator") -> None:
        if self._children.host is not None and not self._is_closing:
            self._children.tell_host(stop_host(status, why, who))
            self._limits.told_to_stop()

    def _close_down(self, *, grace_s: float) -> None:
        """End the rest too, in the time that shutdown is given: the host is done or gone."""
        if self._is_closing:
            return
        self._is_closing = True
        self._devices.over()
        self._limits.over()
        self._watch.stop_seeking()
        self._agenda.after("stop", grace_s, self._tell_stop)
        limit_s = grace_s + self._timeouts.shutdown_s + END_MARGIN_S
        late = f"has not ended within {limit_s:g} s of the end of the run"
        for child in self._children.living:
            if child.name != HOST or self._has_host_finished:
                self._children.expect_end(child, limit_s, late)
        self._manual.end(limit_s)

    def _tell_stop(self) -> None:
        self._agenda.do(*(actions.Send(child.name, STOP) for child in self._children.supervisors))
        self._manual.send(STOP)

    def _signalled(self, event: happened.Signalled) -> None:
        if self.interruption == "no":
            self._interrupt(event.number)
        elif self.interruption == "clean" and event.number is not signal.SIGHUP:
            self._end_at_once()  # a closing terminal sends two SIGHUP: that is no second word

    def _interrupt(self, number: signal.Signals) -> None:
        self.interruption = "clean"
        self._watch.stop_seeking()
        self._agenda.say("stopping; press Ctrl-C again to end at once", "warning")
        by = "the operator" if number is signal.SIGINT else number.name
        self._ask_host_to_stop("interrupted", f"interrupted by {by}")

    def _end_at_once(self) -> None:
        self.interruption = "at once"
        self._agenda.say("ending at once", "warning")
        self._is_closing = True
        self._limits.over()
        self._agenda.cancel("stop")
        self._manual.close()
        for child in self._children.living:
            self._children.kill(child, "was ended at once on the operator's word")
