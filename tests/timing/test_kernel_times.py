"""Times that the kernel counts, read from files as it writes them."""

from __future__ import annotations

import math
import threading

import pytest

from madns_runtime.timing.kernel_times import (
    TICKS_PER_S,
    KernelCount,
    KernelFile,
    thread_computed_s,
)


def test_stolen_time_of_all_processors(tmp_path):
    path = tmp_path / "stat"
    path.write_text("cpu  1 2 3 4 5 6 7 250 9 10\ncpu0 1 2 3 4 5 6 7 99 9 10\n")

    assert KernelFile.of_stolen_time(path)() == 250 / TICKS_PER_S


def test_waiting_time_of_a_thread(tmp_path):
    path = tmp_path / "schedstat"
    path.write_text("123456789 2500000000 17\n")

    assert KernelFile.of_waiting(path)() == 2.5


@pytest.mark.parametrize("text", [None, "", "cpu", "1"])
def test_where_nothing_is_told(tmp_path, text):
    path = tmp_path / "file"
    if text is not None:
        path.write_text(text)

    assert KernelFile.of_stolen_time(path)() == 0.0
    assert KernelFile.of_waiting(path)() == math.inf


def test_a_file_is_read_anew_each_time_until_it_is_closed(tmp_path):
    path = tmp_path / "schedstat"
    path.write_text("1 2000000000 3\n")
    waited = KernelFile.of_waiting(path)
    before_s = waited()
    path.write_text("1 5000000000 3\n")
    after_s = waited()
    waited.close()

    assert (before_s, after_s, waited()) == (2.0, 5.0, math.inf)


def test_waiting_is_of_the_thread_that_asked_for_it():
    waited = KernelFile.of_waiting()
    read: list[float] = []
    other = threading.Thread(target=lambda: read.append(waited()))
    before_s = waited()
    other.start()
    other.join()
    after_s = waited()
    waited.close()

    assert before_s <= read[0] <= after_s


def test_own_thread_has_computed():
    assert thread_computed_s(threading.get_native_id()) > 0
    assert thread_computed_s(2**30) == 0.0


def test_growth_since_a_moment_is_that_of_the_reading_before_it():
    now, count = [0.0], [0.0]
    counted = KernelCount(lambda: count[0], 1.0, lambda: now[0])
    for at_s, value in ((0.5, 5.0), (1.0, 10.0), (2.0, 30.0), (2.5, 99.0)):
        now[0], count[0] = at_s, value
        counted.read()  # not sooner than a second after the one before

    assert counted.grown_since(1.5) == 20.0
    assert counted.grown_since(0.2) == 30.0
    assert counted.grown_since(-9.0) == 30.0
