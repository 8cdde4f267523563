"""Protocol `frames`: its two sides, Python's and that of flight_frames.h, speak the same, and no bytes break them."""

import math
import random
import shutil
import struct
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madns_runtime.hardware.framing import cobs_decode, cobs_encode
from madns_runtime.simulations.constellation.equipment import Sensors
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.flight.interface import c_header, content, frames
from madns_runtime.simulations.constellation.flight.interface.answers import CommandRequest
from madns_runtime.simulations.constellation.flight.interface.dialogue import Dialogue
from madns_runtime.simulations.constellation.flight.interface.frames import Frames
from madns_runtime.simulations.constellation.flight.interface.json_lines import JsonLines
from madns_runtime.simulations.constellation.flight.interface.reports import SetupReport, TickReport
from madns_runtime.simulations.constellation.flight.interface.space_packets import SpacePackets
from madns_runtime.simulations.constellation.messages import (
    CommandResult,
    Delivery,
    TransmissionRefusal,
)

FLIGHT = Path(__file__).parents[2] / "scenarios/flight"
SETUP = SetupReport(
    name="agent-01",
    satellite="SAT-1",
    agents=("agent-01",),
    index=0,
    tick_hz=10.0,
    rate_hz=10.0,
    duration_s=60.0,
    epoch_utc="2026-01-01T00:00:00Z",
    frame="TEME",
    input="measurements",
    first_number=0,
    seed=7,
    settings={"a_m": 7e6, "name": "x" * 60, "gains": [1.0, 2.0], "is_on": True},
)
FULL = TickReport(
    t_s=0.1,
    readings={"gnss": Reading(0.1, (7e6, 0.0, 0.0, 0.0, 7500.0, 0.0))},
    messages=(
        Delivery(sender="agent-02", sent_s=0.0, arrives_s=0.05, payload=b"\0\1\2"),
        Delivery(sender="agent-02", sent_s=0.0, arrives_s=0.05, payload={"x": [1, b"\0"]}),
    ),
    results=(CommandResult(number=0, status="refused", at_s=1.0, revision=0, reason="no fuel"),),
    refusals=(TransmissionRefusal(number=1, to="*", sent_s=0.0, reason="no_line_of_sight"),),
)


def body(one, values, tail=b"", *, order="<"):
    return one.pack(order, values, tail)


def frame(number, t_s, data, *, sequence=0, version=1, size=None, crc=None):
    """Return a frame as flight software sends it; or one with a fault."""
    size = len(data) if size is None else size
    whole = frames.HEADER.pack(number, version, sequence, size, 0, t_s) + data
    crc = zlib.crc32(whole) if crc is None else crc
    return cobs_encode(whole + struct.pack("<I", crc)) + b"\0"


def answer(t_s, first=0, *contents):
    said = [*contents, (content.DONE, {"board_us": 5})]
    return b"".join(
        frame(one.number, t_s, body(one, *rest), sequence=first + number)
        for number, (one, *rest) in enumerate(said)
    )


DELTA_V = (content.DELTA_V, {"delta_v_m_s": (0.0, 0.1, 0.0), "at_s": 3.0, "frame": 1})


def test_the_header_is_what_the_table_says():
    assert (FLIGHT / "flight_frames.h").read_text() == c_header.header_text()


def test_every_field_lies_on_a_multiple_of_its_size():
    for one in content.BY_NUMBER.values():
        place = 0
        for each in one.fields:
            unit = struct.calcsize(f"<{each.code[-1]}")
            assert place % unit == 0, (one.name, each.name)
            place += struct.calcsize(f"<{each.code}")
        assert place == one.size and place % 8 == 0 or "d" not in str(one.fields), one.name


def test_every_sensor_has_a_number():
    assert set(Sensors.__dataclass_fields__) <= set(content.SENSORS)


def test_an_answer_is_whole_with_its_done():
    protocol = Frames()
    data = answer(0.1, 0, DELTA_V, (content.ESTIMATE, {"value": float("nan"), "name": "a_m"}))

    assert protocol.feed(data[:-1]) == []
    (got,) = protocol.feed(data[-1:])

    assert got.t_s == 0.1 and got.board_us == 5 and got.estimate == {"a_m": None}
    assert got.commands == (
        CommandRequest(kind="delta_v", value=(0.0, 0.1, 0.0), at_s=3.0, frame="rtn"),
    )
    assert not any(protocol.faults.values())


