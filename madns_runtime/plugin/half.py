"""
A half of a simulation as the runtime calls it, in real time and in lockstep alike.

What the author of a plug-in sees of a call is settled here: what it may return, how what it raised is
told, what goes to the log, when the host half's timer is due. When a call is made is its caller's.
"""

from __future__ import annotations

import contextlib
import math
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from madns_runtime.config import RunConfig
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.medium.carrier import Carrier
from madns_runtime.medium.outcomes import NO_MEDIUM, LinkOutcome
from madns_runtime.plain_values import OwnCopies
from madns_runtime.plugin import time_limit, validation
from madns_runtime.plugin.api import AgentSimulation, HostSimulation
from madns_runtime.plugin.context import clean_text, describe_exception
from madns_runtime.plugin.host_calls import HostCalls
from madns_runtime.plugin.jobs import describe_failed_job
from madns_runtime.plugin.registry import Role, load_function, load_half, parse_parameters, resolve
from madns_runtime.processes import own_age_s
from madns_runtime.protocol.messages import Service, Transmission
from madns_runtime.reactor.forking import CAME_BACK
from madns_runtime.timeline.action import ActionKind, ActionRefused

ACTION_METHODS: Final = ("begin_action", "end_action")
STAND_S: Final = 1e-6
"""A half that asks for times nearer to each other lets simulated time stand."""
REPEATS_MAX: Final = 100_000
"""Calls of the timer, or jobs, at one simulated time; more means that the half never lets time go on."""
READY_SHARE = 0.8
"""Share of timeouts.host_start_s, or timeouts.agents_ready_s, for loading."""
LEFT_SHARE = 0.1
"""Share of that which a process still gets to load when it needed nearly all its time to start."""


class HalfFailed(PluginError):
    """A half cannot go on; the text says which of its methods did what, and in which line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RoleProgram:
    """The class and settings that one role runs, loaded once."""

    make: Callable[[], Any]
    """The half's class."""
    parameters: Any
    medium: Callable[[Any, Any], Any] | None = None
    """Makes the medium of messages between agents; the host's alone, where there is one."""
    has_medium: bool = False
    """Whether the simulation declares one."""
    columns: tuple[str, ...] = ()
    """Fields whose newest values are told."""
    actions: tuple[ActionKind, ...] = ()
    """Actions that the simulation declares for timelines."""
    incarnation: int = 1
    """Number of this process of an agent."""
    agent_parameters: Mapping[str, Any] = field(default_factory=dict)
    """Parameters of each agent, parsed: one object for all that share them."""
    copies: OwnCopies = field(default_factory=OwnCopies, compare=False)

    def parameters_of(self, agent: str) -> Any:
        """Return the parameters of an agent: its own, where it could change a part that others have, too."""
        return self.copies.of(self.agent_parameters.get(agent, self.parameters))

    @classmethod
    def load(
        cls, config: RunConfig, role: Role, tell: Callable[[str], None] = lambda doing: None
    ) -> RoleProgram:
        """
        Import the half of *role* and parse the simulation's parameters.

        Args:
            config: The run.
            role: Whose half.
            tell: Told what is being done, and at last nothing: who hears no more of this process knows why.

        Raises:
            MadnsError: It cannot be found, does not load, or lacks a method of its contract.
        """
        base = Path(config.base_directory)
        timeouts = config.timeouts
        # A process that still loads when it is given up could not say what holds it; it was waited for from its start.
        limit_s = timeouts.host_start_s if role == "host" else timeouts.agents_ready_s
        limit_s *= READY_SHARE
        if config.time.is_lockstep:  # where nobody gives up on whom a busy computer keeps waiting
            time_limit.set_limit(min(timeouts.loading_s, limit_s))
        else:
            left_s = max(limit_s - own_age_s(), LEFT_SHARE * limit_s)
            time_limit.set_limit(timeouts.loading_s, wall_limit_s=left_s)
        tell(f"importing {config.simulation}")
        descriptor = resolve(config.simulation, base)
        tell(f"importing the {role}'s half of {config.simulation}")
        make = load_half(descriptor, role, base)
        tell(f"making the parameters of {config.simulation}")
        parameters = parse_parameters(descriptor, config.parameters)
        of_agents = dict.fromkeys(config.agents.resolved_names(), parameters)
        for rule in reversed(config.agent_parameters):
            of_agents |= dict.fromkeys(rule.agents, parse_parameters(descriptor, rule.parameters))
        has_medium = descriptor.medium is not None
        medium = None
        if descriptor.medium is not None and role == "host":
            tell(f"importing the medium of {config.simulation}")
            medium = load_function(descriptor.medium, base)
        tell("")
        return cls(
            make=make,
            parameters=parameters,
            medium=medium,
            has_medium=has_medium,
            columns=descriptor.columns,
            agent_parameters=of_agents,
            actions=descriptor.actions,
        )


