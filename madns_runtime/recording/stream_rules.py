"""Rules for names, fields and units of record streams: what is declared, or opened, can be written, read and tabulated. Pure."""

from __future__ import annotations

import re
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.plain_values import LINE_CHARACTERS_MAX, is_line, is_whole, shown
from madns_runtime.recording.records import FIELD_KINDS, Field, StreamSchema

NAME_PATTERN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
CONTROL_KEYS: Final = ("end", "t0_utc")
COLUMNS_TAKEN: Final = ("incarnation",)
"""Names of columns that tables add to each record."""
DETAILS: Final = "details"
"""Name of the column that tables add to records that are objects: what these hold beside their fields."""
TABLES_TAKEN: Final = ("host_", "machine_")
"""Beginnings of the names of other tables than those of agents' streams."""
DIGITS_MAX: Final = 15
UNITS_HELD: Final = {
    "t_s": (("s",), "simulated time in seconds", "call a time in another unit otherwise"),
    "tick": (("", "1"), "the number of a tick, without a unit", "call anything else otherwise"),
}
"""Units of the numbers by which checks, conditions and tables know when a record is of, what these are, and what else to do."""


def check_name(name: Any) -> None:
    """
    Check that a stream or a text may be called so.

    Raises:
        PluginError: It is no file name.
    """
    if not isinstance(name, str) or not NAME_PATTERN.fullmatch(name):
        raise PluginError(
            f"stream {shown(name)}: expected a name of letters, digits, - and _, at most 64"
        )


def check_agent_name(name: str) -> None:
    """
    Check that a stream of an agent's half has a table of its own.

    Raises:
        PluginError: Its records would go into the table of a stream that others record.
    """
    if name.startswith(TABLES_TAKEN):
        raise PluginError(
            f"stream {name}: an agent's stream cannot begin with {' or '.join(TABLES_TAKEN)}, as the tables of others"
            " do; choose another name"
        )


def check_schema(schema: StreamSchema) -> None:
    """
    Check that a stream of this schema can be a file that is read back.

    Raises:
        PluginError: Its name is no file name, it has no fields, two of one name, one of no such kind, some that
            are rounded among others that are no numbers, or one that bears the name of what tables add.
    """
    check_name(schema.name)
    fields: tuple[Any, ...] = schema.fields  # of a plug-in
    for field in fields:
        if not isinstance(field, Field) or not _is_kind(field.kind):
            raise PluginError(
                f"stream {schema.name}: expected fields of kind {', '.join(FIELD_KINDS)}, got {shown(field)}"
            )
        check_field(schema.name, field)
    names = [field.name for field in schema.fields]
    if not names or len(set(names)) != len(names):
        raise PluginError(f"stream {schema.name}: expected fields with distinct names, got {names}")
    digits = [field.digits for field in schema.fields]
    is_int = [field.kind == "int" for field in schema.fields]
    is_rounded = any(places is not None for places in digits)
    if is_rounded and (
        schema.shape != "array"
        or any((places is None) != whole for places, whole in zip(digits, is_int, strict=True))
    ):
        unfit = [
            field.name
            for field, places, whole in zip(schema.fields, digits, is_int, strict=True)
            if (places is None) != whole
        ]
        raise PluginError(
            f"stream {schema.name}: expected digits, 0 to {DIGITS_MAX}, of every field of kind float, ints besides,"
            f" and records that are arrays, got {', '.join(unfit) or schema.shape}"
        )
    if schema.shape == "object" and len(names) == 1 and names[0] in CONTROL_KEYS:
        raise PluginError(f"stream {schema.name}: a single field may not be named {names[0]}")
    if schema.shape == "object" and DETAILS in names:
        raise PluginError(
            f"stream {schema.name}: records that are objects have no field {DETAILS}: tables keep in a column of that"
            " name what they hold beside their fields; choose another name"
        )


def _is_kind(kind: Any) -> bool:
    return isinstance(kind, str) and kind in FIELD_KINDS


def check_field(stream: str, field: Field) -> None:
    """
    Check that a field can stand in the schema line, and be a column of a table.

    Raises:
        PluginError: Its name or unit is no text that can be written, tables have a column of that name for
            themselves, it is a time or a tick in another unit, it has no such number of digits, or its words are no texts.
    """
    name: Any = field.name
    unit: Any = field.unit
    if not is_line(name) or not name or name in COLUMNS_TAKEN:
        raise PluginError(
            f"stream {stream}: expected a field's name to be a text of at most {LINE_CHARACTERS_MAX} printable"
            f" characters, and none of {', '.join(COLUMNS_TAKEN)}, which tables add, got {shown(name)}"
        )
    if not is_line(unit):
        raise PluginError(
            f"stream {stream}: expected the unit of {name} to be a text of at most {LINE_CHARACTERS_MAX} printable"
            f" characters, got {shown(unit)}"
        )
    units, meaning, cure = UNITS_HELD.get(name, ((unit,), "", ""))
    if field.kind in ("float", "int") and unit not in units:
        raise PluginError(f"stream {stream}: {name} is {meaning}, got unit {unit!r}; {cure}")
    places: Any = field.digits
    if places is not None and not (is_whole(places) and 0 <= places <= DIGITS_MAX):
        raise PluginError(
            f"stream {stream}: expected digits, 0 to {DIGITS_MAX}, or None of {name}, got {shown(places)}"
        )
    words: Any = field.words
    if not (isinstance(words, tuple) and all(isinstance(word, str) for word in words)):
        raise PluginError(
            f"stream {stream}: expected words of {name} to be a tuple of texts, got {shown(words)}"
        )
    if words and field.kind != "str":
        raise PluginError(
            f"stream {stream}: {name} has words, and is of kind {field.kind}, not str"
        )