def test_an_estimate_whose_packet_was_lost_is_none_and_ends_nothing():
    protocol = Frames()
    a, b = ((content.ESTIMATE, {"value": 1.0, "name": name}) for name in ("a_m", "b_m"))
    protocol.feed(answer(0.1, 0, a, b))

    (got,) = protocol.feed(answer(0.2, 4, b))
    (silent,) = protocol.feed(answer(0.3, 6))

    assert got.estimate == {"a_m": None, "b_m": 1.0}
    assert list(got.estimate) == ["a_m", "b_m"]
    assert silent.estimate is None
    assert protocol.faults["lost"] == 1


def test_every_kind_of_request_is_read():
    vector = (1.0, 2.0, 3.0)
    asked = (
        (content.TORQUE, {"torque_n_m": vector, "at_s": 1.0, "duration_s": 2.0}),
        (content.DIPOLE, {"dipole_a_m2": vector, "at_s": 1.0, "duration_s": 2.0}),
        (content.BALLISTIC, {"ballistic_m2_kg": 0.01, "at_s": 1.0}),
        (content.SEND, {"size": 2, "encoding": 0, "to": "*"}, b"\0x"),
        (content.SEND, {"size": 7, "encoding": 1, "to": "ground"}, b'{"x":1}'),
        (content.LOG, {"size": 2, "level": 3}, b"hi"),
    )

    (got,) = Frames().feed(answer(0.1, 0, *asked))

    assert [one.kind for one in got.commands] == ["torque", "dipole", "ballistic"]
    assert got.commands[1].duration_s == 2.0 and got.commands[2].value == 0.01
    assert got.sends == (("*", b"\0x"), ("ground", {"x": 1}))
    assert got.logs == (("info", "hi"),)


@pytest.mark.parametrize(
    ("data", "counts"),
    [
        (frame(136, 0.1, bytes(8))[3:], {"corrupt": 1}),
        (cobs_encode(b"short") + b"\0", {"cut": 1}),
        (frame(136, 0.1, bytes(8), crc=1), {"corrupt": 1}),
        (frame(136, 0.1, bytes(8), size=9), {"wrong_length": 1}),
        (frame(136, 0.1, bytes(9)), {"wrong_length": 1}),
        (frame(99, 0.1, bytes(8)), {"unknown": 1}),
        (frame(7, 0.1, bytes(8)), {"unknown": 1}),
        (frame(136, 0.1, bytes(8), version=2), {"unknown": 1}),
        (b"\1" * 20_000 + b"\0", {"overlong": 1}),
        (answer(0.1) + answer(0.1), {"duplicate": 1}),  # to the last bit
        (answer(0.1) + answer(0.2, 5), {"lost": 4}),
        (answer(0.1, 40_000) + answer(0.2, 0), {"lost": 25_535}),
        (answer(0.1, 10_000) + answer(0.2, 0), {"restarts": 1}),
        (frame(129, 0.1, body(*DELTA_V)) + answer(0.2, 1), {"other_time": 1}),
    ],
)
def test_what_is_damaged_is_counted_by_its_kind(data, counts):
    protocol = Frames()

    protocol.feed(data)
    (last,) = protocol.feed(frame(128, 0.0, bytes(8)) + answer(7.0, 1))

    assert last.t_s == 7.0
    assert {name: count for name, count in protocol.faults.items() if count} == counts


def test_hello_brings_the_setup_again_and_its_numbers_anew():
    protocol = Frames()
    protocol.setup(SETUP)
    protocol.feed(answer(0.1, 20))

    protocol.feed(frame(128, 0.0, bytes(8), sequence=0) + answer(0.2, 1))

    again = [cobs_decode(packet[:-1])[0] for packet in protocol.tick(FULL)]
    assert again == [1, 2, 2, 2, 2, 2, 3, 4, 4, 5, 6, 7]
    assert not any(protocol.faults.values())
    assert len(protocol.tick(FULL)) == 6


def test_seeded_noise_is_counted_and_raises_nothing():
    chance = random.Random(11)
    protocol = Frames()
    whole = [answer(0.1 * n, 3 * n, DELTA_V, DELTA_V) for n in range(40)]
    for _ in range(300):
        data = bytearray(chance.choice(whole))
        for _ in range(chance.randrange(4)):
            place = chance.randrange(len(data))
            action = chance.randrange(3)
            if action == 0:
                data[place] = chance.randrange(256)
            elif action == 1:
                del data[place : place + chance.randrange(20)]
                data = data or bytearray(b"\0")
            else:
                data[place:place] = chance.randbytes(chance.randrange(20))
        for answered in protocol.feed(bytes(data)):
            assert answered.t_s == answered.t_s
    protocol.feed(chance.randbytes(100_000))

    assert protocol.faults["corrupt"] > 50