class Half:
    """
    One half, made and called.

    Args:
        make: Its class.
        log: Takes level and text: the traceback of what a call raised.

    Raises:
        HalfFailed: It cannot be made.
    """

    contract: type = AgentSimulation
    checks: Mapping[str, Callable[[Any], Any]] = validation.AGENT_CHECKS

    def __init__(self, make: Callable[[], Any], log: Callable[[str, str], None]) -> None:
        self._log = log
        self.name: str = getattr(make, "__name__", "the simulation's half")
        self._is_set_up = False  # or was about to be
        try:
            self.simulation = make()
        except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
            traceback.print_exception(error)  # to stderr.txt: nobody records yet
            raise HalfFailed(describe_exception(error, f"{self.name}.__init__", make)) from error

    def call(self, name: str, *arguments: Any) -> Any:
        """
        Call a method, and return what it returned.

        Raises:
            HalfFailed: It raised, or returned something against its contract.
        """
        return self.run(name, None, *arguments)

    def run(self, name: str, function: Callable[..., Any] | None, *arguments: Any) -> Any:
        """
        Call a function of the plug-in's, or without one the half's method *name*.

        Raises:
            HalfFailed: It raised, or returned something against its contract.
        """
        self._is_set_up |= name == "setup"
        try:
            value = (function or self._method(name))(*arguments)
        except BaseException as error:
            if isinstance(error, ActionRefused) and name in ACTION_METHODS:
                raise  # it says that it cannot, and the run goes on
            raise self.failure(name, error, function) from error
        check = self.checks.get(name)
        if check is None:
            return value
        try:
            return check(value)
        except PluginError as error:
            raise HalfFailed(f"{self.name}.{name} returned {clean_text(str(error))}") from error
        except Exception as error:  # of the value's own class, while it was looked at
            text = describe_exception(error, "looking at it")
            raise HalfFailed(
                f"{self.name}.{name} returned a {type(value).__name__}: {text}"
            ) from error

    def abandon(self) -> None:
        """Have an agent's half whose setup was called let go of what outlives it; what it raises is logged and changes nothing."""
        if self._is_set_up:
            with contextlib.suppress(HalfFailed):
                self.call("abandon")

    def _method(self, name: str) -> Callable[..., Any]:
        """Return a method; of a half that does not inherit it, and lacks it, the one that it would inherit."""
        own: Callable[..., Any] | None = getattr(self.simulation, name, None)
        return own or partial(getattr(self.contract, name), self.simulation)

    def failure(self, name: str, error: BaseException, function: Any = None) -> HalfFailed:
        """Return what to raise, or to tell, of an error that a method, or *function*, raised; its traceback is logged."""
        if isinstance(error, MachineError):  # a full disk: no fault of the plug-in's
            return HalfFailed(clean_text(str(error)))
        self._log("critical", "".join(traceback.format_exception(error)))
        called = function or getattr(self.simulation, name, None)
        return HalfFailed(describe_exception(error, f"{self.name}.{name}", called))


