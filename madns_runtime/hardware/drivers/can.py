"""Driver of `can`; see `madns_runtime.hardware.kinds.can`."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Mapping
from time import monotonic, sleep
from typing import Final

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.hardware.contract import Device, Sample, Value
from madns_runtime.hardware.drivers.can_bus import FULL, BusIsFullError, CanBus
from madns_runtime.hardware.kinds.can import (
    DATA_BYTES_MAX,
    EXTENDED,
    HEAD_BYTES,
    CanParameters,
    frame_of,
)

FRAME: Final = struct.Struct("=IB3x8s")
"""As the kernel's struct can_frame: identifier with flags, length, data."""


REMOTE: Final = 0x4000_0000


ERROR: Final = 0x2000_0000


RECEIVE_BYTES: Final = 1 << 20
"""Asked of the kernel: unasked Linux 6.1 keeps 278 frames, and 555 of what it then grants (`net.core.rmem_max`)."""
SO_RXQ_OVFL: Final = 40
"""Linux's: each frame tells how many before it found no room."""
LOST: Final = struct.Struct("=I")


SEND_S: Final = 0.05
"""So long a full queue is waited for, with a frame, or with all that make the bus safe."""
SEND_PAUSE_S: Final = 0.001


class CanDevice(Device):
    """Frames of one bus."""

    def open(self) -> str:
        """
        Open the bus.

        Raises:
            MachineError: There is no such interface, or it is down.
        """
        self._bus: CanBus | None = None
        self._lost = 0
        self._is_full = False
        p = self.parameters
        self._bus = _open_bus(p)
        return str(p.interface)

    def fileno(self) -> int | None:
        """Return the bus's descriptor."""
        assert self._bus is not None
        return self._bus.fileno()

    def read(self) -> Sample | None:
        """Return the next frame that has come."""
        assert self._bus is not None
        received = self._bus.receive()
        self.count("frames_lost", self._bus.frames_lost - self._lost)
        self._lost = self._bus.frames_lost
        if received is None:
            return None
        identifier, data = received
        frame = identifier.to_bytes(HEAD_BYTES, "little") + data
        return Sample(values={"received": frame}, taken_s=monotonic())

    def write(self, values: Mapping[str, Value], due_s: float) -> None:
        """
        Send a frame.

        Raises:
            PluginError: It is none, or the bus has no room for it now.
            MachineError: The bus does not take it.
        """
        frame = values["sent"]
        assert isinstance(frame, bytes)
        if len(frame) < HEAD_BYTES:
            raise PluginError(
                f"sent: expected 4 bytes of identifier and 0 to 8 of data, got {frame.hex()}"
            )
        identifier = int.from_bytes(frame[:HEAD_BYTES], "little")
        number = identifier & ~EXTENDED
        if number >> (29 if identifier & EXTENDED else 11):
            raise PluginError(
                f"sent: expected an identifier of 11 bits, or one of 29 with bit 31 set beside them; got 0x{identifier:08x}"
            )
        # A bus that took nothing for so long is not waited for with each frame.
        until_s = monotonic() + (0.0 if self._is_full else SEND_S)
        try:
            self._send(identifier, frame[HEAD_BYTES:], until_s)
        except BusIsFullError as error:
            self._is_full = True
            raise PluginError(f"sent: {error}") from None
        self._is_full = False

    def health(self) -> Mapping[str, float | int | str | bool | None]:
        """Return what was not handed on."""
        if self._bus is None:
            return {}
        return {
            "frames_lost": self._bus.frames_lost,
            "frames_left_out": self._bus.frames_left_out,
        }

    def make_safe(self) -> None:
        """Send the frames that the parameters name."""
        if self._bus is not None:
            until_s = monotonic() + SEND_S
            for text in self.parameters.safe_frames_hex:
                self._send(*frame_of(text), until_s)

    def close(self) -> None:
        """Close the bus."""
        if self._bus is not None:
            self._bus.close()

    def _send(self, identifier: int, data: bytes, until_s: float) -> None:
        assert self._bus is not None
        while True:
            try:
                self._bus.send(identifier, data)
                return
            except BusIsFullError:
                if monotonic() >= until_s:
                    raise
            sleep(SEND_PAUSE_S)  # no descriptor tells when a queue has room again


class SocketBus:
    """
    A bus by the kernel's sockets.

    Args:
        parameters: Which one.

    Raises:
        MachineError: There is no such interface, it is down, or the kernel has none of them.
    """

    def __init__(self, parameters: CanParameters) -> None:
        self._where = parameters.interface
        self.frames_lost = 0
        self.frames_left_out = 0
        try:
            self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        except OSError as error:
            raise MachineError(f"this kernel has no CAN sockets: {error.strerror}") from None
        try:
            if parameters.filters:
                packed = b"".join(
                    struct.pack("=II", f.identifier, f.mask) for f in parameters.filters
                )
                self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, packed)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
            self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            self._socket.bind((parameters.interface,))
            # An interface that is down takes the name all the same, and notes an error.
            if number := self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(number, os.strerror(number))
        except OSError as error:
            self._socket.close()
            raise self._fault(error) from None
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> tuple[int, bytes] | None:
        """Return the next data frame; requests and reports of errors are left out."""
        while True:
            try:
                raw, told, _, _ = self._socket.recvmsg(FRAME.size, socket.CMSG_SPACE(LOST.size))
            except BlockingIOError:
                return None
            except OSError as error:
                raise self._fault(error) from None
            for level, kind, content in told:
                if (level, kind) == (socket.SOL_SOCKET, SO_RXQ_OVFL):
                    (self.frames_lost,) = LOST.unpack_from(content)
            identifier, length, data = FRAME.unpack(raw)
            if not identifier & (REMOTE | ERROR):
                return identifier, data[: min(length, DATA_BYTES_MAX)]
            self.frames_left_out += 1

    def send(self, identifier: int, data: bytes) -> None:
        """
        Send a frame.

        Raises:
            BusIsFullError: The interface's queue has no room.
            MachineError: The interface takes none.
        """
        try:
            self._socket.send(FRAME.pack(identifier, len(data), data))
        except OSError as error:
            if error.errno in FULL:
                raise BusIsFullError(self._where) from None
            raise self._fault(error) from None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _fault(self, error: OSError) -> MachineError:
        cure = {
            errno.ENODEV: "there is no such interface; see `ip link`",
            errno.ENXIO: "there is no such interface any more; see `ip link`",
            errno.ENETDOWN: f"the interface is down; `sudo ip link set {self._where} up`",
        }.get(error.errno or 0, error.strerror or str(error))
        return MachineError(f"{self._where}: {cure}")


def _open_bus(parameters: CanParameters) -> CanBus:
    if parameters.library == "socket":
        return SocketBus(parameters)
    try:
        # An extra, which a machine with sockets of the kernel does not have.
        from madns_runtime.hardware.drivers.python_can import PythonCanBus
    except ModuleNotFoundError:
        raise MachineError("python-can is not installed here; pip install python-can") from None

    return PythonCanBus(parameters)
