"""What a flight program answers, read and carried out. Pure but for what the context does."""

from __future__ import annotations

from collections.abc import Mapping, Set
from typing import Any

import orjson

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.simulations.constellation.flight.api import FlightContext

TIME_TOLERANCE_S = 1e-5
"""Of the time that an answer names, which may have been printed with six decimals."""
KEYS = frozenset({"t_s", "commands", "send", "estimate", "log"})
SENDING = {"to", "payload"}
LOGGING = {"level", "text"}
COMMANDS = {
    "delta_v_m_s": ({"delta_v_m_s", "at_s"}, {"frame"}),
    "torque_n_m": ({"torque_n_m", "at_s", "duration_s"}, set()),
    "ballistic_m2_kg": ({"ballistic_m2_kg", "at_s"}, set()),
}
"""By the key that tells the command: which keys it must and may have."""


def carry_out(line: bytes, context: FlightContext, program: str, *, t_s: float) -> None:
    """
    Do what one line of a program asks for.

    Args:
        line: A JSON object; each of its parts may be missing.
        context: Takes commands, messages, estimates and words.
        program: Its name, for who is to blame.
        t_s: Of the tick that it answers; an answer that names a time names this one.

    Raises:
        BlamedError: It is no answer, or asks for what cannot be.
    """
    try:
        answer = orjson.loads(line)
        _check(answer, t_s)
        for command in answer.get("commands", ()):
            _command(command, context)
        for message in answer.get("send", ()):
            _check_keys("a message", message, SENDING)
            context.send(message["to"], message["payload"])
        if answer.get("estimate") not in (None, {}):
            context.estimate(answer["estimate"])
        for words in answer.get("log", ()):
            _check_keys("words to log", words, LOGGING)
            context.log(words["level"], words["text"])
    except orjson.JSONDecodeError as error:
        raise BlamedError(f"{program}: expected a JSON object, got {_shown(line)}") from error
    except (PluginError, TypeError) as error:
        raise BlamedError(f"{program}: {error}; it wrote {_shown(line)}") from error


def _check(answer: Any, t_s: float) -> None:
    if not isinstance(answer, Mapping):
        raise PluginError("expected a JSON object")
    unknown = set(answer) - KEYS
    if unknown:
        raise PluginError(
            f"expected the keys {', '.join(sorted(KEYS))}, got {', '.join(sorted(unknown))}"
        )
    if abs(answer.get("t_s", t_s) - t_s) > TIME_TOLERANCE_S:
        raise PluginError(f"expected the answer to the tick at {t_s:g} s, got {answer['t_s']!r}")
    for key in ("commands", "send", "log"):
        items = answer.get(key, [])
        if not isinstance(items, list) or not all(isinstance(item, Mapping) for item in items):
            raise PluginError(f"expected {key} to be a list of objects")


def _command(command: Mapping[str, Any], context: FlightContext) -> None:
    told = [key for key in COMMANDS if key in command]
    if len(told) != 1:
        raise PluginError(f"expected a command with one of {', '.join(COMMANDS)}")
    _check_keys("a command", command, *COMMANDS[told[0]])
    at_s = command["at_s"]
    if told[0] == "delta_v_m_s":
        context.delta_v(command["delta_v_m_s"], at_s=at_s, frame=command.get("frame", "rtn"))
    elif told[0] == "torque_n_m":
        context.torque(command["torque_n_m"], at_s=at_s, duration_s=command["duration_s"])
    else:
        context.ballistic(command["ballistic_m2_kg"], at_s=at_s)


def _check_keys(
    what: str, item: Mapping[str, Any], must: set[str], may: Set[str] = frozenset()
) -> None:
    if not must <= set(item) <= must | may:
        raise PluginError(
            f"expected {what} with {', '.join(sorted(must))}, got {', '.join(item) or 'nothing'}"
        )


def _shown(line: bytes) -> str:
    text = line[:200].decode("utf-8", "backslashreplace")
    return repr(text + (" [cut]" if len(line) > 200 else ""))
