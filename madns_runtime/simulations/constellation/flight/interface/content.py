"""
The table of all that a vehicle and its flight software say to each other in bytes: fixed structs. Pure.

Frames carry them little-endian, Space Packets big-endian. Every field lies on a multiple of its own size, so that
a C compiler lays the same struct out without packing; flight_frames.h and the XTCE definitions are written from
this table.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, get_args

from madns_runtime.simulations.constellation.messages import CommandFrame, CommandStatus

ByteOrder = Literal["<", ">"]
NAME_BYTES: Final = 32
"""Of a name, UTF-8, filled up with zeros; a longer one is cut."""
TAIL_BYTES_MAX: Final = 16_384
"""Of what follows a struct: a message's payload."""
LOG_BYTES_MAX: Final = 8192
"""Of the text of a log: more than the characters of it that are kept can have."""
VALUES_MAX: Final = 13
"""In one reading: truth of a rigid body."""

INPUTS: Final = ("measurements", "truth")
CLOCKS: Final = ("stepped", "own")
FRAMES: Final[tuple[str, ...]] = get_args(CommandFrame)
STATUSES: Final[tuple[str, ...]] = get_args(CommandStatus)
LOG_LEVELS: Final = ("critical", "error", "warning", "info", "debug")
ENCODINGS: Final = ("bytes", "json")
SENSORS: Final = (
    "truth",
    "gnss",
    "gyro",
    "accelerometer",
    "magnetometer",
    "star_tracker",
    "sun_sensor",
    "clock",
    "mass",
    "wheels",
)
"""By the number that stands for each reading's name, from 0; new ones are added at the end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ContentField:
    """One field of a struct."""

    name: str
    code: str
    """As in the module struct: d, Q, I, H, B, or a count before d, s or x."""
    text: str = ""
    words: tuple[str, ...] = ()
    """Meanings of the numbers of a field, from 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightContent:
    """One struct, and what may follow it."""

    name: str
    number: int
    """Type of the frame; APID of the Space Packet, counted from the protocol's first."""
    text: str
    fields: tuple[ContentField, ...]
    tail: Literal["", "bytes", "doubles"] = ""
    """bytes: as many as its field size says; doubles: as many as its field count says."""
    tail_bytes_max: int = TAIL_BYTES_MAX
    _structs: dict[str, struct.Struct] = field(default_factory=dict, compare=False, repr=False)

    def struct(self, order: ByteOrder) -> struct.Struct:
        """Return the layout in a byte order."""
        if order not in self._structs:
            codes = "".join(each.code for each in self.fields)
            self._structs[order] = struct.Struct(f"{order}{codes}")
        return self._structs[order]

    @property
    def size(self) -> int:
        """Bytes of the struct, without what follows."""
        return self.struct("<").size

    def pack(self, order: ByteOrder, values: Mapping[str, Any], tail: Any = b"") -> bytes:
        """Return struct and tail: bytes, or a sequence of numbers."""
        numbers: list[Any] = []
        for each in self.fields:
            if each.code.endswith("x"):
                continue
            value = values[each.name]
            if each.code.endswith("d") and each.code != "d":
                numbers += value
            elif each.code.endswith("s"):
                numbers.append(cut_text(value, int(each.code[:-1])))
            else:
                numbers.append(value)
        head = self.struct(order).pack(*numbers)
        return head + (
            struct.pack(f"{order}{len(tail)}d", *tail) if self.tail == "doubles" else tail
        )

    def unpack(self, order: ByteOrder, data: bytes) -> dict[str, Any] | None:
        """Return the fields, and what follows under `tail`; None if the length is not that of this content."""
        if len(data) < self.size or not self.is_size(len(data)):
            return None
        values = self._head(order, data)
        tail = data[self.size :]
        if len(tail) != self._tail_bytes(values):
            return None
        is_numbers = self.tail == "doubles"
        values["tail"] = struct.unpack(f"{order}{len(tail) // 8}d", tail) if is_numbers else tail
        return values

    def is_size(self, size: int) -> bool:
        """Tell whether struct and tail may have so many bytes together, whatever the struct says."""
        return self.size <= size <= self.size + (self.tail_bytes_max if self.tail else 0)

    def told_size(self, order: ByteOrder, data: bytes) -> int | None:
        """Return how many bytes struct and tail have by what the struct says; None if not all of it is there."""
        if not self.tail:
            return self.size
        if len(data) < self.size:
            return None
        return self.size + self._tail_bytes(self._head(order, data))

    def _head(self, order: ByteOrder, data: bytes) -> dict[str, Any]:
        numbers = iter(self.struct(order).unpack_from(data))
        values: dict[str, Any] = {}
        for each in self.fields:
            if each.code.endswith("x"):
                continue
            if each.code.endswith("d") and each.code != "d":
                values[each.name] = tuple(next(numbers) for _ in range(int(each.code[:-1])))
            elif each.code.endswith("s"):
                values[each.name] = next(numbers).split(b"\0")[0].decode("utf-8", "replace")
            else:
                values[each.name] = next(numbers)
        return values

    def _tail_bytes(self, values: Mapping[str, Any]) -> int:
        if self.tail == "doubles":
            return 8 * int(values["count"])
        return int(values["size"]) if self.tail == "bytes" else 0


