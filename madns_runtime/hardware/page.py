"""
The newest samples of one device, in memory that its process and the agents' share.

One process writes, any number read, and nobody waits. Each channel has a slot of two copies behind a sequence
number: the writer fills the copy that the number does not point to, then raises the number. A reader that finds
the number unchanged after copying had its copy to itself; a checksum stands in for the order of stores, which a
weakly ordered processor does not promise. A writer that dies in the middle leaves the older copy valid.
"""

from __future__ import annotations

import math
import mmap
import zlib
from collections.abc import Sequence
from struct import Struct
from typing import Final, NamedTuple

from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.count_table import TABLE_BYTES, CountTable
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.hardware.text_slot import SLOT_BYTES, TextSlot
from madns_runtime.plugin.device_view import DeviceStatus

TRIES_MAX: Final = 16
"""A reader that is overtaken so often uses what it has: only a stopped writer and a stopped reader meet so."""
NEVER: Final = -math.inf
ALIGNMENT: Final = 64
"""Bytes of a cache line: slots share none."""

OPENING, CLOSED, OPEN, SAFE = 0.0, 1.0, 2.0, 3.0
"""States of a device: being opened for the first time, not open, open, and left with its outputs made safe."""
STATE, OPENED_S, ACTIVE_S, SAMPLES, ERRORS, PID, SAFE_COUNT = range(7)
NEWEST_S, ARRIVED_S, MOVED, LOSSES, ATTEMPTED, LEAST_AGE_S = range(7, 13)
"""Places in the header, all float64: state, when it was opened and last active (monotonic, s), samples and errors
so far, process id, how often its outputs were made safe, when its newest sample was taken and when one last arrived,
1 if outputs have moved since they were last made safe, how often the device was lost, 1 while the guardian makes
outputs safe that have moved: nobody knows yet, and how old the youngest of all samples was when it came, s."""
HEADER_BYTES: Final = 128
TIME_NUMBERS: Final = 4


class SlotReading(NamedTuple):
    """The newest value of a channel, as it lies in the page."""

    number: int
    """How many samples the channel has had; 0 before the first."""
    taken_s: float
    """On this machine's monotonic clock; -infinity before the first."""
    device_s: float
    """On the device's clock; not a number if it has none."""
    values: tuple[float, ...]


class DevicePage:
    """
    Shared memory of one device; made before the processes that share it are forked.

    Args:
        channels: The device's, in the order of their slots; of frames only their number is here.
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._slots: dict[str, _Slot] = {}
        places: list[tuple[Channel, int]] = []
        time_start = HEADER_BYTES + SLOT_BYTES + TABLE_BYTES
        size = time_start + _Slot.size(TIME_NUMBERS)
        for channel in channels:
            places.append((channel, size))
            size += ALIGNMENT if channel.is_frame else _Slot.size(channel.size)
        self._memory = mmap.mmap(-1, max(size, mmap.PAGESIZE))
        view = memoryview(self._memory)
        self.header = view[:HEADER_BYTES].cast("d")
        """float64 numbers at the places named above; one process writes them."""
        self.header[NEWEST_S] = self.header[ARRIVED_S] = NEVER
        self.header[LEAST_AGE_S] = math.inf
        self.loss = TextSlot(view[HEADER_BYTES : HEADER_BYTES + SLOT_BYTES])
        """Why it was lost the last time; the manager writes it."""
        self.counts = CountTable(view[HEADER_BYTES + SLOT_BYTES : time_start])
        """Counts of its process; they outlive it."""
        self.time = TimeSlot(view, time_start)
        self._frames: dict[str, memoryview[int]] = {}
        for channel, start in places:
            if channel.is_frame:
                self._frames[channel.name] = view[start : start + 8].cast("Q")
            else:
                self._slots[channel.name] = _Slot(view, start, channel.size)

    def write(self, channel: str, taken_s: float, device_s: float, values: Sequence[float]) -> int:
        """Make *values* the newest of a channel, and return their number; for the device's process alone."""
        return self._slots[channel].write(taken_s, device_s, values)

    def count_frame(self, channel: str) -> int:
        """Return the number of a channel's next frame, counted on from an earlier process's; for the device's process alone."""
        number = self._frames[channel]
        number[0] += 1
        return number[0]

    def read(self, channel: str) -> SlotReading:
        """Return the newest values of a channel; takes a few microseconds and never waits."""
        return self._slots[channel].read()

    def status(self, limits: StatusLimits, now_s: float) -> DeviceStatus:
        """Return the device's status at *now_s* on this machine's monotonic clock."""
        header = self.header
        state = header[STATE]
        return limits.status(
            now_s - header[NEWEST_S],
            silent_s=now_s - header[ARRIVED_S],
            waited_s=now_s - header[ACTIVE_S if state == OPENING else OPENED_S],
            is_open=state in (OPENING, OPEN),
        )


