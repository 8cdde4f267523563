"""Faults inserted around a device."""

from __future__ import annotations

import math

import pytest

from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware.contract import Sample
from madns_runtime.hardware.faults import InsertedFaults


def sample(value: float, taken_s: float = 0.0) -> Sample:
    return Sample(values={"gyro": [value, 2.0 * value], "text": b"frame"}, taken_s=taken_s)


def test_without_faults_a_sample_is_itself():
    given = sample(1.0)

    assert InsertedFaults(1).apply(given) is given


def test_freeze_repeats_what_was_newest_until_it_is_cleared():
    faults = InsertedFaults(1)
    faults.apply(sample(1.0))

    faults.insert("freeze")
    assert faults.apply(sample(5.0)).values["gyro"] == [1.0, 2.0]
    assert faults.apply(sample(6.0)).values["gyro"] == [1.0, 2.0]
    faults.insert("clear")

    assert faults.apply(sample(7.0)).values["gyro"] == [7.0, 14.0]


def test_freeze_before_the_first_sample_holds_that():
    faults = InsertedFaults(1)
    faults.insert("freeze")

    assert faults.apply(sample(3.0)).values["gyro"] == [3.0, 6.0]
    assert faults.apply(sample(4.0)).values["gyro"] == [3.0, 6.0]


def test_bias_is_added_to_numbers_and_not_to_frames():
    faults = InsertedFaults(1)
    faults.insert("bias", 0.5)

    altered = faults.apply(sample(1.0))

    assert altered.values == {"gyro": [1.5, 2.5], "text": b"frame"}


def test_noise_is_the_same_under_a_seed():
    def values(seed: int) -> list[float]:
        faults = InsertedFaults(seed)
        faults.insert("noise", 0.1)
        return [faults.apply(sample(0.0)).values["gyro"][0] for _ in range(1000)]

    assert values(1) == values(1)
    assert values(1) != values(2)
    spread = math.sqrt(sum(value**2 for value in values(1)) / 1000)
    assert spread == pytest.approx(0.1, rel=0.1)


def test_drop_loses_its_share_and_counts_it():
    faults = InsertedFaults(3)
    faults.insert("drop", 0.25)

    kept = sum(faults.apply(sample(1.0)) is not None for _ in range(4000))

    assert kept + faults.dropped == 4000
    assert faults.dropped == pytest.approx(1000, rel=0.1)


def test_delay_holds_samples_until_their_time_in_order():
    faults = InsertedFaults(1)
    faults.insert("delay", 0.5)

    assert faults.apply(sample(1.0, 10.0)) is None
    assert faults.apply(sample(2.0, 10.1)) is None
    assert faults.next_due_s() == 10.5
    assert faults.due(10.4) == []
    assert [each.taken_s for each in faults.due(10.7)] == [10.0, 10.1]
    assert faults.next_due_s() == math.inf


def test_delay_holds_samples_until_the_sum_of_both_times_as_they_are_written():
    """0.1 + 0.2 is more than 0.3 in binary numbers: in lockstep they would wait for the tick after."""
    faults = InsertedFaults(1)
    faults.insert("delay", 0.2)
    faults.apply(sample(1.0, 0.1))

    assert faults.next_due_s() == 0.3
    assert [each.taken_s for each in faults.due(0.3)] == [0.1]


def test_disconnect_lasts_until_clear():
    faults = InsertedFaults(1)
    faults.insert("disconnect")
    assert faults.is_disconnected
    faults.insert("clear")
    assert not faults.is_disconnected


def test_a_device_that_is_disconnected_hands_on_nothing_that_a_delay_holds_until_clear():
    faults = InsertedFaults(1)
    faults.insert("delay", 0.5)
    assert faults.apply(sample(1.0, 10.0)) is None
    assert faults.apply(sample(2.0, 10.1)) is None

    faults.insert("disconnect")
    assert (faults.next_due_s(), faults.due(20.0)) == (math.inf, [])
    faults.insert("clear")

    assert [each.taken_s for each in faults.due(20.0)] == [10.0, 10.1]
    assert faults.forget_held() == 0


@pytest.mark.parametrize(
    ("action", "value", "text"),
    [
        ("melt", None, "expected an action of freeze, bias"),
        ("bias", None, "bias needs a value"),
        ("freeze", 1.0, "freeze takes no value, got 1"),
        ("drop", 1.5, "the share of samples that is lost"),
        ("noise", -1.0, "standard deviation"),
        ("delay", math.nan, "the time by which samples come late"),
    ],
)
def test_a_fault_that_is_none_is_refused_with_what_was_expected(action, value, text):
    with pytest.raises(ConfigurationError, match=text):
        InsertedFaults(1).insert(action, value)
