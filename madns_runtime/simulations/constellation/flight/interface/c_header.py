"""
Writes flight_frames.h, the C side of protocol `frames`, from the table of contents.

    python -m madns_runtime.simulations.constellation.flight.interface.c_header > flight_frames.h
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from importlib import resources

from madns_runtime.simulations.constellation.flight.interface import content
from madns_runtime.simulations.constellation.flight.interface.content import (
    ContentField,
    FlightContent,
)
from madns_runtime.simulations.constellation.flight.interface.frames import VERSION

TEMPLATE = "data/flight_frames.h.in"
TYPES = {"d": "double", "Q": "uint64_t", "I": "uint32_t", "H": "uint16_t", "B": "uint8_t"}
WORDS = (
    ("INPUT", content.INPUTS),
    ("CLOCK", content.CLOCKS),
    ("FRAME", content.FRAMES),
    ("STATUS", content.STATUSES),
    ("LEVEL", content.LOG_LEVELS),
    ("ENCODING", content.ENCODINGS),
    ("SENSOR", content.SENSORS),
)


def header_text() -> str:
    """Return the file's text."""
    template = resources.files(__package__).joinpath(TEMPLATE).read_text("utf-8")
    return template.replace("@VERSION@", str(VERSION)).replace("@TABLE@", "\n".join(_table()))


def _table() -> Iterator[str]:
    yield "enum flight_type {"
    yield from _listed(
        [f"FLIGHT_{one.name.upper()} = {one.number}" for one in content.BY_NUMBER.values()]
    )
    yield "};"
    for prefix, words in WORDS:
        yield f"enum flight_{prefix.lower()} {{"
        yield from _listed(
            [f"FLIGHT_{prefix}_{word.upper()} = {number}" for number, word in enumerate(words)]
        )
        yield "};"
    for one in content.BY_NUMBER.values():
        yield ""
        yield from _struct(one)


def _listed(items: Sequence[str]) -> Iterator[str]:
    for item in items[:-1]:
        yield f"    {item},"
    yield f"    {items[-1]}"


def _struct(one: FlightContent) -> Iterator[str]:
    tails = {"": "", "bytes": " [size bytes follow]", "doubles": " [count doubles follow]"}
    yield f"/* {one.text}{tails[one.tail]} */"
    yield "typedef struct {"
    for each in one.fields:
        text = each.text or (f"enum flight_{_enum_of(each)}" if each.words else "")
        yield f"    {_declared(each)};" + (f" /* {text} */" if text else "")
    yield f"}} flight_{one.name};"
    size = f"sizeof(flight_{one.name}) == {one.size}"
    yield f"FLIGHT_HOLDS({one.name}, {size});"


def _enum_of(each: ContentField) -> str:
    return next(prefix.lower() for prefix, words in WORDS if words == each.words)


def _declared(each: ContentField) -> str:
    count, code = each.code[:-1], each.code[-1]
    if code == "s":
        return f"char {each.name}[{count}]"
    if code == "x":
        return f"uint8_t {each.name}[{count}]"
    return f"{TYPES[code]} {each.name}" + (f"[{count}]" if count else "")


if __name__ == "__main__":
    sys.stdout.write(header_text())
