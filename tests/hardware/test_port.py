"""A device as its agent sees it: what finds no room is counted and told."""

import json
import math
import socket

import pytest

from madns_runtime.config import Recording
from madns_runtime.errors import PluginError
from madns_runtime.hardware import messages, page, port
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.count_table import missed_name
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.port import DevicePort, Hardware
from madns_runtime.hardware.profiles import POINTS_MAX, unpack_points
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.protocol.codec import pack
from madns_runtime.realtime.process_records import ProcessRecords
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.run_journal import RunJournal

CHANNELS = (
    Channel(name="received", is_frame=True),
    Channel(name="sent", is_frame=True, direction="out", passing="queue"),
    Channel(name="level", direction="out"),
)
WRITES_MAX = 100_000
"""More than any socket holds."""


@pytest.fixture
def device(monkeypatch):
    monkeypatch.setattr(port, "FRAMES_MAX", 2)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    made = DevicePort(
        "pi22/line",
        CHANNELS,
        shared=(DevicePage([CHANNELS[0]]), ours),
        limits=StatusLimits.of(0.1, 1.0),
        now_s=lambda: 0.0,
        agent="agent-01",
    )
    with ours, theirs:
        yield made, theirs


def test_frames_that_nobody_takes_are_counted(device):
    made, theirs = device
    for number in range(5):
        assert messages.send(theirs, [messages.FRAME, "received", number, 0.0, b"x"])

    assert [each.number for each in made.frames("received")] == [3, 4]
    assert made.losses() == {"frames_dropped": 3}


def test_frames_that_did_not_even_come_are_told_by_the_agent_that_did_not_take_them(device):
    made, _ = device
    counts = made._page.counts
    counts.add(missed_name("agent-01"), 7)
    counts.add(missed_name("agent-02"), 5)

    assert made.losses() == {"frames_missed": 7}


def test_what_a_device_has_no_room_for_is_counted(device):
    made, _ = device
    for _ in range(WRITES_MAX):
        made.write("sent", b"x" * 1000)
        if made.writes_lost:
            break
    for number in range(port.PACKS_MAX + 3):
        made.play("level", [(float(number), 1.0), (number + 0.5, 2.0)], from_s=float(number))

    made.write("level", 3.0)

    left = {"writes_left": 1, "points_left": 2 * port.PACKS_MAX}
    assert made.losses() == {"writes_lost": 1, "points_lost": 6, **left}
    assert Hardware({"line": made}).losses() == {"pi22/line": made.losses()}


def test_as_many_points_as_may_wait_find_room_however_wide_their_output_is():
    picture = Channel(name="picture", direction="out", shape=(64, 3))
    ours, theirs = messages.make_pair()
    shared, limits = (DevicePage([]), ours), StatusLimits.of(0.1, 1.0)
    made = DevicePort("pi22/hat", (picture,), shared=shared, limits=limits)
    times = []
    with ours, theirs:
        made.play("picture", ((float(k), (1.0,) * 192) for k in range(POINTS_MAX)))
        while packs := list(messages.receive_all(theirs)):
            for *_, data in packs:
                times += [t_s for t_s, _ in unpack_points(picture, data)]
            made.flush()

    assert times == [float(k) for k in range(POINTS_MAX)]
    assert made.losses() == {}


def test_an_older_value_that_found_no_room_does_not_come_behind_a_newer_one(device, monkeypatch):
    made, _ = device
    sent = []
    # There is some between the look for the old one and the new one.
    room = iter([False, False, True, True])

    def send(end, message):
        has_room = next(room)
        if has_room:
            sent.append(message[2])
        return has_room

    monkeypatch.setattr(messages, "send", send)
    made.write("level", 1.0)
    made.write("level", 2.0)
    made.flush()

    assert sent == [2.0]


def fill(made):
    """Hand over frames until there is no room for the smallest value."""
    size = 1000
    while size:
        lost = made.writes_lost
        made.write("sent", b"x" * size)
        size = size if made.writes_lost == lost else size // 2


def what_comes_of(made, theirs, channel):
    """Return the words of what was handed over for a channel, in the order in which it comes once there is room."""
    words = []
    theirs.setblocking(False)
    while True:
        came = list(messages.receive_all(theirs))
        words += [word for word, name, *_ in came if name == channel]
        if not came:
            return words
        made.flush()


