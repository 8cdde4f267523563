"""Ticks of a bare loop: which of them are missed, with a simulated clock."""

import socket
from types import SimpleNamespace

import pytest

from cosmos_cli.onboard import timing_floor

PERIOD_S = 0.01


@pytest.mark.parametrize(
    ("overslept_periods", "missed", "late_us"),
    [(0.0, 0, 0.0), (0.5, 0, 5000.0), (1.5, 1, 5000.0), (2.5, 2, 5000.0), (50.0, 10, 0.0)],
)
def test_a_tick_later_than_its_period_is_missed_and_the_newest_due_one_runs(
    monkeypatch, overslept_periods, missed, late_us
):
    """Of 20 ticks the eleventh is waited for too long."""
    clock = SimpleNamespace(now_s=0.0, waits=0)

    def wait(deadline_s, **_):
        clock.waits += 1
        overslept_s = overslept_periods * PERIOD_S if clock.waits == 11 else 0.0
        clock.now_s = max(clock.now_s, deadline_s + overslept_s)

    monkeypatch.setattr(timing_floor, "time", SimpleNamespace(monotonic=lambda: clock.now_s))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:  # connected to nobody
        loop = timing_floor._Loop(client, timing_floor._PlainCodec())
        monkeypatch.setattr(loop, "_wait", wait)
        told = loop.run(20, PERIOD_S)

    assert (told["due"], told["missed"], told["sent"]) == (20, missed, 20 - missed)
    assert told["lateness_us"]["max"] == pytest.approx(late_us, abs=0.01)
