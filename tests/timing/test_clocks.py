import re
from datetime import datetime, timedelta

from madns_runtime.timing.clock import utc_at_iso, utc_now_iso


def test_wall_time_is_utc_with_microseconds():
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z", utc_now_iso())


def test_wall_time_of_another_moment_lies_that_far_away():
    now, later = (datetime.fromisoformat(text) for text in (utc_at_iso(0.0), utc_at_iso(3600.0)))

    assert timedelta(hours=1) <= later - now < timedelta(hours=2)
