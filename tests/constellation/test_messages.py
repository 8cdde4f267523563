"""What the halves say to each other: every message survives its mapping, and what is none is named by its field."""

import numpy as np
import pytest

from madns_runtime.errors import PluginError
from madns_runtime.protocol.codec import pack, unpack
from madns_runtime.simulations.constellation.messages import (
    Command,
    CommandResult,
    Initial,
    Segment,
)
from madns_runtime.simulations.constellation.thrust import Thrust

ARC = Segment(
    revision=2,
    t0_s=4.5,
    knot_s=0.5,
    states=np.arange(18.0).reshape(3, 6),
    attitude=np.ones((3, 7)),
    thrust=Thrust(start_s=4.0, acceleration_m_s2=(0.1, 0.0, -0.2), burnt_1_s=1e-4),
    ballistic_m2_kg=0.01,
)
COMMAND = Command(
    number=4,
    kind="torque",
    commanded_s=1.0,
    at_s=2,
    frame="body",
    vector=(0.0, 1.0, 0.0),
    duration_s=3.0,
    phase_s=0.02,
)
MESSAGES = [
    COMMAND,
    CommandResult(number=4, status="refused", at_s=2.0, revision=1, reason="no"),
]


def travelled(message):
    return type(message).from_message(unpack(pack(message.to_message())))


def same(first, second):
    """Whether segments are equal: arrays have no truth of their own."""
    return pack(first.to_message()) == pack(second.to_message())


@pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.KIND)
def test_a_message_survives_its_way(message):
    assert travelled(message) == message


def test_segments_survive_with_attitude_and_thrust_and_inside_of_initial_data():
    bare = Segment(revision=0, t0_s=0.0, knot_s=1.0, states=np.zeros((2, 6)))
    whole = Initial(satellite="X", frame="TEME", epoch_utc="2017", segment=bare, more=(ARC, bare))
    empty = Initial(satellite="X", frame="TEME", epoch_utc="2017", segment=None)

    assert travelled(ARC).thrust == ARC.thrust
    assert same(travelled(ARC), ARC)
    assert same(travelled(whole).more[0], ARC)
    assert (travelled(empty).segment, travelled(empty).more) == (None, ())


@pytest.mark.parametrize(
    ("message", "wrong", "named"),
    [
        (COMMAND, {"command": "explode"}, "command: expected kind: CommandKind, got 'explode'"),
        (COMMAND, {"frame": "moon"}, "command: expected frame"),
        (COMMAND, {"vector": [1.0]}, "command: expected vector: Vector, got .1.0."),
        (COMMAND, {"vector": [1.0, 2.0, "3"]}, "command: expected vector"),
        (COMMAND, {"number": 1.5}, "command: expected number: int, got 1.5"),
        (COMMAND, {"number": True}, "command: expected number"),
        (COMMAND, {"at_s": None}, "command: expected at_s: float, got None"),
        (ARC, {"states": [1.0] * 6}, "segment: expected states"),
        (ARC, {"thrust": [1.0]}, "segment: expected thrust"),
        (MESSAGES[1], {"status": "done"}, "command_result: expected status"),
        (COMMAND, {"frame": 3}, "command: expected frame: CommandFrame, got 3"),
    ],
    ids=lambda value: str(value)[:20],
)
def test_a_field_that_is_not_what_it_should_be_is_named(message, wrong, named):
    mapping = message.to_message()

    with pytest.raises(PluginError, match=named):
        type(message).from_message(mapping | wrong)
    (key,) = wrong
    del mapping[key]
    with pytest.raises(PluginError, match="got None"):
        type(message).from_message(mapping)


@pytest.mark.parametrize(
    "wrong",
    [
        {"states": np.full((3, 6), np.nan)},
        {"states": np.zeros((1, 6)), "attitude": None},
        {"states": np.zeros((3, 5))},
        {"states": np.zeros(18)},
        {"attitude": np.ones((2, 7))},
        {"attitude": np.full((3, 7), np.inf)},
        {"knot_s": 0.0},
        {"t0_s": float("nan")},
    ],
    ids=str,
)
def test_a_segment_that_nobody_could_fly_along_is_refused(wrong):
    with pytest.raises(PluginError, match="expected a segment of 2 to"):
        Segment.from_message(ARC.to_message() | wrong)
