"""Calls flight software: what it lacks is skipped, and what it raises is blamed on its own line."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any

from madns_runtime.context import describe_exception
from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin import returned
from madns_runtime.simulations.constellation.flight.api import FlightContext, Readings
from madns_runtime.simulations.constellation.messages import CommandResult, Delivery, Refusal


class Pilot:
    """
    One vehicle's flight software behind its contract.

    Args:
        make: Returns an object that has some of the contract's methods: a class.

    Raises:
        BlamedError: It raised.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self._name = getattr(make, "__name__", "flight software")
        self._software = self._call("__init__", make)
        self._step: Callable[[float, Readings], object] = getattr(
            self._software, "step", _do_nothing
        )

    def setup(self, context: FlightContext) -> None:
        """
        Let it prepare; one without `setup` finds its context all the same.

        Raises:
            BlamedError: It raised.
        """
        if hasattr(self._software, "setup"):
            self._call("setup", self._software.setup, context)
        else:
            with contextlib.suppress(AttributeError):  # a class with slots does without
                self._software.context = context

    def step(self, t_s: float, readings: Readings) -> None:
        """
        Let it do a tick's work.

        Raises:
            BlamedError: It raised.
        """
        try:
            self._step(t_s, readings)
        except (Exception, SystemExit) as error:
            raise self._blamed("step", error) from error

    def receive(self, message: Delivery) -> None:
        """
        Hand it a message by radio.

        Raises:
            BlamedError: It raised.
        """
        self._call("receive", getattr(self._software, "receive", _do_nothing), message)

    def command_result(self, result: CommandResult) -> None:
        """
        Tell it what became of a command.

        Raises:
            BlamedError: It raised.
        """
        self._call("command_result", getattr(self._software, "command_result", _do_nothing), result)

    def message_refused(self, refusal: Refusal) -> None:
        """
        Tell it that a message was refused.

        Raises:
            BlamedError: It raised.
        """
        method = getattr(self._software, "message_refused", _do_nothing)
        self._call("message_refused", method, refusal)

    def finish(self) -> dict[str, Any]:
        """
        Return its summary.

        Raises:
            BlamedError: It raised, or returned what is no summary.
        """
        summary = self._call("finish", getattr(self._software, "finish", _no_summary))
        try:
            return returned.summary(summary)
        except PluginError as error:
            raise BlamedError(f"{self._name}.finish returned {error}") from error

    def _call(self, name: str, method: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return method(*arguments)
        except (Exception, SystemExit) as error:
            raise self._blamed(name, error) from error

    def _blamed(self, name: str, error: BaseException) -> BlamedError:
        if isinstance(error, BlamedError):
            return error
        return BlamedError(describe_exception(error, f"{self._name}.{name}"))


def _do_nothing(*_arguments: object) -> None:
    """Stand in for a method that flight software does not have."""


def _no_summary() -> Mapping[str, Any]:
    return {}
