"""Driver of `serial`; see `madns_runtime.hardware.kinds.serial`."""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from time import monotonic
from typing import Any

import serial
from serial.rs485 import RS485Settings

from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.hang_up import is_hung_up
from madns_runtime.hardware.framing import Framer, make_framer

READ_BYTES = 65_536


WRITE_TIMEOUT_S = 1.0
TTY_FOLDER = "/sys/class/tty"
USB_LEVELS_MAX = 4
"""From a port's folder up to its adapter's: by the interface, and of some the port, to the USB device."""


class SerialDevice(Device):
    """A line, opened for itself alone; it is read as soon as bytes come."""

    def open(self) -> str:
        """
        Open and lock the port; the identity is the adapter's serial number, where it has one.

        Raises:
            MachineError: It is not there, another program has it, or it does not take these settings.
        """
        self._port: Any = None
        p = self.parameters
        self._framer = self._make_framer()
        self._taken_s = 0.0
        self._frames: list[bytes] = []
        self._is_drained = False
        try:
            self._port = port = serial.Serial(
                p.port,
                p.baud_rate,
                bytesize=p.data_bits,
                parity=p.parity[0].upper(),
                stopbits=p.stop_bits,
                timeout=0,
                write_timeout=WRITE_TIMEOUT_S,
                rtscts=p.flow_control == "rts_cts",
                xonxoff=p.flow_control == "xon_xoff",
                dsrdtr=p.flow_control == "dsr_dtr",
                exclusive=True,
            )
        except (serial.SerialException, ValueError) as error:
            raise MachineError(_why_closed(p.port, error)) from None
        if p.electrical == "rs485":
            try:
                port.rs485_mode = RS485Settings(
                    rts_level_for_tx=p.rs485_rts_level_for_tx,
                    rts_level_for_rx=not p.rs485_rts_level_for_tx,
                    delay_before_tx=p.rs485_delay_before_tx_s or None,
                )
            except (OSError, ValueError):
                raise MachineError(
                    f"{p.port}: its driver does not switch the direction of RS-485; with an adapter that does it"
                    " by itself say electrical: rs422"
                ) from None
        self._fd = int(port.fileno())
        return _adapter_serial(p.port)

    def fileno(self) -> int:
        """Return the port's descriptor."""
        return self._fd

    def read(self) -> Sample | None:
        """
        Return the next frame that has come.

        Raises:
            MachineError: The line is gone.
        """
        if not self._frames:
            if self._is_drained:
                # All that had come was taken just now: what comes next wakes us.
                self._is_drained = False
                return None
            self._receive()
        if not self._frames:
            return None
        return Sample(values={"received": self._frames.pop()}, taken_s=self._taken_s)

    def _receive(self) -> None:
        """
        Take what has come.

        Raises:
            MachineError: The line is gone.
        """
        try:
            data = os.read(self._fd, READ_BYTES)
        except BlockingIOError:
            return
        except OSError as error:
            raise MachineError(f"{self.parameters.port} is gone: {error.strerror}") from None
        if data:
            self._taken_s = monotonic()
            framer = self._framer
            before = framer.garbage_bytes, framer.bad_checksums
            self._frames = framer.feed(data)[::-1]
            self.count("received_bytes", len(data))
            self.count("garbage_bytes", framer.garbage_bytes - before[0])
            self.count("bad_checksums", framer.bad_checksums - before[1])
            self._is_drained = bool(self._frames)
        elif is_hung_up(self._fd):  # an idle line reads as empty, too
            raise MachineError(f"{self.parameters.port} is gone: end of file")

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Send a frame.

        Raises:
            MachineError: The line does not take it.
        """
        frame = values["sent"]
        assert isinstance(frame, bytes)
        self._send(self._framer.wrap(frame))

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """Return what was thrown away."""
        return {
            "garbage_bytes": self._framer.garbage_bytes,
            "bad_checksums": self._framer.bad_checksums,
        }

    def make_safe(self) -> None:
        """Send the frame that the parameters name."""
        if self.parameters.safe_frame_hex and self._port is not None:
            self._send(self._framer.wrap(bytes.fromhex(self.parameters.safe_frame_hex)))

    def close(self) -> None:
        """Close the port; what was taken from it and is handed on no more is counted."""
        if self._port is not None:
            self.count("garbage_bytes", self._framer.waiting_bytes)
            self.count("frames_left", len(self._frames))
            self._frames.clear()
            self._port.close()

    def _make_framer(self) -> Framer:
        p = self.parameters
        return make_framer(p.framing, p.frame_bytes_max, p.length_bytes, p.length_order)

    def _send(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except (serial.SerialException, OSError) as error:
            raise MachineError(
                f"{self.parameters.port} does not take {len(data)} bytes: {error}"
            ) from None


def _why_closed(port: str, error: Exception) -> str:
    """Return what to tell of a port that does not open, and what to do."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES:
        return f"{port}: permission denied; add the user to the group dialout"
    if number == errno.ENOENT:
        return f"{port}: there is no such device; is it plugged in?"
    if "lock" in str(error).lower() or number in (errno.EBUSY, errno.EAGAIN):
        return f"{port}: another program has it open"
    return f"{port}: {error}"


def _adapter_serial(port: str) -> str:
    """Return the serial number of a USB adapter, as the kernel tells it; empty if there is none."""
    name = os.path.basename(os.path.realpath(port))
    folder = os.path.realpath(f"{TTY_FOLDER}/{name}/device")
    for _ in range(USB_LEVELS_MAX):
        if not os.path.exists(f"{folder}/idVendor"):
            folder = os.path.dirname(folder)
            continue
        # The first USB device on the way up is the adapter; hubs and controllers above it have numbers, too.
        try:
            with open(f"{folder}/serial", encoding="utf-8", errors="replace") as file:
                return file.read(256).strip()
        except OSError:
            return ""
    return ""
