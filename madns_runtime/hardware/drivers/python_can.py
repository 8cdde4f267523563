"""A CAN bus by python-can, of the driver of `can`: any interface that it knows."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from typing import Any, Final

import can

from madns_runtime.errors import MachineError
from madns_runtime.hardware.drivers.can_bus import FULL, BusIsFullError
from madns_runtime.hardware.kinds.can import EXTENDED, CanParameters

WAITING_MAX: Final = 10_000
"""Frames that may wait to be read; more are lost, and told."""
LISTEN_S: Final = 0.05


class PythonCanBus:
    """
    A bus by python-can.

    Args:
        parameters: Which one.

    Raises:
        MachineError: It cannot be opened.
    """

    def __init__(self, parameters: CanParameters) -> None:
        self._where = parameters.interface
        self.frames_lost = 0
        """Always 0: such a loss is an error."""
        self.frames_left_out = 0
        options: dict[str, Any] = {"channel": parameters.interface}
        if parameters.bit_rate is not None:
            options["bitrate"] = parameters.bit_rate
        filters = [{"can_id": f.identifier, "can_mask": f.mask} for f in parameters.filters]
        try:
            self._bus = can.Bus(
                interface=parameters.python_can_interface, can_filters=filters or None, **options
            )
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise MachineError(f"{parameters.interface}: {error}") from None

        self._waiting: deque[Any] = deque(maxlen=WAITING_MAX)
        self._has_ended = threading.Event()
        # Some interfaces have no descriptor: a thread listens for all of them alike.
        self._signal = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._listener = threading.Thread(target=self._listen, name="can", daemon=True)
        self._listener.start()

    def fileno(self) -> int:
        """Return a descriptor that is readable while frames wait."""
        return self._signal

    def receive(self) -> tuple[int, bytes] | None:
        """
        Return the next data frame; requests, reports of errors and frames of CAN FD are left out.

        Raises:
            MachineError: The bus is gone, gave what is no frame, or frames came faster than they were read.
        """
        while True:
            if not self._waiting:
                with contextlib.suppress(BlockingIOError):
                    os.eventfd_read(self._signal)
                if not self._waiting:
                    return None
            message = self._waiting.popleft()
            if isinstance(message, str):
                raise MachineError(f"{self._where}: {message}")
            if message.is_error_frame or message.is_remote_frame or message.is_fd:
                self.frames_left_out += 1
                continue
            flag = EXTENDED if message.is_extended_id else 0
            return message.arbitration_id | flag, bytes(message.data)

    def send(self, identifier: int, data: bytes) -> None:
        """
        Send a frame.

        Raises:
            BusIsFullError: It takes none now.
            MachineError: It takes none any more.
        """
        message = can.Message(
            arbitration_id=identifier & ~EXTENDED,
            is_extended_id=bool(identifier & EXTENDED),
            data=data,
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
            number = error.errno if isinstance(error, OSError) else error.error_code
            if number in FULL or "buffer full" in str(error):
                raise BusIsFullError(self._where) from None
            raise MachineError(f"{self._where}: {error}") from None

    def close(self) -> None:
        """Close the bus."""
        self._has_ended.set()
        self._listener.join(20 * LISTEN_S)
        self._bus.shutdown()
        # One that lives may still write there, and the number would be another file's.
        if not self._listener.is_alive():
            os.close(self._signal)

    def _listen(self) -> None:
        """Take what comes until the bus is closed or gone."""
        while not self._has_ended.is_set():
            try:
                message = self._bus.recv(LISTEN_S)
            except (can.CanError, OSError) as error:
                message = f"is gone: {error}"
            except Exception as error:  # noqa: BLE001 - interfaces raise anything at a damaged frame
                message = f"cannot read what came: {type(error).__name__}: {error}"
            if message is None:
                continue
            if len(self._waiting) >= WAITING_MAX - 1:
                message = f"more than {WAITING_MAX} frames came before they were read"
            self._waiting.append(message)
            os.eventfd_write(self._signal, 1)
            if isinstance(message, str):
                return