def test_a_value_and_a_profile_of_an_output_that_found_no_room_come_in_their_order(device):
    made, theirs = device
    fill(made)
    made.write("level", 1.0)
    made.play("level", [(5.0, 2.0), (6.0, 3.0)])

    assert what_comes_of(made, theirs, "level") == [messages.WRITE, messages.PLAY]
    assert set(made.losses()) == {"writes_lost"}  # of what filled the socket


def test_a_value_that_ends_a_profile_does_not_overtake_it(device, monkeypatch):
    made, _ = device
    sent = []
    # There is some between the look for the points and the value.
    room = iter([False, False, True, True])

    def send(end, message):
        has_room = next(room, True)
        if has_room:
            sent.append(message[0])
        return has_room

    monkeypatch.setattr(messages, "send", send)
    made.play("level", [(5.0, 2.0)])
    made.write("level", 1.0)
    made.flush()

    assert sent == [messages.PLAY, messages.WRITE]


def test_a_value_that_waits_before_points_is_counted_as_one(device, monkeypatch):
    made, _ = device
    monkeypatch.setattr(messages, "send", lambda end, message: False)
    made.write("level", 1.0)
    made.play("level", [(5.0, 2.0), (6.0, 3.0)])
    made.write("level", 4.0)

    assert made.losses() == {"writes_left": 2, "points_left": 2}
    for number in range(port.PACKS_MAX):
        made.play("level", [(7.0 + number, 5.0)])
    left = {"points_left": port.PACKS_MAX}
    assert made.losses() == {"writes_lost": 2, "points_lost": 2, **left}


@pytest.mark.parametrize("due_s", [math.nan, math.inf, -math.inf])
def test_a_write_at_no_time_is_refused_and_holds_up_no_other(device, due_s):
    made, theirs = device
    with pytest.raises(PluginError, match="line.level: due_s: expected a simulated time, s, got "):
        made.write("level", 1.0, due_s=due_s)
    with pytest.raises(PluginError, match="none before from_s"):
        made.play("level", (), from_s=math.nan)
    made.write("level", 2.0, due_s=3.0)
    theirs.setblocking(False)

    assert list(messages.receive_all(theirs)) == [[messages.WRITE, "level", 2.0, 3.0]]


def test_a_device_with_room_for_all_tells_nothing(device):
    made, _ = device
    made.write("sent", b"x")

    assert Hardware({"line": made}).losses() == {}


def test_losses_are_an_event_and_a_warning_of_the_agent(tmp_path):
    recorder = Recorder(RecordFiles(tmp_path, run="r", source="agent-01"), Recording())
    journal = RunJournal(recorder, 5, t_s=lambda: 1.0)
    records = ProcessRecords(journal, 5.0)
    recorder.start()

    records.device_losses({"pi22/line": {"writes_lost": 7}})
    journal.close()

    (told,) = [line for line in lines_of(tmp_path / "events.jsonl") if "device_losses" in str(line)]
    assert (told["device"], told["writes_lost"]) == ("pi22/line", 7)
    assert "device pi22/line: there was no room for all: writes_lost 7" in str(
        lines_of(tmp_path / "log.jsonl")
    )


def lines_of(path):
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_the_newest_answers_that_fit_a_datagram_are_told_and_none_of_a_timelines_orders(device):
    made, theirs = device
    made._page.header[page.LOSSES] = 1
    made._page.loss.write("\u20ac" * 150)
    for number in (1, 2, 3, 4, 5, 6, 1_000_001):
        made.order_fault(number, "bias", 1.0)
        assert messages.send(theirs, [messages.ANSWER, number, "" if number == 6 else "x" * 190])

    told = Hardware({"line": made}).report()

    assert told["fault_answers"] == [(6, ""), (5, "x" * 190), (4, "x" * 190)]
    assert told["lost_device"] == ("pi22/line", "\u20ac" * 66)
    assert len(pack(told)) < 750


def test_of_several_lost_devices_each_is_told_in_turn(device):
    made, _ = device
    made._page.header[page.LOSSES] = 1
    made._page.loss.write("gone")
    other = DevicePort(
        "pi22/imu",
        CHANNELS,
        shared=(made._page, made._end),
        limits=StatusLimits.of(0.1, 1.0),
        now_s=lambda: 0.0,
    )
    both = Hardware({"line": made, "imu": other})

    told = {both.report()["lost_device"] for _ in range(2)}

    assert told == {("pi22/line", "gone"), ("pi22/imu", "gone")}
