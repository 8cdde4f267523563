"""
Answers of a flight program, read and carried out, and the schema of all lines. Pure but for what the context does.

The JSON Schema of the lines that a vehicle and its flight program exchange is made from what the code reads and
writes; docs/flight-messages.schema.json is this schema, written by `python docs/generate.py`.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Mapping, Set
from typing import Any, Final, Literal

import orjson

from madns_runtime.errors import BlamedError, PluginError
from madns_runtime.simulations.constellation.flight.api import FlightContext
from madns_runtime.simulations.constellation.messages import (
    CommandFrame,
    CommandResult,
    Delivery,
    TransmissionRefusal,
)

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

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
LOG_LEVELS: Final = ("critical", "error", "warning", "info", "debug")
Schema = dict[str, Any]
TEXT: Final[Schema] = {"type": "string"}
NUMBER: Final[Schema] = {"type": "number"}
WHOLE: Final[Schema] = {"type": "integer"}
ANYTHING: Final[Schema] = {
    "description": "What JSON can hold; bytes are shown to a program as an object with the one key base64."
}
VECTOR: Final[Schema] = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}
OF_TYPE: Final[Mapping[Any, Schema]] = {str: TEXT, float: NUMBER, int: WHOLE, Any: ANYTHING}
OF_KEY: Final[Mapping[str, Schema]] = {
    "delta_v_m_s": VECTOR,
    "torque_n_m": VECTOR,
    "ballistic_m2_kg": NUMBER,
    "at_s": NUMBER,
    "duration_s": NUMBER,
    "frame": {"enum": list(typing.get_args(CommandFrame))},
}
SETUP: Final[Mapping[str, Schema]] = {
    "name": TEXT,
    "satellite": TEXT,
    "agents": {"type": "array", "items": TEXT},
    "index": WHOLE,
    "tick_hz": NUMBER,
    "duration_s": NUMBER,
    "epoch_utc": TEXT,
    "frame": TEXT,
    "input": {"enum": ["measurements", "truth"]},
    "first_number": WHOLE,
    "seed": WHOLE,
    "settings": {"type": "object"},
}
"""Content of the first line to a program."""


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


def message_schema() -> Schema:
    """Return the schema of a line in either direction; $defs hold the one of each direction and of each part."""
    return {
        "$schema": DIALECT,
        "title": "Lines between a vehicle and its flight program",
        "description": (
            "One JSON object per line. To the program: setup once, then tick. From it: one answer per tick."
        ),
        "anyOf": [_ref("to_program"), _ref("from_program")],
        "$defs": {
            "to_program": {"oneOf": [_ref("setup"), _ref("tick")]},
            "from_program": _ref("answer"),
            "setup": _object({"setup": _object(SETUP)}),
            "tick": _tick(),
            "reading": _object({"t_s": NUMBER, "values": {"type": "array", "items": NUMBER}}),
            "message": _of_dataclass(Delivery),
            "result": _of_dataclass(CommandResult),
            "refusal": _of_dataclass(TransmissionRefusal),
            "answer": _answer(),
            "command": {"oneOf": [_command_schema(must, may) for must, may in COMMANDS.values()]},
        },
    }


def _tick() -> Schema:
    parts = {key: _list_of(key[:-1]) for key in ("messages", "results", "refusals")}
    readings = {"type": "object", "additionalProperties": _ref("reading")}
    return _object({"t_s": NUMBER, "readings": readings, **parts})


def _answer() -> Schema:
    parts: Mapping[str, Schema] = {
        "t_s": {**NUMBER, "description": "That of the tick which is answered."},
        "commands": _list_of("command"),
        "send": {"type": "array", "items": _object({"to": TEXT, "payload": ANYTHING})},
        "estimate": {
            "type": ["object", "null"],
            "additionalProperties": {"type": ["number", "null"]},
        },
        "log": {
            "type": "array",
            "items": _object({"level": {"enum": list(LOG_LEVELS)}, "text": TEXT}),
        },
    }
    return _object({key: parts[key] for key in sorted(KEYS)}, required=())


def _command_schema(must: Iterable[str], may: Iterable[str]) -> Schema:
    keys = (*sorted(must), *sorted(may))
    return _object({key: OF_KEY[key] for key in keys}, required=sorted(must))


def _of_dataclass(cls: type) -> Schema:
    hints = typing.get_type_hints(cls)
    fields = [field.name for field in dataclasses.fields(cls)]
    return _object({name: _of_type(hints[name]) for name in fields})


def _of_type(hint: Any) -> Schema:
    if typing.get_origin(hint) is Literal:
        return {"enum": list(typing.get_args(hint))}
    return OF_TYPE[hint]


def _object(parts: Mapping[str, Schema], required: Iterable[str] | None = None) -> Schema:
    return {
        "type": "object",
        "properties": dict(parts),
        "required": list(parts if required is None else required),
        "additionalProperties": False,
    }


def _list_of(name: str) -> Schema:
    return {"type": "array", "items": _ref(name)}


def _ref(name: str) -> Schema:
    return {"$ref": f"#/$defs/{name}"}
