"""A protocol that its user has written: called with blame, and what it returns looked at before it is used."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from madns_runtime.errors import BlamedError
from madns_runtime.plain_values import is_real, is_whole
from madns_runtime.plugin.context import describe_exception
from madns_runtime.plugin.isolation import is_from_outside
from madns_runtime.simulations.constellation.flight.interface.answers import (
    CommandRequest,
    FlightAnswer,
)
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport


def _are_pairs(given: Any) -> bool:
    return isinstance(given, list | tuple) and all(
        isinstance(x, list | tuple) and len(x) == 2 for x in given
    )


def _are_commands(given: Any) -> bool:
    return isinstance(given, list | tuple) and all(isinstance(x, CommandRequest) for x in given)


PARTS: Final[Mapping[str, tuple[str, Callable[[Any], bool]]]] = {
    "t_s": ("a number or None", lambda given: given is None or is_real(given)),
    "commands": ("a list of CommandRequest", _are_commands),
    "sends": ("a list of pairs", _are_pairs),
    "logs": ("a list of pairs", _are_pairs),
    "board_us": ("a whole number", is_whole),
    "fault": ("a text", lambda given: isinstance(given, str)),
    "source": ("bytes", lambda given: isinstance(given, bytes)),
}
"""Parts of an answer that are no values for flight software to command: what they are to be, and whether they are."""


class OwnProtocol:
    """
    A `FlightProtocol` around one of a user's own.

    Args:
        protocol: Made.
    """

    def __init__(self, protocol: Any) -> None:
        self._protocol = protocol
        self._name = type(protocol).__name__
        self.answers_by_time = bool(getattr(protocol, "answers_by_time", True))

    @property
    def faults(self) -> Mapping[str, int]:
        """Return its counts of what it could not take, as far as that is a mapping of numbers."""
        told = getattr(self._protocol, "faults", {})
        known = told if isinstance(told, Mapping) else {}
        return {str(kind): int(n) for kind, n in known.items() if is_real(n) and math.isfinite(n)}

    def setup(self, setup: SetupReport) -> Sequence[bytes]:
        """
        Return the packets that tell the software who it is.

        Raises:
            BlamedError: It raised, or returned something else.
        """
        return self._packets("setup", self._protocol.setup, setup)

    def tick(self, tick: TickReport) -> Sequence[bytes]:
        """
        Return the packets of a tick.

        Raises:
            BlamedError: It raised, or returned something else.
        """
        return self._packets("tick", self._protocol.tick, tick)

    def feed(self, data: bytes) -> Sequence[FlightAnswer]:
        """
        Take bytes, and return the answers that are whole now.

        Raises:
            BlamedError: It raised, or returned something else.
        """
        told = self._called("feed", self._protocol.feed, data)
        if not isinstance(told, list | tuple) or not all(isinstance(x, FlightAnswer) for x in told):
            raise self._wrong("feed", "a list of FlightAnswer", told)
        for answer in told:
            for part, (expected, is_right) in PARTS.items():
                given = getattr(answer, part)
                if not is_right(given):
                    raise self._wrong("feed", f"FlightAnswer.{part} to be {expected}", given)
        return told

    def _packets(self, method: str, call: Callable[[Any], Any], report: Any) -> Sequence[bytes]:
        told = self._called(method, call, report)
        kinds = bytes | bytearray | memoryview
        if not isinstance(told, list | tuple) or not all(isinstance(x, kinds) for x in told):
            raise self._wrong(method, "a list of bytes", told)
        return [bytes(packet) for packet in told]

    def _called(self, method: str, call: Callable[[Any], Any], argument: Any) -> Any:
        try:
            return call(argument)
        except BaseException as error:  # of a user's class: told by its name
            if is_from_outside(error):
                raise
            raise BlamedError(describe_exception(error, f"{self._name}.{method}", call)) from error

    def _wrong(self, method: str, expected: str, told: Any) -> BlamedError:
        return BlamedError(f"{self._name}.{method}: expected {expected}, got {told!r:.80}")
