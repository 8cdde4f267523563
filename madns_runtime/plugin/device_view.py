"""A device as an agent's half sees it: what `AgentContext.hardware` holds."""

from __future__ import annotations

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
    """Of the device."""
    device_s: float
    """Time at which it was taken on the device's own clock, s; not a number if it has none."""


class ChannelFrame(NamedTuple):
    """A value of a channel whose values all arrive."""

    value: Any
    """bytes of a frame, else as of `ChannelReading`."""
    number: int
    age_s: float
    """Time between its being taken and the call that returned it, s."""


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
            PluginError: The device has no such output, or the value is none of its shape, or is no number.
        """