def cut_text(text: str, size: int) -> bytes:
    """Return a text as UTF-8 in at most so many bytes, without half a character at its end."""
    data = text.encode("utf-8", "replace")[:size]
    return data.decode("utf-8", "ignore").encode()


def _field(name: str, code: str, text: str = "", words: tuple[str, ...] = ()) -> ContentField:
    return ContentField(name=name, code=code, text=text, words=words)


_NAME: Final = f"{NAME_BYTES}s"

SETUP: Final = FlightContent(
    name="setup",
    number=1,
    text="Who the vehicle is: first of all, and again after each hello.",
    fields=(
        _field("tick_hz", "d", "Rate of the agent's ticks, Hz."),
        _field("duration_s", "d", "Of the run, s."),
        _field("first_number", "I", "Of its first command."),
        _field("seed", "I", "For its chance."),
        _field("index", "H", "Place among the agents, from 0."),
        _field("agents", "H", "Count of agents in the run."),
        _field("settings", "H", "Count of frames of settings that follow."),
        _field("input", "B", "", INPUTS),
        _field("clock", "B", "", CLOCKS),
        _field("name", _NAME, "The agent's."),
        _field("satellite", _NAME),
        _field("epoch_utc", _NAME, "UTC of simulated time zero, ISO 8601."),
    ),
)
SETTING: Final = FlightContent(
    name="setting",
    number=2,
    text="One value of the scenario's settings.",
    fields=(
        _field("value", "d", "A number; a truth value is 0 or 1."),
        _field("index", "H", "Place in a list, from 0."),
        _field("count", "H", "Values in the list; 0 for a value by itself."),
        _field("is_text", "B", "Whether text holds it, not value."),
        _field("reserved", "3x"),
        _field("name", _NAME),
        _field("text", "48s"),
    ),
)
READING: Final = FlightContent(
    name="reading",
    number=3,
    text="One measurement; count doubles follow, in the units of the sensor.",
    fields=(
        _field("valid_s", "d", "Simulated time at which it was valid, s."),
        _field("sensor", "B", "", SENSORS),
        _field("count", "B", f"Values that follow, at most {VALUES_MAX}."),
        _field("reserved", "6x"),
    ),
    tail="doubles",
)
MESSAGE: Final = FlightContent(
    name="message",
    number=4,
    text="A message by radio; size bytes of payload follow.",
    fields=(
        _field("sent_s", "d", "Simulated time, s."),
        _field("arrives_s", "d", "Simulated time, s."),
        _field("size", "H", "Bytes of the payload."),
        _field("encoding", "B", "Of the payload; json for all that is not bytes.", ENCODINGS),
        _field("reserved", "5x"),
        _field("sender", _NAME),
    ),
    tail="bytes",
)
RESULT: Final = FlightContent(
    name="result",
    number=5,
    text="What became of a command.",
    fields=(
        _field("at_s", "d", "Simulated time at which it is, or would have been, executed, s."),
        _field("delta_v_m_s", "d", "Magnitude really given, m/s."),
        _field("propellant_kg", "d", "Left after the command, kg."),
        _field("number", "I", "Of the command: they count from first_number on."),
        _field("revision", "I", "Of the truth that holds it."),
        _field("status", "B", "", STATUSES),
        _field("reserved", "7x"),
        _field("reason", "64s"),
    ),
)
REFUSAL: Final = FlightContent(
    name="refusal",
    number=6,
    text="A message of its own that was refused.",
    fields=(
        _field("sent_s", "d", "Simulated time, s."),
        _field("number", "I", "Of the message: they count from 0 on."),
        _field("reserved", "4x"),
        _field("to", _NAME),
        _field("reason", _NAME),
    ),
)
TICK: Final = FlightContent(
    name="tick",
    number=7,
    text="End of a tick's report, to be answered by done; so many of each kind came before it.",
    fields=(
        _field("readings", "H"),
        _field("messages", "H"),
        _field("results", "H"),
        _field("refusals", "H"),
    ),
)
HELLO: Final = FlightContent(
    name="hello",
    number=128,
    text="From software that has started: counts begin anew, and setup is sent again.",
    fields=(_field("board_us", "Q", "The board's own clock, us; 0 for none."),),
)
DELTA_V: Final = FlightContent(
    name="delta_v",
    number=129,
    text="Command of a change of velocity.",
    fields=(
        _field("delta_v_m_s", "3d"),
        _field("at_s", "d", "Simulated time of execution, s."),
        _field("frame", "B", "", FRAMES),
        _field("reserved", "7x"),
    ),
)
TORQUE: Final = FlightContent(
    name="torque",
    number=130,
    text="Command of a torque about the body axes.",
    fields=(
        _field("torque_n_m", "3d"),
        _field("at_s", "d", "Simulated time of its beginning, s."),
        _field("duration_s", "d"),
    ),
)
BALLISTIC: Final = FlightContent(
    name="ballistic",
    number=131,
    text="Command of another ballistic coefficient.",
    fields=(
        _field("ballistic_m2_kg", "d"),
        _field("at_s", "d", "Simulated time of execution, s."),
    ),
)
DIPOLE: Final = FlightContent(
    name="dipole",
    number=132,
    text="Command of a magnetic dipole of the magnetorquers, in body axes.",
    fields=(
        _field("dipole_a_m2", "3d"),
        _field("at_s", "d", "Simulated time of its beginning, s."),
        _field("duration_s", "d"),
    ),
)
SEND: Final = FlightContent(
    name="send",
    number=133,
    text="A message by radio; size bytes of payload follow.",
    fields=(
        _field("size", "H", "Bytes of the payload."),
        _field("encoding", "B", "Of the payload.", ENCODINGS),
        _field("reserved", "5x"),
        _field("to", _NAME, "Agent, satellite, ground, ground:NAME, or * for all in view."),
    ),
    tail="bytes",
)
ESTIMATE: Final = FlightContent(
    name="estimate",
    number=134,
    text="One value that is believed; not a number for nothing.",
    fields=(_field("value", "d"), _field("name", _NAME, "Ends in its unit, as a_m.")),
)
LOG: Final = FlightContent(
    name="log",
    number=135,
    text="A sentence for the log; size bytes of text follow.",
    fields=(
        _field("size", "H", "Bytes of the text."),
        _field("level", "B", "", LOG_LEVELS),
        _field("reserved", "5x"),
    ),
    tail="bytes",
    tail_bytes_max=LOG_BYTES_MAX,
)
DONE: Final = FlightContent(
    name="done",
    number=136,
    text="The answer to the tick of its time is whole: what came since the last done belongs to it.",
    fields=(_field("board_us", "Q", "The board's own clock, us; 0 for none."),),
)

TO_PROGRAM: Final = (SETUP, SETTING, READING, MESSAGE, RESULT, REFUSAL, TICK)
FROM_PROGRAM: Final = (HELLO, DELTA_V, TORQUE, BALLISTIC, DIPOLE, SEND, ESTIMATE, LOG, DONE)
BY_NUMBER: Final = {each.number: each for each in (*TO_PROGRAM, *FROM_PROGRAM)}
