"""The way of a sample: through inserted faults into the page, to the agents' queues, into the records."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from madns_runtime.errors import PluginError
from madns_runtime.hardware import messages, page
from madns_runtime.hardware.clock import DeviceClock
from madns_runtime.hardware.contract import Channel, Device, Sample
from madns_runtime.hardware.count_table import BEYOND_LIMITS, MISSED, NOT_FINITE
from madns_runtime.hardware.fault_actions import check_fault_fits
from madns_runtime.hardware.faults import InsertedFaults
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.profiles import PREFIX, counts_by_channel
from madns_runtime.hardware.records import DeviceRecords
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.hardware.values import are_finite, hold_to_limits, to_frame, to_numbers
from madns_runtime.plain_values import is_real

FROZEN: Final = "frozen:"
"""Before an input's name: how often it stood still."""
AGE_S_MAX: Final = 1e9
"""Of a sample: 30 years, which no machine has been running for."""
EVENTS_MAX: Final = 1000
"""Of one kind of event, such as refused values; more are counted alone."""


class Intake:
    """
    Takes what a device measures.

    Args:
        channels: The device's.
        device_page: Its page.
        records: Its records.
        seed: Of inserted faults.
        frozen_s: By input: one that has not changed for so long, or not come, is frozen.
        pass_on: Sends a message to all agents that use it, and returns how many had no room.
        handed_s: Of the time at which a sample was taken up, returns when agents have it: asked right after
            it was handed over, for which a busy machine may take its time. In lockstep no time passes.
    """

    def __init__(  # noqa: PLR0913 - the collaborators of a seam, most keyword-only
        self,
        channels: Sequence[Channel],
        device_page: DevicePage,
        records: DeviceRecords,
        *,
        seed: Sequence[int],
        frozen_s: Mapping[str, float],
        pass_on: Callable[[list[Any]], int],
        handed_s: Callable[[float], float] = float,
    ) -> None:
        self._inputs = {each.name: each for each in channels if each.direction == "in"}
        self._page = device_page
        self._records = records
        self._pass_on = pass_on
        self._handed_s = handed_s
        self.faults = InsertedFaults(seed)
        self.clock = DeviceClock()
        self._changes = {name: _LastChange(limit_s) for name, limit_s in frozen_s.items()}
        for name in frozen_s:
            self.count(f"{FROZEN}{name}", 0)
        self.withheld_s = -math.inf
        """When an inserted fault kept a sample back: the device is not silent."""
        self._dropped = 0
        """Samples that inserted faults have dropped, as far as they are counted."""

    def serve(self, device: Device) -> None:
        """Let a device that is about to be opened count, and see the faults that are in force."""
        device.count = self.count
        self.faults.show_to(device)

    def insert_fault(self, action: str, value: float | None) -> None:
        """
        Put a fault in force, or clear all; see `InsertedFaults`.

        Raises:
            ConfigurationError: There is no such fault, its value is none, or it would alter nothing.
        """
        check_fault_fits(action, self._inputs.values())
        self.faults.insert(action, value)

    def take(self, sample: Sample, now_s: float, *, ahead_s: float = 0.0) -> None:
        """
        Hand on what a driver read.

        Args:
            sample: What it read.
            now_s: The present, on this machine's monotonic clock, s.
            ahead_s: How far a sample may lie in the future, s.

        Raises:
            PluginError: It is no sample of this device's inputs.
        """
        sample = checked_sample(sample, self._inputs, now_s, ahead_s=ahead_s)
        self._page.header[page.ACTIVE_S] = now_s
        if not sample.values and self._inputs:
            # Nothing new, as None says it: only a device of outputs alone shows so that it is there.
            self.count("empty_samples")
            return
        header = self._page.header
        header[page.LEAST_AGE_S] = min(header[page.LEAST_AGE_S], now_s - sample.taken_s)
        if sample.device_s is not None:
            self.clock.add(sample.device_s, sample.taken_s)
        altered = self.faults.apply(sample)
        if self.faults.dropped != self._dropped:
            self.count("dropped", self.faults.dropped - self._dropped)
            self._dropped = self.faults.dropped
        self.tell_held(now_s)  # what waits no longer, as its delay was lifted, came before it
        if altered is None:
            self.withheld_s = now_s
        else:
            self._tell(altered, now_s)
        self._page.header[page.SAMPLES] += 1

    def tell_held(self, now_s: float) -> None:
        """Hand on the samples that an inserted fault has delayed until now."""
        for sample in self.faults.due(now_s):
            self._tell(sample, now_s)

    def close(self) -> None:
        """Count the samples that an inserted fault still delays: they reach nobody."""
        self.count("delayed_left", self.faults.forget_held())

    def count(self, name: str, number: int = 1) -> None:
        """Count something by name, in memory that outlives this process."""
        if number or name.startswith(FROZEN):
            self._page.counts.add(name, number)

    def event(self, event: str, now_s: float, **values: Any) -> None:
        """Record that something befell the device, if there was not very much of its kind."""
        if self._page.counts.add(f"{event}_events") <= EVENTS_MAX:
            self._records.event(event, now_s, **values)

    def summary(self) -> dict[str, Any]:
        """Return the counts of a run, those of earlier processes with them."""
        return counts_of(self._page)

    def _tell(self, sample: Sample, now_s: float) -> None:
        """Make a sample that was checked the newest, pass on its frames, record it."""
        device_s = math.nan if sample.device_s is None else sample.device_s
        is_told = not sample.values
        value: Any
        for name, value in sample.values.items():
            channel = self._inputs[name]
            if channel.is_frame:
                self._tell_frame(channel, value, sample.taken_s, now_s)
                is_told = True
                continue
            numbers = tuple(value)
            if not are_finite(numbers):
                # On record, where the check records.not_finite finds it, and in nobody's hands.
                self.count(f"{name}{NOT_FINITE}")
                last = self._page.read(name).number
                self._records.sample(name, last, sample.taken_s, numbers, told_s=now_s)
                continue
            is_told = True
            if channel.limits is not None and hold_to_limits(channel, numbers)[1]:
                self.count(f"{name}{BEYOND_LIMITS}")
            number = self._page.write(name, sample.taken_s, device_s, numbers)
            if channel.passing == "queue":
                self._send([messages.FRAME, name, number, sample.taken_s, list(numbers)])
            told_s = self._handed_s(now_s)
            self._records.sample(name, number, sample.taken_s, numbers, told_s=told_s)
            self._note_change(name, numbers, now_s)
        if not is_told:
            return
        if self._changes:
            self._look_for_frozen(now_s)
        header = self._page.header
        header[page.NEWEST_S] = max(header[page.NEWEST_S], sample.taken_s)
        header[page.ARRIVED_S] = now_s

    def _tell_frame(self, channel: Channel, data: bytes, taken_s: float, now_s: float) -> None:
        number = self._page.count_frame(channel.name)
        told = (len(data), data.hex())
        self._send([messages.FRAME, channel.name, number, taken_s, data])
        self._records.sample(channel.name, number, taken_s, told, told_s=self._handed_s(now_s))
        self._note_change(channel.name, (data,), now_s)

    def _note_change(self, name: str, values: tuple[Any, ...], now_s: float) -> None:
        if (change := self._changes.get(name)) is not None:
            change.note(values, now_s)

    def _look_for_frozen(self, now_s: float) -> None:
        """
        Count and record the inputs that have not changed for too long, though the device gave something right now.

        One that ceases to come has not changed either, nor has one that never came. Time counts from the device's opening
        on, and within simulated time: before it a recording gives nothing. A device that is silent altogether is stale, or lost.
        """
        time = self._records.time
        if not 0.0 <= time.at(now_s) <= time.end_s:
            return
        begun_s = max(self._page.header[page.OPENED_S], time.local_s(0.0))
        for name, change in self._changes.items():
            if change.is_frozen(now_s, begun_s):
                self.count(f"{FROZEN}{name}")
                self.event("frozen", now_s, channel=name, for_s=change.limit_s)

    def _send(self, message: list[Any]) -> None:
        self.count("frames_missed", self._pass_on(message))


