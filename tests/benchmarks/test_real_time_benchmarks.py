"""What benchmarks of real time make of what they measure; nothing is measured here."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from madns_runtime.timing.rate import Pacer

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import scale  # noqa: E402 - behind the line that says where they are
import soak  # noqa: E402
import star  # noqa: E402
import star_transports  # noqa: E402
import stars  # noqa: E402


def test_a_shape_has_the_packs_and_the_phases_of_a_run():
    packs = stars.Shape(24, 100, 12).packs()

    assert [[size for size, _ in own] for own in packs] == [[6, 6], [6, 6]]
    assert sorted(phase_s for own in packs for _, phase_s in own) == [0.0, 0.0025, 0.005, 0.0075]
    assert {phase_s for own in stars.Shape(9, 10, 3, True).packs() for _, phase_s in own} == {0.0}


def test_shapes_are_read_as_they_are_written():
    assert star.shapes("24x100,93x200/47") == [stars.Shape(24, 100, 1), stars.Shape(93, 200, 47)]


def test_lost_and_missed_are_what_is_not_there():
    figures = stars.figures_of(10, np.array([100.0, 200.0]), np.array([1.0, 2.0, 3.0]))

    assert (figures["due"], figures["missed"], figures["lost"]) == (10, 7, 1)
    assert (figures["rtt_p50_us"], figures["late_max_us"]) == (150.0, 3.0)


class EchoAtOnce:
    """An agent process's end whose messages are back after 0.1 ms of simulated time."""

    def __init__(self, clock):
        self.clock, self.message = clock, None

    def wait(self, seconds):
        self.clock.now_s += min(seconds, 1e-4)
        return True

    def send(self, message):
        self.message = message

    def receive(self):
        message, self.message = self.message, None
        return message


@pytest.mark.parametrize("overslept_s", [0.0, 0.005, 0.015, 0.025])
def test_a_bare_star_misses_the_ticks_that_a_run_does(monkeypatch, overslept_s):
    """At 100 Hz every tenth wait lasts too long."""
    clock = SimpleNamespace(now_s=100.0, waits=0)

    def sleep(seconds):
        clock.waits += 1
        clock.now_s += seconds + 1e-6 + (0 if clock.waits % 10 else overslept_s)

    monkeypatch.setattr(stars, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: clock.now_s))
    star = stars.bare_agents(EchoAtOnce(clock), stars.Pace(101.0, 100, 200), [(1, 0.0)])
    clock.now_s, clock.waits = 0.0, 0
    pacer = Pacer(tick_hz=100.0, phase_s=0.0, duration_s=2.0, overrun_s=0.001)
    lateness_us = []
    while not pacer.is_over:
        sleep(max(0.0, pacer.next_deadline_s() - clock.now_s))
        timing = pacer.begin(clock.now_s)
        if timing is not None:
            lateness_us.append(1e6 * timing.lateness_s)
            clock.now_s += 1e-4
            pacer.end(clock.now_s)

    assert len(star["late_us"]) == pacer.run
    assert max(star["late_us"]) == pytest.approx(max(lateness_us), abs=0.01)


def test_the_median_of_pairs_is_of_each_figure_by_itself():
    pairs = [{"cosmos": {"rtt_p50_us": value, "causes": {}}} for value in (3.0, 1.0, 2.0)]

    assert star.median_of(pairs) == {"cosmos": {"rtt_p50_us": 2.0}}


def test_a_histogram_of_all_threads_has_one_percentile():
    text = "# /dev/cpu_dma_latency\n000003 000040\t000050\n000004 000009\t000000\n000090 000001\t000000\n"

    assert scale.percentile_99(text) == 4.0


@pytest.mark.parametrize(("got", "is_met"), [(1.0, True), (1.1, False), (float("nan"), False)])
def test_a_claim_is_met_up_to_its_goal_and_never_by_what_was_not_measured(got, is_met):
    assert scale.at_most("missed", got, 1.0).is_met is is_met


@pytest.mark.parametrize(
    ("values", "is_flat"),
    [([9.0, 100.0, 109.0, 100.0], True), ([9.0, 100.0, 105.0, 130.0], False)],
)
def test_what_grows_behind_the_second_window_is_not_flat(values, is_flat):
    assert soak.Figure("memory", values, 0.5).is_flat() is is_flat


def test_messages_on_a_stream_are_taken_whole():
    buffer = bytearray()
    sent = [b"one", b"", b"three"]
    taken = []
    for byte in b"".join(star_transports.LENGTH.pack(len(each)) + each for each in sent) + b"\x05":
        buffer.append(byte)
        taken += star_transports.messages_in(buffer)

    assert (taken, bytes(buffer)) == (sent, b"\x05")