class HostHalf(Half):
    """
    The host's half: it also wants to be woken, and gets the values of its jobs.

    Args:
        program: Its class, and what makes its medium.
        log: Takes level and text: the traceback of what a call raised.
        carrier: Messages between agents.
        calls: Where its calls are noted.

    Raises:
        HalfFailed: It cannot be made.
    """

    contract = HostSimulation
    checks = validation.HOST_CHECKS

    def __init__(
        self,
        program: RoleProgram,
        log: Callable[[str, str], None],
        *,
        carrier: Carrier,
        calls: HostCalls | None = None,
    ) -> None:
        self.carrier = carrier
        self.next_s: float | None = None
        """Simulated time at which its timer is to be called; None if it wants none."""
        self.lateness_s = 0.0
        """Delay of the timer's last call behind the time asked for, s."""
        self.intake: Callable[[str, Any, Service], None] | None = None
        """Takes what agents sent while faults are in force, and hands it on to `take_now`."""
        self._calls = calls or HostCalls()
        self._timer_s = self._stand_s = -math.inf
        self.repeats = 0  # of the timer at one simulated time
        self._make_medium = program.medium
        self._calls.name = getattr(program.make, "__name__", "")
        began_s = self._calls.begin("__init__")
        super().__init__(program.make, log)
        self._calls.end("__init__", began_s)
        self._receive = self._method("receive")

    @property
    def doing(self) -> str:
        """Method that is called, or was called last."""
        return self._calls.method

    def set_up(self, context: Any) -> None:
        """
        Have it prepare, and make the medium of messages between agents.

        Raises:
            HalfFailed: As `call`, or what is to be a medium is none.
        """
        self.call("setup", context)
        if self._make_medium is not None:
            self.carrier.medium = self.run("medium", self._make_medium, self.simulation, context)

    def take(self, agent: str, message: Any, service: Service = Service.RELIABLE) -> None:
        """
        Hand in what an agent sent: to the host's half, or (a Transmission) to others, through the medium.

        Args:
            agent: Its name.
            message: What it sent.
            service: Its class of service.

        Raises:
            HalfFailed: `receive` or the medium raised, or what the medium returned is no outcome.
        """
        if self.intake is not None:
            self.intake(agent, message, service)
            return
        self.take_now(agent, message)

    def take_now(self, agent: str, message: Any) -> None:
        """
        Hand in what an agent sent, whatever faults are in force; see `take`.

        Raises:
            HalfFailed: As there.
        """
        if not isinstance(message, Transmission):
            # As `call` has it, for what comes with every tick of every agent.
            began_s = self._calls.begin("receive")
            try:
                self._receive(agent, message)
            except BaseException as error:
                raise self.failure("receive", error) from error
            finally:
                self._calls.end("receive", began_s)
            self._check_strays()
            return
        outcomes: Any = (LinkOutcome(to=message.to, outcome=NO_MEDIUM),)
        if self.carrier.medium is not None:
            outcomes = self.run("medium.carry", self.carrier.medium.carry, agent, message)
        try:
            settled = self.carrier.enter(agent, message, outcomes)
        except PluginError as error:
            text = clean_text(str(error))
            raise HalfFailed(f"{self.name}.medium.carry returned {text}") from error
        except Exception as error:  # of a value's own class, while it was looked at
            text = describe_exception(error, "looking at it")
            raise HalfFailed(f"{self.name}.medium.carry returned an outcome: {text}") from error
        if (tell := getattr(self.carrier.medium, "settled", None)) is not None:
            self.run("medium.settled", tell, agent, message, settled)
        self.carrier.hand_over()

    def run(self, name: str, function: Callable[..., Any] | None, *arguments: Any) -> Any:
        """
        Call a function of the plug-in's, or without one the half's method *name*; the call is noted.

        Raises:
            HalfFailed: It raised, or returned something against its contract.
        """
        began_s = self._calls.begin(name)
        try:
            value = super().run(name, function, *arguments)
        finally:
            self._calls.end(name, began_s)
        self._check_strays()
        return value

    def _check_strays(self) -> None:
        if forked_in := self._calls.forked_in():
            raise HalfFailed(f"{forked_in} {CAME_BACK}")

    def wake(self, t_s: float) -> None:
        """
        Note that the timer is wanted at *t_s*, if not earlier.

        Raises:
            PluginError: It is no simulated time.
        """
        wanted_s = validation.next_time(t_s)
        if wanted_s is None:
            raise PluginError("wake(None): expected a simulated time in seconds")
        if self.next_s is None or wanted_s < self.next_s:
            self.next_s = wanted_s

    def begin_timer(self, t_s: float) -> None:
        """Have the timer called for *t_s*, where simulated time starts, and for no earlier time."""
        self._timer_s = self.next_s = t_s

    def call_timer(self, now_s: float) -> None:
        """
        Call the timer for the time it was wanted at, now that the clock shows *now_s*.

        What it returns, or asks `wake` for meanwhile, is due next. The times it is called for never
        go back: what was asked for too late counts as asked for the time of the call before.

        Raises:
            HalfFailed: As `call`; it returned no later time, or never lets simulated time go on.
        """
        t_s = max(now_s if self.next_s is None else self.next_s, self._timer_s)
        if t_s - self._stand_s > STAND_S:
            self._stand_s, self.repeats = t_s, 0
        else:
            self.repeats += 1
        if self.repeats > REPEATS_MAX:
            raise HalfFailed(
                f"{self.name}.timer asked {REPEATS_MAX} times in a row for t = {t_s:g} s: simulated time stands"
            )
        self._timer_s, self.next_s = t_s, None
        self.lateness_s = max(0.0, now_s - t_s)
        wanted_s = self.call("timer", t_s)
        if wanted_s is None:
            return
        if wanted_s <= t_s:
            raise HalfFailed(
                f"{self.name}.timer returned {wanted_s:g}, called for t = {t_s:g} s: expected a later"
                " time, or None"
            )
        self.wake(wanted_s)

    def take_job(self, job: int, future: Future[Any]) -> None:
        """
        Hand in the value of a job that is done.

        Raises:
            HalfFailed: The job or `result` raised, or the executor has cancelled the job.
        """
        doing = f"{self.name}: job {job}"
        if future.cancelled():
            raise HalfFailed(f"{doing}: the executor has cancelled it")
        if (error := future.exception()) is None:
            self.call("result", job, future.result())
            return
        if not isinstance(error, BrokenExecutor):
            self._log("critical", "".join(traceback.format_exception(error)))
        raise HalfFailed(describe_failed_job(error, doing))
