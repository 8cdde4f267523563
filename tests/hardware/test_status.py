"""Statuses by age, and what they come to over a run."""

from __future__ import annotations

import math

import pytest

from madns_runtime.config import DeviceLaunch
from madns_runtime.hardware.driven import DrivenDevice
from madns_runtime.hardware.kind_registry import prepare
from madns_runtime.hardware.status import StatusAccount, StatusLimits, back_off_s

NO_INERTIA = {"accelerometer": False, "gyroscope": False, "magnetometer": False}
SLOW = {"name": "level", "address": 1}


@pytest.mark.parametrize(
    ("period_s", "stale_s", "lost_s"),
    [(0.01, 0.1, 1.0), (0.05, 0.15, 1.0), (0.5, 1.5, 5.0)],
)
def test_limits_are_periods_but_never_shorter_than_their_least(period_s, stale_s, lost_s):
    limits = StatusLimits.of(period_s, hang_s=15.0)

    assert limits.stale_s == pytest.approx(stale_s)
    assert limits.lost_s == pytest.approx(lost_s)


def test_a_slow_device_hangs_only_after_ten_periods():
    assert StatusLimits.of(0.1, hang_s=15.0).hang_s == 15.0
    assert StatusLimits.of(10.0, hang_s=15.0).hang_s == 100.0


@pytest.mark.parametrize(
    ("age_s", "silent_s", "waited_s", "is_open", "status"),
    [
        (math.inf, math.inf, 0.5, True, "never"),
        (math.inf, math.inf, 1.5, True, "lost"),
        (0.05, 0.05, 9.0, True, "ok"),
        (0.1001, 0.1001, 9.0, True, "stale"),
        (0.999, 0.999, 9.0, True, "stale"),
        (1.001, 1.001, 9.0, True, "lost"),
        (0.0, 0.0, 9.0, False, "lost"),
        (1.001, 0.5, 9.0, True, "stale"),  # a slow read: samples arrive, and are old already
    ],
)
def test_status_by_age(age_s, silent_s, waited_s, is_open, status):
    limits = StatusLimits.of(0.01, hang_s=15.0)

    assert limits.status(age_s, silent_s=silent_s, waited_s=waited_s, is_open=is_open) == status


def test_back_off_grows_from_a_tenth_to_a_second():
    assert [back_off_s(number) for number in (0, 1, 2, 3, 4, 5, 100)] == [
        0.1,
        0.1,
        0.2,
        0.4,
        0.8,
        1.0,
        1.0,
    ]


def test_account_counts_losses_and_the_share_of_bad_time_from_simulated_time_zero_on():
    account = StatusAccount()
    account.observe("lost", 90.0)  # long before: nobody is judged by it
    account.observe("ok", 95.0)
    account.begin(100.0)

    account.observe("ok", 106.0)
    assert account.observe("stale", 108.0) == "ok"
    account.observe("stale", 109.0)
    assert account.observe("lost", 109.5) == "stale"
    account.observe("ok", 110.0)

    assert account.times_lost == 1
    assert account.stale_ratio() == pytest.approx(0.2)


def test_what_becomes_of_a_device_after_simulated_time_is_over_does_not_count():
    account = StatusAccount(end_s=110.0)
    account.observe("ok", 95.0)
    account.begin(100.0)
    account.observe("stale", 109.0)
    account.observe("lost", 112.0)
    account.observe("lost", 120.0)

    assert account.times_lost == 0
    assert account.stale_ratio() == pytest.approx(0.1)


def test_a_device_that_is_lost_when_the_run_begins_is_a_loss():
    account = StatusAccount()
    account.observe("lost", 90.0)
    account.begin(100.0)

    assert account.times_lost == 1
    assert account.stale_ratio() is None


def driven_for_8_s_from_100() -> DrivenDevice:
    """Return a device whose agent has told before that simulated time runs from 100 s on, for 8 s."""
    launch = DeviceLaunch(name="d", place="m", kind="null", base_directory="", rate_hz=10.0)
    driven = DrivenDevice.share(launch, prepare("null", {}, None))
    driven.seat.page.time.write(99.0, -1.0, 1.0, 8.0)
    return driven


def test_the_share_of_bad_time_is_of_simulated_time_alone():
    driven = driven_for_8_s_from_100()
    looks = {99.5: "never", 99.9: "never", 100.1: "ok", 107.9: "ok", 108.1: "stale", 109.5: "lost"}
    for now_s, status in looks.items():
        driven.observe(status, now_s)

    assert driven.account.seconds == pytest.approx({"never": 0, "ok": 8.0, "stale": 0, "lost": 0})
    assert (driven.account.stale_ratio(), driven.account.times_lost) == (0.0, 0)


def test_of_a_device_that_is_driven_anew_nothing_counts_before_it_is_looked_at():
    driven = driven_for_8_s_from_100()
    driven.observe("never", 103.0)
    driven.observe("ok", 104.0)

    assert driven.account.seconds["never"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("kind", "parameters", "rate_hz", "lost_s"),
    [
        ("sense_hat", {}, 20.0, 1.0),
        ("sense_hat", {**NO_INERTIA, "joystick": True}, 20.0, 10.0),
        ("i2c", {"address": 25, "map": {"registers": [{**SLOW, "period_s": 5.0}]}}, 10.0, 50.0),
        ("i2c", {"address": 25, "map": {"registers": [{**SLOW, "period_s": 0.0}]}}, 10.0, 1.0),
    ],
)
def test_a_device_of_slow_inputs_alone_is_given_their_time(kind, parameters, rate_hz, lost_s):
    launch = DeviceLaunch(name="d", place="m", kind=kind, base_directory="", rate_hz=rate_hz)
    driven = DrivenDevice.share(launch, prepare(kind, parameters, None))
    driven.close()

    assert driven.limits.lost_s == pytest.approx(lost_s)
