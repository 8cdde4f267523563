"""Round trips of values and messages, and bytes that are none."""

from __future__ import annotations

import dataclasses
import json
import random
import struct
import tracemalloc
from collections import OrderedDict
from types import MappingProxyType

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from madns_runtime.protocol import codec
from madns_runtime.protocol.codec import (
    MalformedMessage,
    UnencodableValue,
    decode_message,
    encode_message,
    pack,
    unpack,
)
from madns_runtime.protocol.messages import (
    MESSAGES,
    ActionOrder,
    AgentFault,
    AgentStopped,
    ConditionMet,
    Delivery,
    EmergencyShutdown,
    Expelled,
    FaultOrder,
    Hello,
    Ping,
    Pong,
    SimulationComplete,
    SimulationData,
    SimulationReady,
    SimulationSetup,
    SimulationStart,
    SystemStop,
    Transmission,
    TransmissionRefusal,
)

EXAMPLES = (
    Hello(agent="agent-01", runtime_version="0.1.0", pid=4711),
    SimulationSetup(initial={"seed": 1, "r": [1.0, 2.0]}),
    SimulationReady(),
    SimulationStart(t0_host_s=12.5),
    SimulationComplete(summary={"ticks": 100, "checks": []}),
    SystemStop(),
    AgentStopped(records={"ticks": {"records": 10, "dropped": 0}}),
    EmergencyShutdown(who="host", reason="Ctrl-C"),
    Expelled(reason="silent for 2.5 s"),
    Ping(t_agent_s=1.25, report={"missed": 0}),
    Pong(t_agent_s=1.25, t_host_received_s=2.0, t_host_sent_s=2.5),
    SimulationData(payload=[1, None, b"\x00", "text", True]),
    Transmission(to="ground:A", number=7, sent_s=1.0, payload={"x": [1, None]}),
    Delivery(sender="b", sent_s=1.0, arrives_s=1.01, payload="text"),
    TransmissionRefusal(number=7, to="*", sent_s=1.0, reason="no_radio"),
    ActionOrder(
        number=3,
        word="bias_sensor",
        parameters={"sensor": "gnss"},
        t_s=1.5,
        for_s=None,
        is_end=False,
    ),
    FaultOrder(number=3, device="pi22/imu", action="bias", value=0.5),
    ConditionMet(number=3, t_s=1.5),
    AgentFault(number=4, word="slow", begins=True, value=2.5),
)

SCALARS = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(max_size=20)
    | st.binary(max_size=50)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=5) | st.dictionaries(st.text(max_size=8), inner, max_size=5)
    ),
    max_leaves=20,
)


def test_there_is_an_example_of_every_message():
    assert set(MESSAGES) == {type(message) for message in EXAMPLES}


@pytest.mark.parametrize("message", EXAMPLES, ids=lambda m: type(m).__name__)
def test_message_survives_the_wire(message):
    body = encode_message(message)

    assert body[0] == message.KIND
    assert decode_message(body) == message


@pytest.mark.slow
@given(VALUES)
@settings(derandomize=True, deadline=None)
def test_value_survives_the_wire(value):
    decoded = unpack(pack(value))

    assert decoded == value
    assert type(decoded) is type(value)


@given(
    hnp.arrays(
        st.sampled_from([np.dtype("<f8"), np.dtype(">f8")]),
        hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
    )
)
@settings(derandomize=True, deadline=None)
def test_array_comes_back_bit_by_bit_and_read_only(array):
    decoded = unpack(pack({"block": [array]}))["block"][0]

    assert decoded.shape == array.shape
    assert decoded.dtype == np.float64
    assert decoded.tobytes() == array.astype("<f8").tobytes()
    assert not decoded.flags.writeable


@pytest.mark.parametrize("dtype", ["f2", "f4", "i1", "u2", "i4", "u4", "i8", "u8"])
def test_other_real_arrays_become_float64_without_loss(dtype):
    array = np.arange(6).reshape(2, 3).astype(dtype)

    decoded = unpack(pack(array))

    assert decoded.dtype == np.float64
    np.testing.assert_array_equal(array, decoded)


