"""Records of one device: its channels over time, what was put out, its clock, and what befell it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from time import monotonic
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.stream_schemas import DEVICE_CLOCK, DEVICE_STATE, schema_of
from madns_runtime.recording.run_journal import RunJournal
from madns_runtime.timing.clock import utc_at_iso


class SimulatedTime:
    """Simulated time on this machine's monotonic clock, as an agent's estimate tells it now and then."""

    def __init__(self) -> None:
        self._local_s = self._t_s = math.nan
        self._rate = 1.0
        self.end_s = math.inf
        """When it ends, as far as is known, simulated, s."""

    @property
    def is_known(self) -> bool:
        """Whether simulated time has begun."""
        return not math.isnan(self._t_s)

    def set(self, local_s: float, t_s: float, rate: float) -> None:
        """Take note that simulated time *t_s* is at *local_s*, and of its seconds per local one."""
        self._local_s, self._t_s, self._rate = local_s, t_s, rate

    def at(self, local_s: float) -> float:
        """Return the simulated time at *local_s*, s; NaN before it is known."""
        return self._t_s + (local_s - self._local_s) * self._rate

    def local_s(self, t_s: float) -> float:
        """Return when simulated time *t_s* is on this machine's clock, s; NaN before that is known."""
        return self._local_s + (t_s - self._t_s) / self._rate

    def until(self, t_s: float) -> float:
        """Return how long from now on simulated time *t_s* is, s."""
        return self.local_s(t_s) - monotonic()


class DeviceRecords:
    """
    The streams of one device in a folder of its own.

    Args:
        journal: Its events and log; the other streams go beside.
        channels: The device's.

    Raises:
        MachineError: The folder takes no file.
    """

    def __init__(self, journal: RunJournal, channels: Sequence[Channel]) -> None:
        self.time = SimulatedTime()
        self.journal = journal
        self._recorder = journal.recorder
        self._newest = {
            each.name for each in channels if each.passing == "newest" and not each.is_frame
        }
        self._early: dict[str, tuple[int, float, Sequence[Any], float]] = {}
        """Of these inputs the newest values handed on before simulated time 0: agents find them in their first ticks."""
        for channel in channels:
            self._recorder.open_stream(schema_of(channel))
        self._recorder.open_stream(DEVICE_STATE)
        self._recorder.open_stream(DEVICE_CLOCK)

    def set_time(self, local_s: float, t_s: float, rate: float, end_s: float = math.inf) -> None:
        """Take note of simulated time, see `SimulatedTime.set`, and of its end."""
        if not self.time.is_known:
            self._recorder.set_t0(utc_at_iso(-t_s))
        self.time.set(local_s, t_s, rate)
        self.time.end_s = end_s

    def sample(
        self, channel: str, number: int, taken_s: float, values: Sequence[Any], *, told_s: float
    ) -> None:
        """
        Record values of an input, taken at *taken_s* and handed on at *told_s*.

        Of those handed on before simulated time 0 only the newest are, by which agents' first ticks act, and what comes through
        queues once simulated time is known.
        """
        if not self.time.is_known or (channel in self._newest and self.time.at(told_s) < 0.0):
            if channel in self._newest and all(map(math.isfinite, values)):
                self._early[channel] = (number, taken_s, values, told_s)
            return
        if channel in self._early:
            self._record_early(channel)
        self._record(channel, number, taken_s, values, told_s)

    def _record_early(self, channel: str) -> None:
        self._record(channel, *self._early.pop(channel))

    def _record(
        self, channel: str, number: int, taken_s: float, values: Sequence[Any], told_s: float
    ) -> None:
        t_s = round(self.time.at(taken_s), 6)
        age_us = round((told_s - taken_s) * 1e6)
        self._recorder.record(channel, (t_s, number, age_us, *values))

    def written(self, channel: str, due_s: float, done_s: float, values: Sequence[Any]) -> None:
        """Record values of an output, due at *due_s* and put out at *done_s*."""
        if self.time.is_known:
            t_s = round(self.time.at(due_s), 6)
            self._recorder.record(channel, (t_s, int((done_s - due_s) * 1e6), *values))

    def clock(self, now_s: float, offset_s: float, drift_ppm: float) -> None:
        """Record an estimate of the device's clock."""
        if self.time.is_known:
            values = (round(self.time.at(now_s), 6), round(offset_s * 1e6, 1), round(drift_ppm, 3))
            self._recorder.record(DEVICE_CLOCK.name, values)

    def state(
        self, now_s: float, counts: tuple[int, int], late_us_max: int, details: Mapping[str, Any]
    ) -> str:
        """Record samples and errors so far, and what the driver tells; return why not the latter, if JSON cannot carry it, else ""."""
        if not self.time.is_known:
            return ""
        numbers = (round(self.time.at(now_s), 6), *counts, late_us_max)
        try:
            self._recorder.record(DEVICE_STATE.name, (*numbers, dict(details) or None))
        except PluginError as error:
            self._recorder.record(DEVICE_STATE.name, (*numbers, None))
            return str(error)
        return ""

    def event(self, event: str, now_s: float, **values: Any) -> None:
        """Record that something befell the device; t_s is null before simulated time."""
        t_s = round(self.time.at(now_s), 6) if self.time.is_known else None
        self.journal.event(event, **{**values, "t_s": t_s})

    def close(self, timeout_s: float) -> Mapping[str, Any]:
        """Close the streams, and return the counts of their records."""
        for channel in list(self._early) if self.time.is_known else ():
            self._record_early(channel)  # no other has come since
        return self.journal.close(timeout_s).to_mapping()