def checked_sample(
    sample: object, inputs: Mapping[str, Channel], now_s: float, *, ahead_s: float = 0.0
) -> Sample:
    """
    Return a sample with values of its own, as numbers and bytes: a driver may fill its buffers again while a fault holds it.

    Args:
        sample: What a driver gave.
        inputs: The device's inputs by their names.
        now_s: The present, on this machine's monotonic clock, s.
        ahead_s: How far it may lie in the future, s.

    Raises:
        PluginError: It is no sample of these inputs.
    """
    if not isinstance(sample, Sample):
        raise PluginError(f"expected a Sample or None, got {type(sample).__name__}")
    _check_times(sample, now_s + ahead_s, now_s)
    given: Any = sample.values
    if not isinstance(given, Mapping):
        raise PluginError(f"expected values by channel in a Sample, got {given!r:.80}")
    values: dict[str, Any] = {}
    for name, value in given.items():
        channel = inputs.get(name)
        if channel is None:
            raise PluginError(f"a sample holds {name!r}, which is no input of the device")
        values[name] = to_frame(channel, value) if channel.is_frame else to_numbers(channel, value)
    return dataclasses.replace(sample, values=values)


def _check_times(sample: Sample, latest_s: float, now_s: float) -> None:
    """
    Refuse a sample whose times are none, still to come, or so long ago that its age has no room on record.

    Raises:
        PluginError: They are.
    """
    taken_s: Any = sample.taken_s
    if not is_real(taken_s) or not now_s - AGE_S_MAX <= taken_s <= latest_s:
        raise PluginError(
            f"taken_s: expected a time until now, {now_s:.6f} s of time.monotonic() (in lockstep simulated), and at most"
            f" {AGE_S_MAX:g} s before it, got {taken_s!r:.80}"
        )
    device_s: Any = sample.device_s
    if device_s is not None and not is_real(device_s):
        raise PluginError(
            f"device_s: expected a time of the device's own clock, s, or None; got {device_s!r:.80}"
        )


