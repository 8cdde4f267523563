"""
Timed profiles of outputs: many values handed over ahead, each put out at its own simulated time. Pure.

A profile of one output is a list of points (t_s, numbers). A newer one replaces the future of the older from a time
on, as truth does that a maneuver has changed. Points are kept by simulated time, so that better knowledge of the
clock moves all of them and none is told twice.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.values import are_finite, hold_to_limits, to_numbers

POINTS_MAX: Final = 10_000
"""Points of one output that may wait for their time; more are refused, and counted."""
POINTS_EACH_MAX: Final = 1000
"""Points of one message."""
NUMBERS_EACH_MAX: Final = 6000
"""Numbers of one message: 48 kB."""

PointCount = Literal[
    "points", "played", "late", "came_late", "skipped", "replaced", "lost", "unplayed", "refused"
]
"""Of an output's points: handed over and taken; put out, those later than the run allows among them; that came after
their time; overtaken by a later one that was due as well; replaced before their time; due while the device was closed,
or waiting in a process that ended; left when the run ended; refused (no right to move it, no room, no numbers, or by
the driver)."""
POINT_COUNTS: Final[tuple[PointCount, ...]] = (
    "points",
    "played",
    "late",
    "came_late",
    "skipped",
    "replaced",
    "lost",
    "unplayed",
    "refused",
)
UNDERRUNS: Final = "underruns"
"""How often a profile ran out: its newest point was followed by none."""
DECLINED: Final = "declined"
"""Points, taken, that the driver refused; told with those that were `refused`."""
PREFIX: Final = "play:"

Points = Iterable[tuple[float, Sequence[float]]]


def count_name(word: str, channel: str) -> str:
    """Return the name under which a device counts something of an output's points."""
    return f"{PREFIX}{word}:{channel}"


def counts_by_channel(counts: Mapping[str, int]) -> dict[str, dict[str, int]]:
    """
    Return a device's counts of points by output, zeros with them; nothing of an output that played none.

    To be asked when its last process has ended, or is about to: points of which nothing else became are lost with one.
    """
    found: dict[str, dict[str, int]] = {}
    for name, number in counts.items():
        if name.startswith(PREFIX):
            word, _, channel = name.removeprefix(PREFIX).partition(":")
            zeros = dict.fromkeys((*POINT_COUNTS, UNDERRUNS, DECLINED), 0)
            found.setdefault(channel, zeros)[word] = number
    for told in found.values():
        declined = told.pop(DECLINED)
        ends = ("played", "skipped", "replaced", "lost", "unplayed")
        told["lost"] += max(0, told["points"] - sum(told[end] for end in ends) - declined)
        told["refused"] += declined
    return found


