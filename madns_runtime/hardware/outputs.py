"""
Outputs of a device: what agents hand over, refused or kept until it is due. Pure: times go in.

Writes are due on the clock of whoever drives the device, points of profiles at simulated times.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import PluginError
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.pending import PendingWrites
from madns_runtime.hardware.profiles import (
    DECLINED,
    ChannelProfile,
    ProfilePoint,
    count_name,
    counts_by_channel,
    unpack_points,
)
from madns_runtime.hardware.values import from_numbers, to_output
from madns_runtime.timing.rate import LatenessHistogram


@dataclass(frozen=True, slots=True, kw_only=True)
class DueOutput:
    """One value that is due."""

    channel: Channel
    value: Any
    """Value that the driver is given."""
    due_s: float
    """On the clock of whoever drives the device, s."""
    point: ProfilePoint | None = None
    """Of a profile; None for a write."""

    @property
    def told(self) -> Sequence[Any]:
        """Its values as they are recorded."""
        if self.channel.is_frame:
            return len(self.value), self.value.hex()
        return self.value if self.channel.shape else (self.value,)


class DeviceOutputs:
    """
    The outputs of one device.

    Args:
        launch: Names who may move them, and from when on a point is late.
        channels: The device's.
        count: Counts something by name.
    """

    def __init__(
        self,
        launch: DeviceLaunch,
        channels: Sequence[Channel],
        count: Callable[[str, int], None],
    ) -> None:
        self._launch = launch
        self._channels = {each.name: each for each in channels if each.direction == "out"}
        self._count = count
        self._pending = PendingWrites()
        self._profiles: dict[str, ChannelProfile] = {}
        self._lateness: dict[str, LatenessHistogram] = {}

    def __bool__(self) -> bool:
        return bool(self._channels)

    def take_write(self, agent: str, name: str, value: Any, due_s: float, *, t_s: float) -> None:
        """
        Let a value wait until it is due; of an output that passes the newest alone it ends a profile.

        Args:
            agent: Hands it over.
            name: The output.
            value: For it.
            due_s: When, on the clock of whoever drives the device.
            t_s: The same in simulated time; not a number before that is known.

        Raises:
            PluginError: The agent may not, or it is no value of an output.
        """
        channel = self._allowed(agent, name)
        value, was_beyond = to_output(channel, value)
        self._count(f"{name}_limited", int(was_beyond))
        replaced = self._pending.replaced
        if not self._pending.add(channel, value, float(due_s)):
            raise PluginError(f"{name}: too many values wait for their time")
        self._count("writes_replaced", self._pending.replaced - replaced)
        if channel.passing == "newest" and (profile := self._profiles.get(name)) is not None:
            # Before simulated time is known all of it is still to come.
            profile.replace(-math.inf if math.isnan(t_s) else t_s, (), t_s)

    def take_profile(
        self, agent: str, name: str, from_s: float, data: bytes, *, t_s: float
    ) -> None:
        """
        Let points wait until they are due, in place of all from *from_s* on.

        Args:
            agent: Hands them over.
            name: The output.
            from_s: Simulated, s.
            data: See `profiles.pack_points`.
            t_s: The present, simulated, s; not a number before that is known.

        Raises:
            PluginError: The agent may not, or there is no output of that name.
            ValueError: The bytes are no points.
        """
        known = self._channels.get(name)
        try:
            channel = self._allowed(agent, name)
        except PluginError:
            if known is not None:
                self._count(count_name("refused", name), sum(1 for _ in unpack_points(known, data)))
            raise
        if channel.is_frame:
            raise PluginError(f"{name}: frames have no profile: write them with their due_s")
        points = list(unpack_points(channel, data))
        profile = self._profiles.get(name)
        if profile is None:
            profile = self._profiles[name] = ChannelProfile(
                channel, lambda word, number: self._count(count_name(word, name), number)
            )
        held = profile.replace(float(from_s), points, t_s)
        self._count(f"{name}_limited", held)

    def _allowed(self, agent: str, name: str) -> Channel:
        """
        Return the output of that name.

        Raises:
            PluginError: There is none, or the agent may not move it.
        """
        channel = self._channels.get(name)
        if channel is None:
            raise PluginError(f"{name!r} is no output of the device")
        if agent != self._launch.owner:
            raise PluginError(f"{name}: its owner is {self._launch.owner or 'nobody'}")
        if not self._launch.may_move:
            raise PluginError(f"{name}: outputs may not move here ({self._launch.why_not})")
        return channel

    def due(
        self, now_s: float, t_s: float, local_s: Callable[[float], float]
    ) -> Iterator[DueOutput]:
        """
        Yield what is due, one after the other; what is not asked for any more stays.

        Args:
            now_s: The present on the clock of whoever drives the device, s.
            t_s: The same in simulated time; not a number before that is known.
            local_s: Returns when a simulated time is on that clock, s.
        """
        while (write := self._pending.pop_due(now_s)) is not None:
            channel = self._channels[write.channel]
            value = write.value if channel.is_frame else from_numbers(channel, write.value)
            yield DueOutput(channel=channel, value=value, due_s=write.due_s)
        for profile in self._profiles.values():
            while (point := profile.pop_due(t_s)) is not None:
                channel = point.channel
                value = from_numbers(channel, point.numbers) if point.numbers else None
                due_s = local_s(point.t_s)
                yield DueOutput(channel=channel, value=value, due_s=due_s, point=point)

    def next_s(self, local_s: Callable[[float], float], end_s: float) -> float:
        """
        Return when something is to be done next on the clock of whoever drives the device, s; infinity if nothing waits.

        What waits at the run's end is to be forgotten then.

        Args:
            local_s: Returns when a simulated time is on that clock, s; not a number before that is known.
            end_s: The run's end, simulated, s.
        """
        point_s = local_s(self.next_point_s())
        due_s = min(self.next_write_s(), math.inf if math.isnan(point_s) else point_s)
        ended_s = math.inf if math.isinf(due_s) else local_s(end_s)
        return due_s if math.isnan(ended_s) else min(due_s, ended_s)

    def next_write_s(self) -> float:
        """Return when a write is due next, s; infinity if none waits."""
        return self._pending.next_due_s()

    def next_point_s(self) -> float:
        """Return at which simulated time a profile wants something next, s; infinity if none does."""
        return min((each.next_s() for each in self._profiles.values()), default=float("inf"))

    def note_played(self, point: ProfilePoint, lateness_s: float) -> None:
        """Take note that a point was put out."""
        name = point.channel.name
        lateness_us = int(lateness_s * 1e6)
        if (histogram := self._lateness.get(name)) is None:
            histogram = self._lateness[name] = LatenessHistogram()
        histogram.add(lateness_us)
        self._count(count_name("played", name), 1)
        self._count(count_name("late", name), int(lateness_s > self._launch.late_s))

    def note_lost(self, output: DueOutput) -> None:
        """Take note that a value could not be put out: the device is closed, or its driver failed."""
        if output.point is None:
            self._count("writes_lost", 1)
        elif not output.point.is_underrun:
            self._count(count_name("lost", output.channel.name), 1)

    def note_refused(self, output: DueOutput | None) -> None:
        """Take note that something is refused; a value that was due by the driver."""
        point = output.point if output is not None else None
        if point is None:
            self._count("refused", 1)
        elif not point.is_underrun:
            self._count(count_name(DECLINED, point.channel.name), 1)

    def clear_writes(self) -> int:
        """Forget all writes, and return how many: what was to come belongs to what is over."""
        return self._pending.clear()

    def clear(self) -> int:
        """Forget all that waits, points too, and return how many writes: who handed it over is gone, or the run is."""
        for name, profile in self._profiles.items():
            self._count(count_name("unplayed", name), profile.clear())
        return self._pending.clear()

    def summary(self, counts: Mapping[str, int]) -> dict[str, Any]:
        """
        Return what became of profiles, under stimulus and by output; nothing where none was played.

        Args:
            counts: All that was counted of the device, by name.
        """
        stimulus = {
            name: {**told, "lateness_us": self._lateness_us(name)}
            for name, told in counts_by_channel(counts).items()
        }
        return {"stimulus": stimulus} if stimulus else {}

    def _lateness_us(self, name: str) -> dict[str, int]:
        histogram = self._lateness.get(name)
        if histogram is None:
            return {}
        return {
            "p50": histogram.percentile_us(50),
            "p99": histogram.percentile_us(99),
            "max": histogram.max_us,
        }