def counts_of(device_page: DevicePage) -> dict[str, Any]:
    """Return what a device's processes have counted so far, from its page."""
    counts, header = device_page.counts.read(), device_page.header
    frozen = {name.removeprefix(FROZEN): n for name, n in counts.items() if name.startswith(FROZEN)}
    stimulus = counts_by_channel(counts)
    return {
        "samples": int(header[page.SAMPLES]),
        "errors": int(header[page.ERRORS]),
        "dropped": 0,
        "frozen": frozen,
        **{name: n for name, n in counts.items() if not name.startswith((FROZEN, PREFIX, MISSED))},
        **({"stimulus": stimulus} if stimulus else {}),
    }


def promised_inputs(channels: Iterable[Channel]) -> list[str]:
    """Return the inputs of numbers; queues are left out, for nothing may have happened."""
    return [
        each.name
        for each in channels
        if each.direction == "in" and not each.is_frame and each.passing == "newest"
    ]


def silent_inputs(channels: Iterable[Channel], device_page: DevicePage) -> list[str]:
    """Return the promised inputs of which no value ever came."""
    return [name for name in promised_inputs(channels) if not device_page.read(name).number]


def least_stale_age_s(device_page: DevicePage, limits: StatusLimits) -> float | None:
    """Return how old the youngest of all samples was when it came, s; None if there was none, or it was not stale by then."""
    age_s = device_page.header[page.LEAST_AGE_S]
    return age_s if limits.stale_s < age_s < math.inf else None


class _LastChange:
    """When an input last changed: one that never does although it should is frozen."""

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._values: tuple[Any, ...] | None = None
        self._since_s = -math.inf
        self._is_told = False

    def note(self, values: tuple[Any, ...], now_s: float) -> None:
        """Take note of values that came."""
        if values != self._values:
            self._values, self._since_s, self._is_told = values, now_s, False

    def is_frozen(self, now_s: float, begun_s: float) -> bool:
        """Return whether there is now, and was not before, no change for too long; time before *begun_s* does not count."""
        if self._is_told or now_s - max(self._since_s, begun_s) < self.limit_s:
            return False
        self._is_told = True
        return True