def test_array_with_a_mask_is_refused_rather_than_sent_without_it():
    with pytest.raises(UnencodableValue, match=r"filled\(nan\)"):
        pack({"x": np.ma.masked_array([1.0, 2.0], [False, True])})


def test_array_view_with_strides_survives():
    array = np.arange(24.0).reshape(4, 6)[::2, 1::2]

    np.testing.assert_array_equal(array, unpack(pack(array)))


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float64(1.5), 1.5),
        (np.float32(0.5), 0.5),
        (np.int64(-3), -3),
        (np.uint8(200), 200),
        (np.bool_(True), True),
        (np.array([], dtype="i8"), np.array([])),
    ],
)
def test_numpy_scalar_becomes_a_number(value, expected):
    np.testing.assert_array_equal(expected, unpack(pack(value)))


@pytest.mark.parametrize("mapping", [OrderedDict(a=1), MappingProxyType({"a": 1})])
def test_any_mapping_travels(mapping):
    assert unpack(pack({"v": mapping})) == {"v": {"a": 1}}


def test_tuple_comes_back_as_list():
    assert unpack(pack((1, (2, 3)))) == [1, [2, 3]]


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        (object(), "cannot carry a object"),
        ({1, 2}, "cannot carry a set"),
        ({1: "a"}, "keys must be strings"),
        ([{b"k": 0}], "keys must be strings"),
        (2**64, "cannot carry"),
        ("\ud800", "cannot carry"),
        (np.array(["a"]), "is none; convert it"),
        (np.array([1j]), "is none; convert it"),
        (np.array([True]), "is none; convert it"),
        (np.array([2**53 + 1]), "not exact"),
        (np.array([-(2**53) - 1, 0]), "not exact"),
        (np.zeros((1,) * 9), "at most 8 dimensions"),
        (np.zeros((0, 2**33)), "too large"),
        ([0] * (codec.ITEMS_MAX + 1), "float64 array"),
        (np.datetime64("2026-01-01"), "cannot carry a datetime64"),
    ],
)
def test_what_cannot_travel_is_refused_with_a_reason(value, complaint):
    with pytest.raises(UnencodableValue, match=complaint):
        pack(value)


def _nest(depth):
    value = 0
    for _ in range(depth):
        value = [value]
    return value


def test_depth_is_bounded_when_encoding_and_decoding():
    assert _nest(codec.DEPTH_MAX) == unpack(pack(_nest(codec.DEPTH_MAX)))
    with pytest.raises(UnencodableValue, match="nested"):
        pack(_nest(codec.DEPTH_MAX + 1))
    with pytest.raises(MalformedMessage, match="nested"):
        unpack(msgpack.packb(_nest(codec.DEPTH_MAX + 1)))


def test_endless_nesting_in_a_value_is_refused():
    value = []
    value.append(value)

    with pytest.raises(UnencodableValue, match="nested"):
        pack(value)


def _ext(data, code=1):
    return msgpack.packb(msgpack.ExtType(code, data))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\xc0\xc0",
        b"\xd9\x05ab",
        b"\xa1\xff",
        b"\x81\x01\x02",
        b"\x81\xc4\x01k\x02",
        b"\x81\xc0\x02",
        b"\x81\x90\x02",
        _ext(b""),
        _ext(b"\x09" + bytes(36)),
        _ext(b"\x01\x01\x00"),
        _ext(b"\x01\x02\x00\x00\x00" + bytes(8)),
        _ext(b"\x02" + b"\xff" * 8),
        _ext(b"\x08" + b"\xff\xff\xff\xff" * 7 + bytes(4)),
        _ext(b"\x00" + bytes(8), code=2),
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 5000,
        b"\xdc\x3f\xff" * 1000 + bytes(2000),
        bytes(5000),
    ],
    ids=lambda data: data[:6].hex(),
)
def test_hostile_value_is_malformed(data):
    with pytest.raises(MalformedMessage):
        unpack(data)