class _Slot:
    """Two copies of one channel's newest values, and the number that says which is valid."""

    def __init__(self, view: memoryview, start: int, count: int) -> None:
        self._body = Struct(f"=Qdd{count}d")
        self._size = self._body.size + 4
        self._sequence = view[start : start + 8].cast("Q")
        first = start + 8
        self._copies = (
            view[first : first + self._size],
            view[first + self._size : first + 2 * self._size],
        )
        self._number = 0
        self._nothing = SlotReading(0, NEVER, math.nan, (math.nan,) * count)
        self._seen = self._nothing

    @staticmethod
    def size(count: int) -> int:
        """Return the bytes of a slot of *count* numbers, up to the next cache line."""
        used = 8 + 2 * (Struct(f"=Qdd{count}d").size + 4)
        return -(-used // ALIGNMENT) * ALIGNMENT

    def write(self, taken_s: float, device_s: float, values: Sequence[float]) -> int:
        sequence = self._sequence[0] + 1
        number = self._last_number() + 1
        body = self._body.pack(number, taken_s, device_s, *values)
        copy = self._copies[sequence & 1]
        copy[:-4] = body
        copy[-4:] = zlib.crc32(body).to_bytes(4, "little")
        self._sequence[0] = sequence
        self._number = number
        return number

    def read(self) -> SlotReading:
        for _ in range(TRIES_MAX):
            sequence = self._sequence[0]
            if not sequence:
                return self._nothing
            copy = bytes(self._copies[sequence & 1])
            body = copy[:-4]
            if self._sequence[0] == sequence and zlib.crc32(body) == int.from_bytes(
                copy[-4:], "little"
            ):
                number, taken_s, device_s, *values = self._body.unpack(body)
                self._seen = SlotReading(number, taken_s, device_s, tuple(values))
                break
        return self._seen

    def _last_number(self) -> int:
        """Return the number of the newest values, which may be an earlier process's."""
        return self._number or self.read().number


class TimeSlot:
    """
    Simulated time on this machine's clock, as the agents that use a device estimate it: (local_s, t_s, rate, end_s).

    Simulated time *t_s* is at *local_s*, runs at *rate* simulated seconds per local one, and ends at *end_s*. Whichever agent writes,
    they agree within the uncertainty of their clocks; a mix of two does not pass the checksum.
    """

    def __init__(self, view: memoryview, start: int) -> None:
        self._slot = _Slot(view, start, TIME_NUMBERS)

    def write(self, local_s: float, t_s: float, rate: float, end_s: float) -> None:
        """Take note of the time."""
        self._slot.write(local_s, math.nan, (local_s, t_s, rate, end_s))

    def read(self) -> tuple[float, float, float, float] | None:
        """Return the newest note; None before simulated time runs."""
        number, _, _, (local_s, t_s, rate, end_s) = self._slot.read()
        return (local_s, t_s, rate, end_s) if number else None
