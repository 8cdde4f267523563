"""Transports on this computer: standard streams, pseudo-terminals, serial ports, devices of the run."""

from __future__ import annotations

import contextlib
import os
import select
import tty
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import Any

from madns_runtime.errors import BlamedError, MissingExtraError, PluginError
from madns_runtime.plugin.device_view import ChannelFrame, DeviceView
from madns_runtime.simulations.constellation.flight.interface.transport import (
    READ_BYTES,
    Arrival,
    StreamTransport,
    Transport,
)

RECEIVED, SENT = "received", "sent"
"""Channels of a device: bytes from the software, and to it."""


class StdioLink(StreamTransport):
    """Standard input and output of a program, which are given when it has started."""

    keeps_all = True

    def open(self) -> None:
        """Wait for the program."""

    def close_input(self) -> None:
        """Leave the program's standard input to the program's owner, who closes it: another would close it twice."""
        self._waiting.clear()
        self._is_over = True
        self._out = -1

    def push(self) -> None:
        """Send what waits."""
        if self._out >= 0:
            super().push()

    def release(self) -> None:
        """Leave the descriptors to the program, which has closed them."""
        self._in = self._out = -1


class PtyLink(StreamTransport):
    """The agent's end of a pseudo-terminal; ready once somebody has opened the other end."""

    _main = -1

    def open(self) -> None:
        """Open it, raw, so that bytes pass as they are."""
        self._main, other = os.openpty()
        tty.setraw(other)
        self.address = os.ttyname(other)
        os.close(other)  # what is left open here would hide that nobody else has it open

    def connect(self) -> None:
        """Ask whether somebody has the other end open."""
        poller = select.poll()
        poller.register(self._main, select.POLLIN)
        if not any(event & select.POLLHUP for _, event in poller.poll(0)):
            self.use(self._main, self._main)

    def close(self) -> None:
        """Hang up."""
        main, self._main = self._main, -1
        if not self.is_ready and main >= 0:
            os.close(main)
        super().close()


class SerialLink(StreamTransport):
    """
    A serial port.

    Args:
        port: Device file.
        baud_rate: Bits per second.
    """

    may_lose = True

    def __init__(self, port: str, baud_rate: int) -> None:
        super().__init__(f"serial {port}")
        self._given = (port, baud_rate)
        self._port: Any = None

    def open(self) -> None:
        """
        Open and lock the port.

        Raises:
            BlamedError: It is not there, or does not take this rate.
            MissingExtraError: pyserial is not installed.
        """
        try:
            import serial  # an extra, which few machines have
        except ImportError as error:
            raise MissingExtraError("pyserial", "hardware") from error
        port, baud_rate = self._given
        try:
            self._port = serial.Serial(port, baud_rate, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:
            raise BlamedError(f"{self.name}: cannot be opened: {error}") from error
        self.address = port
        self.use(self._port.fileno(), self._port.fileno())

    def receive(self) -> bytes | None:
        """Read what is there; a port that is set to wait for nothing reads nothing where there is nothing yet."""
        data = super().receive()
        if data == b"":
            poller = select.poll()
            poller.register(self._in, select.POLLIN)
            gone = select.POLLHUP | select.POLLERR | select.POLLNVAL
            return b"" if any(event & gone for _, event in poller.poll(0)) else None
        return data

    def close(self) -> None:
        """Close the port."""
        self._in = self._out = -1
        super().close()
        if self._port is not None:
            with contextlib.suppress(OSError):
                self._port.close()


class DeviceLink(Transport):
    """
    A device of the run: its process drives what leads to the software.

    Args:
        device: As the agent sees it.
        protocol: That which finds its packets in a stream of bytes itself; empty for one that may want whole frames.
    """

    may_lose = True

    def __init__(self, device: DeviceView, *, protocol: str) -> None:
        super().__init__(f"device {device.name}")
        self._device = device
        self._protocol = protocol
        self.counts |= {"bytes_dropped": 0}
        """Of a flood: what came in a tick beyond READ_BYTES; the newest are kept, so that no answer waits behind it."""

    @property
    def is_ready(self) -> bool:
        """Whether the device is there; what becomes of it is its own policy's to judge."""
        return True

    def open(self) -> None:
        """
        Ask for what came before.

        Raises:
            BlamedError: It has no queue of frames, or these are lines without their ends.
        """
        try:
            self._device.frames(RECEIVED)
            is_line = self._device.form_of(RECEIVED).is_line
        except PluginError as error:
            raise BlamedError(f"{self.name}: {error}") from error
        if is_line and self._protocol:
            raise BlamedError(
                f"{self.name}: expected bytes as they come, among which {self._protocol} finds the ends of its packets, got"
                " lines from which they are taken: give the device framing: raw"
            )

    def write(self, packets: Sequence[bytes]) -> bool:
        """
        Send each as a frame of its own.

        Raises:
            BlamedError: The device takes no frames, or none so long.
        """
        try:
            for packet in packets:
                self._device.write(SENT, packet)
                self.counts["bytes_sent"] += len(packet)
        except PluginError as error:
            raise BlamedError(f"{self.name}: {error}") from error
        return True

    def receive(self) -> bytes | None:
        """Return all frames together."""
        return b"".join(frame.value for frame in self._device.frames(RECEIVED)) or None

    def arrivals(self) -> list[Arrival]:
        """Return what has come, with the times at which the device's process took it."""
        now_s = monotonic()
        frames = self._newest(self._device.frames(RECEIVED))
        found = [
            self.taken(bytes(frame.value), now_s - frame.age_s) for frame in frames if frame.value
        ]
        return [arrival for one in found for arrival in one]

    def _newest(self, frames: list[ChannelFrame]) -> list[ChannelFrame]:
        """Return the newest frames, of READ_BYTES together at most; the others are dropped and counted."""
        room_bytes = READ_BYTES - 1  # as many count as a flood where the kernel keeps the rest
        for place in range(len(frames) - 1, -1, -1):
            room_bytes -= len(frames[place].value)
            if room_bytes < 0:
                self.counts["floods"] += 1
                self.counts["bytes_dropped"] += sum(len(one.value) for one in frames[: place + 1])
                return frames[place + 1 :]
        return frames

    def close(self) -> None:
        """Leave the device to its process."""


def find_device(devices: Any, name: str) -> DeviceView:
    """
    Return a device of an agent.

    Raises:
        BlamedError: It has none of that name.
    """
    found: DeviceView | None = devices.get(name)
    if found is None:
        known = ", ".join(devices) or "none"
        raise BlamedError(
            f"transport: expected a device of this agent's hardware, {known}; got {name!r}"
        )
    return found


def socket_path(path: str, base_directory: Path) -> str:
    """Return the path of a socket, found from the scenario's folder."""
    return str(base_directory / path)
