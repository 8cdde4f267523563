"""
Protocol `json_lines`: one JSON object per line, and the schema of all lines. Pure.

    to the program      {"setup": {...}}
                        {"t_s": 0.1, "readings": {...}, "messages": [...], "results": [...], "refusals": [...]}
    from the program    {"commands": [...], "send": [...], "estimate": {...}, "log": [...]}

The JSON Schema of the lines that a vehicle and its flight program exchange is made from what the code reads and
writes; docs/flight-messages.schema.json is this schema, written by `python docs/generate.py`.
"""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Iterable, Mapping, Set
from typing import Any, Final, Literal

import orjson

from madns_runtime.errors import PluginError
from madns_runtime.plain_values import is_line
from madns_runtime.simulations.constellation.flight.interface.answers import (
    CommandRequest,
    FlightAnswer,
    shown,
)
from madns_runtime.simulations.constellation.flight.interface.content import LOG_LEVELS
from madns_runtime.simulations.constellation.flight.interface.dialogue import to_plain
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport
from madns_runtime.simulations.constellation.messages import (
    CommandFrame,
    CommandResult,
    Delivery,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.thrust import Vector

LINE_BYTES_MAX = 262_144
"""Of one line; a longer one is no answer."""
KEYS = frozenset({"t_s", "commands", "send", "estimate", "log"})
SENDING = {"to", "payload"}
LOGGING = {"level", "text"}
COMMANDS = {
    "delta_v_m_s": ({"delta_v_m_s", "at_s"}, {"frame"}),
    "torque_n_m": ({"torque_n_m", "at_s", "duration_s"}, set()),
    "ballistic_m2_kg": ({"ballistic_m2_kg", "at_s"}, set()),
    "dipole_a_m2": ({"dipole_a_m2", "at_s", "duration_s"}, set()),
}
"""By the key that tells the command: which keys it must and may have."""
KINDS = {
    "delta_v_m_s": "delta_v",
    "torque_n_m": "torque",
    "ballistic_m2_kg": "ballistic",
    "dipole_a_m2": "dipole",
}
"""By the same key: the command's kind."""

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
Schema = dict[str, Any]
TEXT: Final[Schema] = {"type": "string"}
NUMBER: Final[Schema] = {"type": "number"}
WHOLE: Final[Schema] = {"type": "integer"}
ANYTHING: Final[Schema] = {
    "description": "What JSON can hold; bytes are shown to a program as an object with the one key base64."
}
VECTOR: Final[Schema] = {"type": "array", "items": NUMBER, "minItems": 3, "maxItems": 3}
OF_TYPE: Final[Mapping[Any, Schema]] = {
    str: TEXT,
    float: NUMBER,
    int: WHOLE,
    Any: ANYTHING,
    Vector | None: {**VECTOR, "type": ["array", "null"]},
}
OF_KEY: Final[Mapping[str, Schema]] = {
    "delta_v_m_s": VECTOR,
    "torque_n_m": VECTOR,
    "dipole_a_m2": VECTOR,
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
    "rate_hz": NUMBER,
    "duration_s": NUMBER,
    "epoch_utc": TEXT,
    "frame": TEXT,
    "input": {"enum": ["measurements", "truth"]},
    "first_number": WHOLE,
    "seed": WHOLE,
    "settings": {"type": "object"},
}
"""Content of the first line to a program."""


OVERLONG: Final = FlightAnswer(fault=f"expected lines of at most {LINE_BYTES_MAX} bytes")
NO_NUMBERS: Final = re.compile(rb"[-:\[,\s](?:nan|inf(?:inity)?)\b", re.IGNORECASE)
"""As C, C++ and Python write what is no finite number, which JSON cannot."""


class JsonLines:
    """Both directions of a conversation in lines."""

    answers_by_time = False
    """One answer for each tick, in their order."""
    unended = "without the end of a line"
    """Words on a rest that does not go on."""

    def __init__(self) -> None:
        self.faults: dict[str, int] = {}
        """None: a line that is no answer is a fault of whoever wrote it."""
        self.rest = b""
        """Of a line under way."""

    def setup(self, setup: SetupReport) -> list[bytes]:
        """Return the first line."""
        told = {name: getattr(setup, name) for name in SETUP}
        return [orjson.dumps({"setup": told}) + b"\n"]

    def tick(self, tick: TickReport) -> list[bytes]:
        """Return the line of a tick."""
        told: dict[str, Any] = {
            "t_s": tick.t_s,
            "readings": {
                name: {"t_s": reading.t_s, "values": reading.values}
                for name, reading in tick.readings.items()
            },
            "messages": [dataclasses.asdict(one) for one in tick.messages],
            "results": [dataclasses.asdict(one) for one in tick.results],
            "refusals": [dataclasses.asdict(one) for one in tick.refusals],
        }
        if samples := getattr(tick.readings, "samples", None):
            told["samples"] = {
                name: [{"t_s": one.t_s, "values": one.values} for one in news]
                for name, news in samples.items()
            }
        return [orjson.dumps(told, to_plain, orjson.OPT_SERIALIZE_NUMPY) + b"\n"]

    def feed(self, data: bytes) -> list[FlightAnswer]:
        """Take what came, and return the answers that are whole now; what has no end is one, too, with its fault."""
        *lines, self.rest = (self.rest + data).split(b"\n")
        answers = [OVERLONG if len(line) > LINE_BYTES_MAX else read_answer(line) for line in lines]
        if len(self.rest) > LINE_BYTES_MAX:
            answers.append(OVERLONG)
            self.rest = b""
        return answers


def read_answer(line: bytes) -> FlightAnswer:
    """Return one line of a program as an answer: a JSON object, each of whose parts may be missing."""
    try:
        answer = orjson.loads(line)
    except orjson.JSONDecodeError:
        cure = ""
        if not line.lstrip().startswith(b"{"):
            cure = " (standard output is for answers alone: print to standard error)"
        elif NO_NUMBERS.search(line):
            cure = " (JSON has no NaN and no infinity: write null)"
        return FlightAnswer(fault=f"expected a JSON object, got {shown(line)}{cure}")
    try:
        _check(answer)
        commands = tuple(_command(command) for command in answer.get("commands", ()))
        for message in answer.get("send", ()):
            _check_keys("a message", message, SENDING)
        for words in answer.get("log", ()):
            _check_keys("words to log", words, LOGGING)
    except (PluginError, TypeError) as error:
        return FlightAnswer(fault=str(error), source=line)
    return FlightAnswer(
        t_s=answer.get("t_s"),
        commands=commands,
        sends=tuple((message["to"], message["payload"]) for message in answer.get("send", ())),
        estimate=answer.get("estimate"),
        logs=tuple((words["level"], words["text"]) for words in answer.get("log", ())),
        source=line,
    )


def _check(answer: Any) -> None:
    if not isinstance(answer, Mapping):
        raise PluginError("expected a JSON object")
    unknown = set(answer) - KEYS
    if unknown:
        raise PluginError(
            f"expected the keys {', '.join(sorted(KEYS))}, got {_told(sorted(unknown))}"
        )
    t_s = answer.get("t_s")
    if t_s is not None and (isinstance(t_s, bool) or not isinstance(t_s, int | float)):
        raise PluginError(f"expected t_s to be the number that the tick has, got {t_s!r:.80}")
    for key in ("commands", "send", "log"):
        items = answer.get(key, [])
        if not isinstance(items, list) or not all(isinstance(item, Mapping) for item in items):
            raise PluginError(f"expected {key} to be a list of objects")


def _command(command: Mapping[str, Any]) -> CommandRequest:
    told = [key for key in COMMANDS if key in command]
    if len(told) != 1:
        raise PluginError(f"expected a command with one of {', '.join(COMMANDS)}")
    key = told[0]
    _check_keys("a command", command, *COMMANDS[key])
    return CommandRequest(
        kind=KINDS[key],
        value=command[key],
        at_s=command["at_s"],
        frame=command.get("frame", "rtn"),
        duration_s=command.get("duration_s", 0.0),
    )


def _check_keys(
    what: str, item: Mapping[str, Any], must: set[str], may: Set[str] = frozenset()
) -> None:
    if not must <= set(item) <= must | may:
        raise PluginError(
            f"expected {what} with {', '.join(sorted(must))}, got {_told(item) or 'nothing'}"
        )


def _told(keys: Iterable[str]) -> str:
    """Return keys of a program's as a message shows them, whatever is in them: in one line, and not without end."""
    text = ", ".join(keys)
    return text if is_line(text) else shown(text.encode())


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
    samples = {
        "type": "object",
        "additionalProperties": _list_of("reading"),
        "description": "All new readings, oldest first, of the sensors that have more than one; else left out.",
    }
    must = {"t_s": NUMBER, "readings": readings, **parts}
    return _object({**must, "samples": samples}, required=must)


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
