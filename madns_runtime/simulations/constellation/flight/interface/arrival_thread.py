"""Takes bytes as they come, so that their time of arrival is known to whoever looks once per tick."""

from __future__ import annotations

import os
import select
import threading
from time import monotonic

from madns_runtime.simulations.constellation.flight.interface.transport import (
    READ_BYTES,
    Arrival,
    Transport,
)

STOP, RESUME = b"s", b"r"
"""Words to the thread."""
WORDS_MAX = 64
STOP_S = 1.0
"""For the thread to end: it never waits for longer than for the end of one read."""


class ArrivalThread:
    """
    Reads a transport that is ready, until it is closed or the thread is stopped.

    Args:
        transport: Written to by others meanwhile, and read by nobody else.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._lock = threading.Lock()
        self._found: list[Arrival] = []
        self._size = 0
        self._wake, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._run, name="flight arrivals", daemon=True)
        self._thread.start()

    def take(self) -> list[Arrival]:
        """Return what has come since the last call; one with no data says that no more can come."""
        with self._lock:
            found, self._found = self._found, []
            was_full, self._size = self._size >= READ_BYTES, 0
        if was_full:
            os.write(self._waker, RESUME)
        return found

    def stop(self) -> None:
        """End the thread."""
        os.write(self._waker, STOP)
        self._thread.join(STOP_S)
        if not self._thread.is_alive():
            os.close(self._wake)
            os.close(self._waker)

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._wake, select.POLLIN)
        for fd in self._transport.fds():
            poller.register(fd, select.POLLIN)
        while self._read():
            # While too much lies here that nobody takes, the kernel keeps the rest.
            is_full = self._size >= READ_BYTES
            if not is_full and all(fd != self._wake for fd, _ in poller.poll()):
                continue
            if STOP in os.read(self._wake, WORDS_MAX):
                return

    def _read(self) -> bool:
        """Take what is there; return whether more may come."""
        if self._size >= READ_BYTES:
            return True
        data = self._transport.receive()
        if data is None:
            return True
        with self._lock:
            self._found.append(Arrival(data, monotonic()))
            self._size += len(data)
        return bool(data)
