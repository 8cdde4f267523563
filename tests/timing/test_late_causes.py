"""One cause per late tick: the first, in the order of precedence, that filled half of the time; else what filled most."""

from __future__ import annotations

import pytest

from madns_runtime.timing.late_causes import CAUSES, Cause, name_cause, overlap_s


@pytest.mark.parametrize(
    ("filled_s", "cause"),
    [
        ({}, Cause.UNEXPLAINED),
        ({Cause.STEP: 0.49}, Cause.UNEXPLAINED),
        ({Cause.STEP: 0.5}, Cause.STEP),
        ({Cause.WAKE_UP: 0.6, Cause.STEP: 0.9}, Cause.WAKE_UP),
        ({Cause.WAKE_UP: 0.9, Cause.STOLEN: 0.5}, Cause.STOLEN),
        ({Cause.RECEIVING: 0.3, Cause.OTHER_AGENT: 0.25}, Cause.RECEIVING),
        ({Cause.RECEIVING: 0.2, Cause.HOUSEKEEPING: 0.2}, Cause.UNEXPLAINED),
        ({Cause.START: 1.0, Cause.STOLEN: 1.0}, Cause.START),
    ],
)
def test_cause_of_a_window_of_one_second(filled_s, cause):
    assert name_cause(1.0, filled_s) is cause


def test_causes_that_overlap_are_judged_by_what_they_fill_together():
    filled_s = {Cause.GARBAGE: 0.3, Cause.STEP: 0.4}

    assert name_cause(1.0, filled_s, together_s=0.4) is Cause.UNEXPLAINED
    assert name_cause(1.0, filled_s, together_s=0.6) is Cause.STEP


def test_a_window_without_length_has_no_cause():
    assert name_cause(0.0, {Cause.STEP: 1.0}) is Cause.UNEXPLAINED


def test_what_is_unexplained_comes_last():
    assert CAUSES[-1] is Cause.UNEXPLAINED
    assert len(set(CAUSES)) == len(CAUSES)


@pytest.mark.parametrize(
    ("begin_s", "end_s", "overlap"),
    [(0, 1, 0), (0, 2.5, 0.5), (2.25, 2.5, 0.25), (2.5, 9, 0.5), (3, 4, 0), (0, 9, 1)],
)
def test_overlap_with_the_window_from_2_to_3_s(begin_s, end_s, overlap):
    assert overlap_s(begin_s, end_s, (2.0, 3.0)) == pytest.approx(overlap)
