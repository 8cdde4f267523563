"""
Requests of flight software, in values that are the same for every protocol, and how they are carried out.

Pure but for what the context does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.plugin.context import clean_text
from madns_runtime.simulations.constellation.flight.api import AnsweredContext

TIME_TOLERANCE_S: Final = 1e-5
"""Of the time that an answer names, which may have been printed with six decimals."""
SHOWN_BYTES_MAX: Final = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRequest:
    """A command that is asked for; its values are judged where it is carried out."""

    kind: str
    """delta_v, torque, dipole or ballistic."""
    value: Any
    """Three numbers; one of a ballistic coefficient."""
    at_s: Any
    frame: Any = "rtn"
    """Of a delta_v."""
    duration_s: Any = 0.0
    """Of a torque or a dipole."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightAnswer:
    """An answer to one tick; or what was said meanwhile, by software with a clock of its own."""

    t_s: Any = None
    """Of the tick that it answers; None if it does not say."""
    commands: tuple[CommandRequest, ...] = ()
    sends: tuple[tuple[Any, Any], ...] = ()
    """Receiver and payload of each message."""
    estimate: Any = None
    """Mapping of names to numbers; None for none."""
    logs: tuple[tuple[Any, Any], ...] = ()
    """Level and text."""
    board_us: int = 0
    """The software's own clock when it was sent, us; 0 for none."""
    fault: str = ""
    """Why it is no answer, although it came whole; empty for none."""
    source: bytes = field(default=b"", repr=False)
    """Text that was written, to be shown to its writer."""


def carry_out(
    answer: FlightAnswer, context: AnsweredContext, program: str, *, t_s: float | None
) -> None:
    """
    Do what an answer asks for; where those to several ticks come at once, each may ask for what a tick may.

    Args:
        answer: Whole, from a protocol.
        context: Takes commands, messages, estimates and words.
        program: Its name, for who is to blame.
        t_s: Of the tick that it answers; an answer that names a time names this one. None to let that be.

    Raises:
        BlamedError: It is no answer, or asks for what cannot be.
    """
    try:
        if answer.fault:
            raise PluginError(answer.fault)
        if None not in (t_s, answer.t_s) and abs(answer.t_s - t_s) > TIME_TOLERANCE_S:
            raise PluginError(f"expected the answer to the tick at {t_s:g} s, got {answer.t_s!r}")
        if t_s is not None:
            context.begin_answer()
        for command in answer.commands:
            _command(command, context)
        for to, payload in answer.sends:
            context.send(to, payload)
        if answer.estimate not in (None, {}):
            context.estimate(answer.estimate)
        for level, text in answer.logs:
            context.log(level, text)
    except (PluginError, TypeError) as error:
        wrote = f"; it wrote {shown(answer.source)}" if answer.source else ""
        raise BlamedError(f"{program}: {error}{wrote}") from error


def _command(command: CommandRequest, context: AnsweredContext) -> None:
    value, at_s = command.value, command.at_s
    if command.kind == "delta_v":
        context.delta_v(value, at_s=at_s, frame=command.frame)
    elif command.kind == "torque":
        context.torque(value, at_s=at_s, duration_s=command.duration_s)
    elif command.kind == "ballistic":
        context.ballistic(value, at_s=at_s)
    elif command.kind == "dipole":
        context.dipole(value, at_s=at_s, duration_s=command.duration_s)
    else:
        raise PluginError(f"expected a command that this vehicle knows, got {command.kind}")


def told_faults(faults: Mapping[str, int]) -> str:
    """Return what a protocol counted of what it could not take, as the end of a sentence; empty if there is nothing."""
    told = ", ".join(f"{kind} {count}" for kind, count in faults.items() if count)
    return f"; it said what was no good packet: {told}" if told else ""


def shown(data: bytes) -> str:
    """Return the beginning of what was written, as a text without control characters."""
    text = data[:SHOWN_BYTES_MAX].decode("utf-8", "backslashreplace")
    return clean_text(repr(text + (" [cut]" if len(data) > SHOWN_BYTES_MAX else "")))
