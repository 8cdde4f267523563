"""The shared page: newest values, whole or not at all, whoever writes and dies meanwhile."""

from __future__ import annotations

import math
import os
import signal
import time

import pytest

from madns_runtime.hardware import page
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.count_table import CELLS_MAX
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.status import StatusLimits

GYRO = Channel(name="gyro", shape=(3,))
TEMPERATURE = Channel(name="temperature")
SEEN_MAX, SEEN_MIN = 2000, 100
"""Samples to look at, and how many at least: writer and reader may have to share a processor, by turns."""


def test_nothing_was_measured_before_the_first_sample():
    reading = DevicePage((GYRO,)).read("gyro")

    assert reading.number == 0
    assert reading.taken_s == -math.inf


def test_newest_values_of_each_channel_are_read_back():
    shared = DevicePage((GYRO, TEMPERATURE))

    shared.write("gyro", 1.0, 10.0, (1.0, 2.0, 3.0))
    shared.write("temperature", 1.5, math.nan, (20.0,))
    shared.write("gyro", 2.0, 11.0, (4.0, 5.0, 6.0))

    assert shared.read("gyro") == (2, 2.0, 11.0, (4.0, 5.0, 6.0))
    assert shared.read("temperature").values == (20.0,)
    assert shared.read("temperature").number == 1


def test_frames_have_no_slot():
    shared = DevicePage((Channel(name="received", is_frame=True), TEMPERATURE))

    with pytest.raises(KeyError):
        shared.read("received")


@pytest.mark.process
def test_reader_never_sees_a_mix_of_two_samples():
    shared = DevicePage((Channel(name="vector", shape=(32,)),))
    writer = os.fork()
    if writer == 0:
        number = 0.0
        while True:
            number += 1.0
            shared.write("vector", number, number, [number] * 32)
    try:
        seen = set()
        until_s = time.monotonic() + 60.0
        while len(seen) < SEEN_MAX and time.monotonic() < until_s:
            reading = shared.read("vector")
            if reading.number:
                assert len(set(reading.values)) == 1
                assert reading.values[0] == reading.taken_s == reading.number
                seen.add(reading.number)
    finally:
        os.kill(writer, signal.SIGKILL)
        os.waitpid(writer, 0)
    assert len(seen) >= SEEN_MIN


@pytest.mark.process
def test_next_process_goes_on_with_the_number_where_a_killed_one_stopped():
    shared = DevicePage((TEMPERATURE,))
    for _ in range(2):
        pid = os.fork()
        if pid == 0:
            for value in range(5):
                shared.write("temperature", 1.0, 1.0, (float(value),))
            os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(pid, 0)

    assert shared.read("temperature").number == 10


def test_damaged_copy_leaves_what_was_seen_before():
    shared = DevicePage((TEMPERATURE,))
    shared.write("temperature", 1.0, 1.0, (20.0,))
    assert shared.read("temperature").values == (20.0,)

    slot = shared._slots["temperature"]
    slot._copies[slot._sequence[0] & 1][8] ^= 0xFF

    assert shared.read("temperature").values == (20.0,)


def test_status_follows_state_and_age():
    shared = DevicePage((TEMPERATURE,))
    limits = StatusLimits.of(0.1, hang_s=15.0)
    header = shared.header
    header[page.ACTIVE_S] = 100.0

    assert shared.status(limits, 100.5) == "never"
    assert shared.status(limits, 101.5) == "lost"  # it does not come up
    header[page.STATE], header[page.OPENED_S] = page.OPEN, 101.6
    assert shared.status(limits, 101.7) == "never"
    header[page.NEWEST_S] = header[page.ARRIVED_S] = 101.7
    assert shared.status(limits, 101.8) == "ok"
    assert shared.status(limits, 102.1) == "stale"
    assert shared.status(limits, 102.8) == "lost"
    header[page.STATE] = page.CLOSED
    assert shared.status(limits, 101.75) == "lost"


def test_simulated_time_is_told_by_whoever_knows_it():
    shared = DevicePage((TEMPERATURE,))

    assert shared.time.read() is None
    shared.time.write(1000.0, 5.0, 1.00001, 60.0)

    assert shared.time.read() == (1000.0, 5.0, 1.00001, 60.0)


@pytest.mark.process
def test_counts_and_the_reason_of_a_loss_are_seen_by_others_and_outlive_who_wrote_them():
    shared = DevicePage((GYRO,))
    pid = os.fork()
    if pid == 0:
        shared.counts.add("frozen:gyro", 0)
        shared.counts.add("refused", 2)
        shared.loss.write("the cable is loose" + "." * 1000)
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    assert shared.counts.read() == {"frozen:gyro": 0, "refused": 2}
    assert shared.counts.add("refused") == 3  # who goes on counts from there
    assert shared.loss.read() == ("the cable is loose" + "." * 1000)[:500]


def test_names_beyond_the_tables_end_are_counted_together():
    counts = DevicePage(()).counts
    for number in range(CELLS_MAX + 36):
        counts.add(f"count {number}")
    assert len(counts.read()) == CELLS_MAX
    assert sum(counts.read().values()) == CELLS_MAX + 36
    assert counts.add("x" * 99) == counts.read()["others"]
