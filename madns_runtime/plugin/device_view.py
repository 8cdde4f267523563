"""A device as an agent's half sees it: what `AgentContext.hardware` holds."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, Protocol

DeviceStatus = Literal["never", "ok", "stale", "lost"]
"""never: open, no sample yet; ok; stale: the newest sample is older than 3 periods and 0.1 s; lost: no sample for 10
periods and 1 s, or the device is closed."""


class ChannelReading(NamedTuple):
    """The newest value of a channel."""

    value: Any
    """A float, or a tuple of as many as the channel has elements; None before the first sample."""
    age_s: float
    """Time since it was taken, s; infinite before the first sample."""
    number: int
    """How many samples the channel has had: the same number is the same sample."""
    status: DeviceStatus
    """Status of the device."""
    device_s: float
    """Time at which it was taken on the device's own clock, s; not a number if it has none."""


class ChannelFrame(NamedTuple):
    """A value of a channel whose values all arrive."""

    value: Any
    """bytes of a frame, else as of `ChannelReading`."""
    number: int
    age_s: float
    """Time between its being taken and the call that returned it, s."""


class ChannelForm(NamedTuple):
    """Description of a channel's values."""

    unit: str
    """As its kind declares it, such as rad/s; empty if it does not."""
    size: int
    """Numbers of a value; 0 of a channel of frames."""
    is_line: bool = False
    """Of frames: whether each is a line without its end, so that not all bytes can be in one."""


class DeviceView(Protocol):
    """One device; nothing here waits."""

    name: str

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs of numbers, whose newest values it gives."""

    @property
    def status(self) -> DeviceStatus:
        """Status of the device, now."""

    def __getitem__(self, channel: str) -> ChannelReading:
        """
        Return the newest value of an input.

        Raises:
            PluginError: The device has no such input, or it is one of frames.
        """

    def form_of(self, channel: str) -> ChannelForm:
        """
        Return what the values of a channel are, an input or an output.

        Raises:
            PluginError: The device has no such channel.
        """

    def frames(self, channel: str) -> list[ChannelFrame]:
        """
        Return all that has come through a queue since the last call, in order.

        Raises:
            PluginError: The device has no such input, or it passes the newest value alone.
        """

    def write(self, channel: str, value: Any, *, due_s: float | None = None) -> None:
        """
        Hand over a value for an output; its limits are held by the device's process.

        Args:
            channel: The output.
            value: A float, a sequence of as many as the channel has elements, or bytes of a frame.
            due_s: Simulated time at which it is to be put out, s; None for at once.

        Raises:
            PluginError: The device has no such output, the value is none of its shape, or it or the time is no number.
        """

    def play(
        self,
        channel: str,
        points: Iterable[tuple[float, Any]],
        *,
        from_s: float | None = None,
    ) -> None:
        """
        Hand over a timed profile of an output, which the device's process puts out point by point.

        Args:
            channel: The output; its limits are held as of `write`.
            points: Simulated times, s, rising, each with a float or a sequence of as many as the channel has
                elements; 10,000 may wait. No points end the profile in good order.
            from_s: Simulated time from which on all that was handed over before is replaced, s; the first
                point's if None.

        A profile whose newest point is followed by none in its time has run out: it is counted as an underrun, and
        the output holds its value or becomes safe, as the kind says.

        Raises:
            PluginError: The device has no such output, it is one of frames, times do not rise, or a value is none
                of the output's shape.
        """

    def size_of(self, channel: str) -> int:
        """
        Return how many numbers an output takes.

        Raises:
            PluginError: The device has no such output, or it is one of frames.
        """
