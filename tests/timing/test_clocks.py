import re
from datetime import datetime, timedelta

import pytest

from madns_runtime.timing.clock import ManualClock, utc_at_iso, utc_now_iso


def test_manual_clock_moves_only_when_told():
    clock = ManualClock(5.0)

    assert clock.now_s() == clock.now_s() == 5.0
    assert clock.advance(0.25) == 5.25
    assert clock.now_s() == 5.25


def test_manual_clock_refuses_to_go_back():
    clock = ManualClock(1.0)

    with pytest.raises(ValueError, match=r"go back by 0\.5 s"):
        clock.advance(-0.5)
    assert clock.now_s() == 1.0


def test_wall_time_is_utc_with_microseconds():
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z", utc_now_iso())


def test_wall_time_of_another_moment_lies_that_far_away():
    now, later = (datetime.fromisoformat(text) for text in (utc_at_iso(0.0), utc_at_iso(3600.0)))

    assert timedelta(hours=1) <= later - now < timedelta(hours=2)
