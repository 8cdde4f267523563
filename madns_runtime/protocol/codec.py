"""
Bytes and messages: the first byte is the KIND, the rest a MessagePack list of the fields in order.

Blocks of numbers travel as raw little-endian float64 in an extension type. One without a number carries
a zero byte for each further innermost list that it is written out as: few bytes never become many.
Decoding is the one place where a peer's bytes become values: whatever they are, it returns a checked
message or raises MalformedMessage, and allocates little beyond their length.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from struct import Struct
from struct import error as StructError
from typing import Any, Final, cast

import msgpack
import numpy as np

from madns_runtime.errors import MadnsError, PeerError, PluginError
from madns_runtime.protocol.messages import MESSAGES, Message, SimulationData

DEPTH_MAX: Final = 32
"""Containers inside containers."""
ITEMS_MAX: Final = 16_384
"""Items of one list or mapping; more numbers than that belong in an array."""
ARRAY_DIMENSIONS_MAX: Final = 8

_ARRAY_EXT: Final = 1
_DIMENSIONS: Final = tuple(Struct(f"<B{count}I") for count in range(ARRAY_DIMENSIONS_MAX + 1))
_FLOAT64: Final = np.dtype("<f8")
_SCALARS: Final = frozenset({type(None), bool, int, float, str, bytes})
_UNTRUSTED_BYTES: Final = 1024
_INTEGER_EXACT_MAX: Final = 2**53


class MalformedMessage(PeerError):
    """Bytes from the peer are no message: another version of the runtime, or not from it at all."""


class UnencodableValue(PluginError):
    """A value cannot travel: it has a type, size or depth that messages do not carry."""


# Messages.


def _describe(cls: type[Message]) -> tuple[type[Message], tuple[str, ...], tuple[Any, ...]]:
    """Return a message class, its fields' names and the types that they accept."""
    accepted: dict[str, Any] = {
        "str": str,
        "int": int,
        "bool": bool,
        "float": (float, int),
        "Mapping[str, Any]": dict,
        "Any": object,
    }
    fields = dataclasses.fields(cls)
    return cls, tuple(f.name for f in fields), tuple(accepted[cast("str", f.type)] for f in fields)


_BY_KIND: Final = {cls.KIND: _describe(cls) for cls in MESSAGES}
_BY_CLASS: Final = {cls: (bytes([cls.KIND]), _BY_KIND[cls.KIND][1]) for cls in MESSAGES}


def encode_message(message: Message) -> bytes:
    """
    Return a message's body.

    Raises:
        UnencodableValue: A field holds what messages do not carry.
    """
    kind, names = _BY_CLASS[type(message)]
    return kind + pack([getattr(message, name) for name in names])


def decode_message(body: bytes) -> Message:
    """
    Return the message of a body.

    Raises:
        MalformedMessage: It is none.
    """
    if not body or body[0] not in _BY_KIND:
        raise MalformedMessage(f"expected a message, got a body that starts with {body[:1]!r}")
    cls, names, accepted = _BY_KIND[body[0]]
    values = unpack(body[1:])
    if type(values) is not list or len(values) != len(names):
        raise MalformedMessage(f"{cls.__name__}: expected a list of {len(names)} fields")
    for name, value, types in zip(names, values, accepted, strict=True):
        # True is an int to Python, but not to the sender.
        if not isinstance(value, types) or (type(value) is bool and types not in (object, bool)):
            raise MalformedMessage(
                f"{cls.__name__}.{name}: a {type(value).__name__} does not belong here"
            )
    return cls(*values)


# What plug-ins send, the quick way.

_DATA_HEAD: Final = bytes([SimulationData.KIND, 0x91])
"""A SimulationData's first bytes: its kind, and a MessagePack list of one."""
NO_DATA: Final = object()
"""Return value of `decode_data` for a body that it leaves to `decode_message`."""
_UNPACKING_ERRORS: Final = (ValueError, TypeError, OverflowError, RecursionError, MemoryError)
_pack_plain: Final[Callable[[list[Any]], bytes]] = msgpack.Packer().pack
_unpack_plain: Final[Callable[[bytes], Any]] = msgpack.unpackb


def encode_data(payload: object) -> bytes:
    """
    Return the body of SimulationData(*payload*), as `encode_message` does.

    A flat list of plain values, which most ticks send, is encoded without a look at its parts one by
    one; everything else goes the general way.

    Raises:
        UnencodableValue: It holds what messages do not carry.
    """
    if (
        type(payload) is list
        and _SCALARS.issuperset(map(type, payload))
        and len(payload) <= ITEMS_MAX
    ):
        try:
            return _DATA_HEAD + _pack_plain(payload)
        except (OverflowError, ValueError):
            pass  # the general way says what is wrong
    return encode_message(SimulationData(payload))


def decode_data(body: bytes) -> object:
    """Return the payload of a SimulationData's body if it is a flat list of plain values, else NO_DATA."""
    if body[:2] == _DATA_HEAD and len(body) <= _UNTRUSTED_BYTES:
        try:
            payload = _unpack_plain(body[2:])
        except _UNPACKING_ERRORS:
            return NO_DATA  # `decode_message` says what is wrong
        if type(payload) is list and _SCALARS.issuperset(map(type, payload)):
            return payload
    return NO_DATA


# Values.


