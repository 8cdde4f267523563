"""
A half of a simulation as the runtime calls it, in real time and in lockstep alike.

What the author of a plug-in sees of a call is settled here: what it may return, how what it raised is
told, what goes to the log, when the host half's timer is due. When a call is made is its caller's.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from madns_runtime.config import RunConfig
from madns_runtime.context import clean_text, describe_exception
from madns_runtime.errors import MachineError, PluginError
from madns_runtime.executor import WORKER_DIED, JobFailed
from madns_runtime.plugin import returned
from madns_runtime.plugin.registry import Role, load_half, parse_parameters, resolve

CHECKS: Final[Mapping[str, Callable[[Any], Any]]] = {
    "initial_data": returned.initial_data,
    "timer": returned.next_time,
    "finish": returned.summary,
}
"""What a method returned, made plain or refused; of other methods nobody looks at it."""


class HalfFailed(PluginError):
    """A half cannot go on; the text says which of its methods did what, and in which line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What one role runs, loaded once."""

    make: Callable[[], Any]
    """The half's class."""
    parameters: Any
    life: int = 1
    """Which process of an agent this is."""

    @classmethod
    def load(cls, config: RunConfig, role: Role) -> Program:
        """
        Import the half of *role* and parse the simulation's parameters.

        Raises:
            MadnsError: It cannot be found, does not load, or lacks a method of its contract.
        """
        base = Path(config.base_directory)
        descriptor = resolve(config.simulation, base)
        return cls(
            make=load_half(descriptor, role, base),
            parameters=parse_parameters(descriptor, config.parameters),
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

    def __init__(self, make: Callable[[], Any], log: Callable[[str, str], None]) -> None:
        self._log = log
        self.name: str = getattr(make, "__name__", "the simulation's half")
        try:
            self.simulation = make()
        except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
            traceback.print_exception(error)  # to stderr.txt: nobody records yet
            raise HalfFailed(describe_exception(error, f"{self.name}.__init__")) from error

    def call(self, name: str, *arguments: Any) -> Any:
        """
        Call a method, and return what it returned.

        Raises:
            HalfFailed: It raised, or returned something against its contract.
        """
        try:
            value = getattr(self.simulation, name)(*arguments)
        except BaseException as error:  # noqa: BLE001 - a plug-in may raise anything
            raise self.failure(name, error) from error
        check = CHECKS.get(name)
        if check is None:
            return value
        try:
            return check(value)
        except PluginError as error:
            raise HalfFailed(f"{self.name}.{name} returned {clean_text(str(error))}") from error

    def failure(self, name: str, error: BaseException) -> HalfFailed:
        """Return what to raise, or to tell, of an error that a method raised; its traceback is logged."""
        if isinstance(error, MachineError):  # a full disk: no fault of the plug-in's
            return HalfFailed(clean_text(str(error)))
        self._log("critical", "".join(traceback.format_exception(error)))
        return HalfFailed(describe_exception(error, f"{self.name}.{name}"))


class HostHalf(Half):
    """The host's half: it also wants to be woken, and gets the values of its jobs."""

    next_s: float | None = None
    """Simulated time at which its timer is to be called; None if it wants none."""

    def wake(self, t_s: float) -> None:
        """
        Note that the timer is wanted at *t_s*, if not earlier.

        Raises:
            PluginError: It is no simulated time.
        """
        wanted_s = returned.next_time(t_s)
        if wanted_s is None:
            raise PluginError("wake(None): expected a simulated time in seconds")
        if self.next_s is None or wanted_s < self.next_s:
            self.next_s = wanted_s

    def call_timer(self, t_s: float) -> None:
        """
        Call the timer at simulated time *t_s*; what it returns, or asks `wake` for meanwhile, is due next.

        Raises:
            HalfFailed: As `call`.
        """
        self.next_s = None
        wanted_s = self.call("timer", t_s)
        if wanted_s is not None:
            self.wake(wanted_s)

    def take_job(self, job: int, future: Future[Any]) -> None:
        """
        Hand in the value of a job that is done.

        Raises:
            HalfFailed: The job or `result` raised.
        """
        error = future.exception()
        if error is None:
            self.call("result", job, future.result())
            return
        doing = f"{self.name}: job {job}"
        if isinstance(error, BrokenExecutor):
            raise HalfFailed(f"{doing}: {WORKER_DIED}")
        self._log("critical", "".join(traceback.format_exception(error)))
        is_told = isinstance(error, JobFailed)
        raise HalfFailed(f"{doing}: {error}" if is_told else describe_exception(error, doing))