@pytest.mark.parametrize("shape", [(2**32 - 1, 0), (10**6, 1, 0), (0, 200, 200)], ids=str)
def test_an_array_of_nothing_is_no_longer_than_a_list(shape):
    data = _ext(struct.pack(f"<B{len(shape)}I", len(shape), *shape))

    with pytest.raises(MalformedMessage, match="holds no number"):
        unpack(data)
    with pytest.raises(UnencodableValue, match="holds no number"):
        pack(np.empty(shape))


@pytest.mark.parametrize("shape", [(0,), (0, 3), (0, 16_384), (16_384, 0), (2, 3, 0, 4)], ids=str)
def test_an_array_of_nothing_keeps_its_shape_and_what_it_is_written_out_as_costs_bytes(shape):
    data = pack(np.empty(shape))

    value = unpack(data)
    assert (value.shape, value.dtype) == (shape, np.float64)
    assert len(json.dumps(value.tolist())) <= 6 * len(data)


def test_many_lists_in_a_short_array_of_nothing_are_malformed():
    with pytest.raises(MalformedMessage, match="has 0 bytes"):
        unpack(_ext(struct.pack("<B2I", 2, 1000, 0)))


def test_a_point_in_time_is_no_type_of_its_own():
    assert unpack(msgpack.packb(msgpack.Timestamp(1, 0))) == 1.0


@pytest.mark.parametrize(
    "data",
    [
        b"\xdc\x3f\xff" * 1000 + bytes(20_000),
        b"\xdc\x03\xff" * 333,
        b"\xdd\x00\x00\x3f\xff" * 5000,
        _ext(b"\x08" + b"\xff\xff\xff\xff" * 8),
    ],
    ids=["lists", "short", "long", "array"],
)
def test_hostile_value_cannot_allocate_much(data):
    tracemalloc.start()
    try:
        with pytest.raises(MalformedMessage):
            unpack(data)
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert peak_bytes < 4_000_000


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\x00\x90",
        b"\xff\x90",
        b"\x03\x91\x00",
        b"\x03\x80",
        b"\x03\x00",
        b"\x04\x90",
        b"\x04\x91\xa11",
        b"\x04\x91\xc3",
        b"\x04\x91\xc0",
        bytes([Hello.KIND]) + msgpack.packb(["a", "b", 1.5]),
        bytes([Hello.KIND]) + msgpack.packb(["a", "b", True]),
        bytes([Hello.KIND]) + msgpack.packb(["a", b"b", 1]),
        bytes([Ping.KIND]) + msgpack.packb([0.0, []]),
        bytes([Ping.KIND]) + msgpack.packb([0.0, {1: 2}]),
        bytes([Ping.KIND]) + msgpack.packb([0.0, {}, 0]),
    ],
    ids=lambda body: body[:12].hex(),
)
def test_hostile_message_is_malformed(body):
    with pytest.raises(MalformedMessage):
        decode_message(body)


def test_opaque_field_takes_a_bool():
    assert SimulationData(payload=True) == decode_message(
        encode_message(SimulationData(payload=True))
    )


@given(st.binary(max_size=200))
@settings(derandomize=True, deadline=None, max_examples=500)
def test_any_bytes_decode_or_are_malformed(body):
    for kind in (b"", bytes([SimulationData.KIND]), bytes([Ping.KIND])):
        try:
            message = decode_message(kind + body)
        except MalformedMessage:
            continue
        assert dataclasses.is_dataclass(message)


def test_changed_messages_decode_or_are_malformed():
    chance = random.Random(2)
    bodies = [encode_message(m) for m in EXAMPLES]
    bodies.append(encode_message(SimulationData(payload={"r": np.ones((3, 2)), "x": [1] * 20})))
    outcomes = {True: 0, False: 0}

    for _ in range(5000):
        body = bytearray(chance.choice(bodies))
        for _ in range(chance.randrange(1, 4)):
            body[chance.randrange(len(body))] = chance.randrange(256)
        del body[len(body) - chance.choice((0, 0, 1, 5)) :]
        try:
            decode_message(bytes(body))
            outcomes[True] += 1
        except MalformedMessage:
            outcomes[False] += 1

    assert min(outcomes.values()) > 500