def pack(value: object) -> bytes:
    """
    Return a value as bytes.

    Args:
        value: None, bool, int of 64 bits, float, str, bytes, lists, tuples, mappings with string
            keys, and arrays of float64, in any nesting up to DEPTH_MAX. Arrays of other real types
            become float64 where that changes no value; NumPy's scalars become plain numbers.

    Raises:
        UnencodableValue: The value or a part of it is something else.
    """
    if type(value) not in _SCALARS:
        _check(value, UnencodableValue)
    try:
        return cast("bytes", msgpack.packb(value, default=_encode_other))
    except (OverflowError, ValueError, TypeError) as error:
        raise UnencodableValue(f"a message cannot carry this: {error}") from error


def _check(value: object, fault: type[MadnsError], depth: int = 0) -> None:
    """Raise *fault* where a value, or a part of it, is nested too deep, too long, or has keys that are no strings."""
    if isinstance(value, list | tuple):
        items: Any = value
    elif isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str):
                raise fault(f"a mapping's keys must be strings, got {key!r}")
        items = value.values()
    else:
        return
    if depth >= DEPTH_MAX:
        raise fault(f"values must not be nested more than {DEPTH_MAX} deep")
    if len(value) > ITEMS_MAX:
        raise fault(
            f"a list or mapping holds at most {ITEMS_MAX} items, got {len(value)}; "
            "send numbers as a float64 array"
        )
    for item in items:
        if type(item) not in _SCALARS:
            _check(item, fault, depth + 1)


def _encode_other(value: object) -> object:
    """Turn what MessagePack does not know into what it does."""
    if isinstance(value, np.ndarray):
        return _encode_array(value)
    if isinstance(value, np.integer | np.floating | np.bool_):
        return value.item()
    if isinstance(value, Mapping):
        return dict(value)
    raise UnencodableValue(
        f"a message cannot carry a {type(value).__name__}; send numbers, strings, bytes, lists, "
        "mappings with string keys or float64 arrays"
    )


def _encode_array(array: np.ndarray[Any, Any]) -> msgpack.ExtType:
    if array.ndim > ARRAY_DIMENSIONS_MAX:
        raise UnencodableValue(
            f"an array has at most {ARRAY_DIMENSIONS_MAX} dimensions, got {array.ndim}"
        )
    # Not asked of an array of numpy's own: the first such question imports numpy.ma, in the middle of a tick.
    if type(array) is not np.ndarray and isinstance(array, np.ma.MaskedArray):
        raise UnencodableValue("an array with a mask would travel without it; send its filled(nan)")
    kind, size = array.dtype.kind, array.dtype.itemsize
    if not (kind in "fiu" and size <= 8):
        raise UnencodableValue(f"arrays travel as float64, and {array.dtype} is none; convert it")
    if kind in "iu" and size == 8 and array.size:
        largest = max(abs(int(array.max())), abs(int(array.min())))
        if largest > _INTEGER_EXACT_MAX:
            raise UnencodableValue(f"{largest} in an {array.dtype} array is not exact as float64")
    try:
        shape = _DIMENSIONS[array.ndim].pack(array.ndim, *array.shape)
    except StructError as error:
        raise UnencodableValue(f"the array's shape {array.shape} is too large") from error
    numbers = array.astype(_FLOAT64).tobytes()
    if not numbers:
        numbers = bytes(_filling_bytes(array.shape, UnencodableValue))
    return msgpack.ExtType(_ARRAY_EXT, shape + numbers)


def _filling_bytes(shape: tuple[int, ...], fault: type[Exception]) -> int:
    """Return the zero bytes behind the shape of an array without a number; raise *fault* if the shape is longer than a list."""
    if math.prod(filter(None, shape)) > ITEMS_MAX:
        raise fault(f"an array of shape {shape} holds no number and is longer than {ITEMS_MAX}")
    return math.prod(shape[: shape.index(0)]) - 1


def unpack(data: bytes) -> Any:
    """
    Return the value of packed bytes: tuples come back as lists, arrays as read-only float64.

    Raises:
        MalformedMessage: The bytes are not what `pack` returns.
    """
    items_max = min(len(data), ITEMS_MAX)
    try:
        if len(data) > _UNTRUSTED_BYTES:
            _check_complete(data)
        value = msgpack.unpackb(
            data,
            ext_hook=_decode_ext,
            max_array_len=items_max,
            max_map_len=items_max,
            timestamp=1,  # as a float: no type that `pack` does not know
        )
    except _UNPACKING_ERRORS as error:
        raise MalformedMessage(f"not a packed value: {error!r}") from error
    if type(value) not in _SCALARS:
        _check(value, MalformedMessage)
    return value


def _check_complete(data: bytes) -> None:
    """
    Refuse bytes that announce more items than they hold, before anything is made of them.

    Lists are allocated at their announced length: a thousand headers inside each other would take
    100 MB. Short bodies cannot announce enough to matter.
    """
    unpacker = msgpack.Unpacker(max_buffer_size=len(data))
    unpacker.feed(data)
    try:
        unpacker.skip()
    except msgpack.OutOfData as error:
        raise ValueError("the bytes end early") from error


def _decode_ext(code: int, data: bytes) -> np.ndarray[Any, np.dtype[np.float64]]:
    if code != _ARRAY_EXT or not data or data[0] > ARRAY_DIMENSIONS_MAX:
        raise ValueError(f"unknown extension {code}")
    layout = _DIMENSIONS[data[0]]
    if len(data) < layout.size:
        raise ValueError("an array's shape is cut")
    shape = layout.unpack_from(data)[1:]
    count = math.prod(shape)
    if (count * _FLOAT64.itemsize or _filling_bytes(shape, ValueError)) != len(data) - layout.size:
        raise ValueError(f"an array of shape {shape} has {len(data) - layout.size} bytes")
    return np.frombuffer(data, _FLOAT64, count, layout.size).reshape(shape)