def packs_max(channel: Channel) -> int:
    """Return how many messages POINTS_MAX points of an output take."""
    return -(-POINTS_MAX // _points_each(channel))


def _points_each(channel: Channel) -> int:
    """Return how many points of an output one message holds."""
    return max(1, min(POINTS_EACH_MAX, NUMBERS_EACH_MAX // (channel.size + 1)))


def pack_points(channel: Channel, points: Iterable[tuple[float, Any]]) -> list[array[float]]:
    """
    Return points as rows of time and numbers, in messages of a bounded size.

    Raises:
        PluginError: Times do not rise, a value is none of the channel's shape, or there are more than POINTS_MAX.
    """
    width = channel.size + 1
    each_max = _points_each(channel) * width
    packs: list[array[float]] = [array("d")]
    last_s, count = -math.inf, 0
    for t_s, value in points:
        # Plain tuples of as many floats, which most are, need no look at their shape.
        is_plain = type(value) is tuple and set(map(type, value)) == {float}
        numbers = value if is_plain and len(value) == channel.size else to_numbers(channel, value)
        if not are_finite(numbers):
            raise PluginError(f"{channel.name}: expected numbers, got {value!r:.80}")
        if not last_s < t_s < math.inf:
            raise PluginError(
                f"{channel.name}: expected points in order of time, got {t_s!r:.40} s after {last_s:g} s"
            )
        count, last_s = count + 1, t_s
        if count > POINTS_MAX:  # at once: a generator may have no end
            raise PluginError(f"{channel.name}: expected at most {POINTS_MAX} points, got more")
        if len(packs[-1]) >= each_max:
            packs.append(array("d"))
        packs[-1].append(t_s)
        packs[-1].extend(numbers)
    return packs


def unpack_points(channel: Channel, data: bytes) -> Iterator[tuple[float, tuple[float, ...]]]:
    """
    Yield the points of a message.

    Raises:
        ValueError: The bytes are none.
    """
    width = channel.size + 1
    rows = array("d")
    rows.frombytes(data)
    if len(rows) % width or not are_finite(rows):
        raise ValueError(f"{channel.name}: {len(data)} bytes are no points")
    for start in range(0, len(rows), width):
        yield rows[start], tuple(rows[start + 1 : start + width])


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfilePoint:
    """A value that is due, or what a profile that has run out leaves."""

    channel: Channel
    t_s: float
    """Simulated time at which it was due, s."""
    numbers: tuple[float, ...]
    is_underrun: bool = False
    """Whether the profile has run out: the numbers are the safe ones, none where the newest are held."""


class ChannelProfile:
    """
    The profile of one output.

    Args:
        channel: The output.
        count: Counts something of its points.
    """

    def __init__(self, channel: Channel, count: Callable[[str, int], None]) -> None:
        self._channel = channel
        self._count = count
        self._points: deque[tuple[float, tuple[float, ...]]] = deque()
        self._newest_s = -math.inf
        self._step_s = math.inf
        """Between the two newest points that were put out, or passed: the next is wanted as long after."""
        self._is_ended = False
        """Whether no further point is to be expected."""

    def __len__(self) -> int:
        return len(self._points)

    def replace(self, from_s: float, points: Points, now_s: float) -> int:
        """
        Take points, in place of all from *from_s* on; none end the profile in good order.

        Returns:
            How many numbers were beyond the channel's limits, and are held to them.
        """
        waiting, before = self._points, len(self._points)
        while waiting and waiting[-1][0] >= from_s:
            waiting.pop()
        self._count("replaced", before - len(waiting))
        last_s = waiting[-1][0] if waiting else -math.inf
        held = taken = refused = came_late = 0
        for t_s, numbers in points:
            if len(waiting) >= POINTS_MAX or t_s <= last_s:
                refused += 1
                continue
            last_s = t_s
            numbers, was_beyond = hold_to_limits(self._channel, numbers)
            waiting.append((t_s, numbers))
            taken += 1
            held += was_beyond
            came_late += t_s < now_s
        for word, number in (("points", taken), ("refused", refused), ("came_late", came_late)):
            self._count(word, number)
        self._is_ended = not taken + refused
        return held

    def pop_due(self, now_s: float) -> ProfilePoint | None:
        """Take out what is due: the earliest point, of a channel that passes the newest alone the latest; or None."""
        found: ProfilePoint | None = None
        while self._points and self._points[0][0] <= now_s:
            t_s, numbers = self._points.popleft()
            if t_s > self._newest_s:
                self._newest_s, self._step_s = t_s, t_s - self._newest_s
            self._count("skipped", int(found is not None))
            found = ProfilePoint(channel=self._channel, t_s=t_s, numbers=numbers)
            if self._channel.passing == "queue":
                break
        return found or self._run_out(now_s)

    def _run_out(self, now_s: float) -> ProfilePoint | None:
        """Return an underrun once, with the safe value where the kind wants it, if no point has come in time."""
        wanted_s = self.next_s()
        if self._points or not now_s >= wanted_s:
            return None
        self._step_s = math.inf
        self._count(UNDERRUNS, 1)
        numbers: tuple[float, ...] = ()
        if self._channel.underrun == "safe" and self._channel.safe is not None:
            safe = self._channel.safe
            numbers = safe if isinstance(safe, tuple) else (safe,) * self._channel.size
        return ProfilePoint(channel=self._channel, t_s=wanted_s, numbers=numbers, is_underrun=True)

    def next_s(self) -> float:
        """Return when something is due next, simulated, s; infinity if nothing is."""
        if self._points:
            return self._points[0][0]
        if self._is_ended or self._step_s == math.inf:
            return math.inf
        return self._newest_s + self._step_s

    def clear(self) -> int:
        """Forget all points and the time at which a next is wanted; return how many they were."""
        count = len(self._points)
        self._points.clear()
        self._step_s = math.inf
        return count