@pytest.mark.process
def test_the_header_in_c_reads_and_writes_what_python_does(tmp_path):
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    program = tmp_path / "hold"
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off"]
    subprocess.run(["cc", *flags, "-o", program, FLIGHT / "hold_frames.c", "-lm"], check=True)
    vehicle = Frames()
    told = [*vehicle.setup(SETUP), b"\2\2\0", b"\5\1\0", b"\1" * 3000 + b"\0"]
    told += [packet for _ in range(3) for packet in vehicle.tick(FULL)]
    told.insert(-1, told[-2])  # twice: that is no loss
    lost = vehicle.tick(FULL)
    told += lost[2:]

    done = subprocess.run([program], input=b"".join(told), capture_output=True, check=True)

    answers = vehicle.feed(done.stdout)
    assert [one.t_s for one in answers] == [0.1] * 4
    assert answers[0].board_us > 0
    a_m = 1.0 / (2.0 / 7e6 - 7500.0**2 / 398600441500000.0)
    assert answers[0].estimate == {"a_m": a_m, "a_error_m": a_m - 7e6}
    assert answers[0].commands[0].at_s == 0.1 + 3.0
    assert answers[1].commands == () and answers[3].estimate is None
    assert done.stderr == b"29 frames, 2 damaged, 1 overlong, 2 lost\n"
    assert not any(vehicle.faults.values())


@pytest.mark.process
def test_the_detumbling_computer_commands_nothing_before_it_is_set_up():
    """One that has started anew hears ticks before its setup, and knows none of its settings."""
    if shutil.which("cc") is None:
        pytest.skip("no C compiler")
    vehicle = Frames()
    setup = vehicle.setup(SETUP)
    unheard = [packet for number in range(60) for packet in vehicle.tick(turning(0.1 * number))]
    heard = [packet for number in range(60, 120) for packet in vehicle.tick(turning(0.1 * number))]

    done = subprocess.run(
        [FLIGHT.parent / "firmware/detumble/detumble.sh"],
        input=b"".join([*unheard, *setup, *heard]),
        capture_output=True,
        check=True,
    )

    answers = vehicle.feed(done.stdout)
    assert len(answers) == 120
    commanded = [one.t_s for one in answers if one.commands]
    assert len(commanded) >= 10 and min(commanded) > 6.0


def turning(t_s):
    """Return the tick of a body that turns 8 deg/s across the field."""
    field_t = (3e-5 * math.cos(0.14 * t_s), 3e-5 * math.sin(0.14 * t_s), 0.0)
    readings = {"gyro": Reading(t_s, (0.0, 0.0, -0.14)), "magnetometer": Reading(t_s, field_t)}
    return TickReport(t_s=t_s, readings=readings)


@pytest.mark.parametrize(("is_kept", "setups"), [(True, [0, 1, 1]), (False, [1, 1, 1])])
def test_first_hello_of_software_that_finds_the_setup_asks_for_nothing(is_kept, setups):
    """So no record shows whether the program began before the first tick or behind it."""
    protocol = Frames()
    protocol.setup(replace(SETUP, is_kept=is_kept))

    again = []
    for sequence in range(len(setups)):
        protocol.feed(frame(128, 0.0, bytes(8), sequence=sequence))
        kinds = [cobs_decode(packet[:-1])[0] for packet in protocol.tick(FULL)]
        again.append(kinds.count(1))

    assert again == setups


@pytest.mark.parametrize("make", [Frames, SpacePackets])
@pytest.mark.parametrize("count", range(10_905, 10_925))
def test_a_message_too_long_as_json_is_counted_whatever_else_is_in_its_packet(make, count):
    protocol = make()
    message = Delivery(sender="a", sent_s=0.0, arrives_s=0.1, payload=[False] * count)

    packets = protocol.tick(TickReport(t_s=0.1, messages=[message]))

    assert len(packets) + protocol.faults["overflow"] == 2


@pytest.mark.parametrize("make", [JsonLines, Frames, SpacePackets])
def test_an_array_without_axes_in_a_message_is_its_number(make):
    payload = {"x": np.array(1.5), "y": np.array([2.5])}
    message = Delivery(sender="a", sent_s=0.0, arrives_s=0.1, payload=payload)

    packets = make().tick(TickReport(t_s=0.1, messages=[message]))

    assert b'{"x":1.5,"y":[2.5]}' in b"".join(packets)


def test_numbers_of_long_runs_are_counted_in_32_bits_from_the_first_one_on():
    first = 2**33 + 5
    result = replace(FULL.results[0], number=first + 1)
    dialogue = Dialogue()

    setup, *_ = dialogue.setup(replace(SETUP, first_number=first))
    (told,) = (
        said
        for said in dialogue.tick(replace(FULL, results=(result,)))
        if said.content is content.RESULT
    )

    assert (setup.values["first_number"], told.values["number"]) == (5, 6)
