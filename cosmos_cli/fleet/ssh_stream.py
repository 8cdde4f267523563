"""A program on a machine, over SSH; see `cosmos_cli.fleet.connection.Stream`."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from typing import Any

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.output import BoundedOutput
from cosmos_cli.fleet.ssh_failures import lost

ERROR_BYTES_MAX = 8192
READ_BYTES = 262_144
EXIT_STATUS_TIMEOUT_S = 1.0
UNKNOWN_STATUS = -1
"""What paramiko says when no status came; a signal is told by `ssh_transport`."""


class Bell:
    """
    A pipe that is readable when there may be news.

    Stands for paramiko's own, whose two halves (standard output and error) can lose a signal when one is
    emptied while the other is filled. Rung under the channel's lock by the connection's thread.
    """

    def __init__(self) -> None:
        self._out, self._in = os.pipe()
        os.set_blocking(self._out, False)
        os.set_blocking(self._in, False)
        self._is_closed = False
        self._lock = threading.Lock()

    def fileno(self) -> int:
        """Return the end to poll."""
        return self._out

    def set(self) -> None:
        """Ring; paramiko calls it when bytes come and at their end."""
        with self._lock, contextlib.suppress(BlockingIOError):
            if not self._is_closed:
                os.write(self._in, b"!")

    def clear(self) -> None:
        """Do nothing: paramiko's view of one buffer says nothing of the other."""

    def silence(self) -> None:
        """Forget what has been rung; look for news after this, not before."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._out, 65536)

    def close(self) -> None:
        """Close both ends."""
        with self._lock:
            if not self._is_closed:
                self._is_closed = True
                os.close(self._in)
                os.close(self._out)


class SshStream:
    """
    A program at the other end of a channel.

    Args:
        channel: paramiko's; a command runs in it.
        transport: Its connection.
        errors: Keeps what the program writes to standard error.
    """

    def __init__(self, channel: Any, transport: Any, errors: BoundedOutput | None = None) -> None:
        self._channel = channel
        self._transport = transport
        self._errors = errors or BoundedOutput(0, ERROR_BYTES_MAX)
        self._bell = Bell()
        self._is_open = True
        channel.in_buffer.set_event(self._bell)
        channel.in_stderr_buffer.set_event(self._bell)

    def fileno(self) -> int:
        """Return what to poll."""
        return self._bell.fileno()

    def read(self, count: int) -> bytes:
        """Return what has come."""
        self._bell.silence()
        channel = self._channel
        while channel.recv_stderr_ready():
            self._errors.add(channel.recv_stderr(READ_BYTES))
        if channel.recv_ready():
            try:
                data: bytes = channel.recv(count)
            except (OSError, EOFError) as error:  # it tells the other side that there is room again
                raise lost(error) from error
            self._bell.set()  # there may be more, and the end is news as well
            return data
        if channel.eof_received or channel.closed:
            if channel.recv_ready() or channel.recv_stderr_ready():
                return self.read(count)
            self._bell.set()
            if self._is_broken():
                raise lost()
            return b""
        raise BlockingIOError

    def write(self, data: bytes) -> int:
        """Hand over what fits."""
        channel = self._channel
        if channel.closed or channel.eof_sent:
            raise self._gone()
        if not channel.send_ready():
            raise BlockingIOError
        return self._send(data)

    def read_some(self, count: int, *, timeout_s: float) -> bytes:
        """Wait for bytes."""
        until_s = time.monotonic() + timeout_s
        while True:
            try:
                return self.read(count)
            except BlockingIOError:
                remaining_s = until_s - time.monotonic()
                if remaining_s <= 0:
                    raise MachineFailure(
                        FailureKind.TIMEOUT, f"no answer in {timeout_s:g} s"
                    ) from None
                wait_for(self._bell.fileno(), remaining_s)

    def write_all(self, data: bytes, *, timeout_s: float) -> None:
        """Hand over everything."""
        view = memoryview(data)
        self._channel.settimeout(timeout_s)
        while view:
            if self._channel.closed or self._channel.eof_sent:
                raise self._gone()
            try:
                view = view[self._send(view) :]
            except TimeoutError:
                raise MachineFailure(
                    FailureKind.TIMEOUT, f"took no more input for {timeout_s:g} s"
                ) from None

    def close_writing(self) -> None:
        """End its standard input."""
        with contextlib.suppress(OSError, EOFError):
            self._channel.shutdown_write()

    def exit_status(self) -> int | None:
        """Return how it ended, waiting a moment when its output has ended already."""
        channel = self._channel
        if channel.eof_received and not channel.closed:
            channel.status_event.wait(EXIT_STATUS_TIMEOUT_S)
        if (number := getattr(channel, "signal_number", None)) is not None:
            return -int(number)
        if not channel.status_event.is_set() or channel.exit_status == UNKNOWN_STATUS:
            return None
        return int(channel.exit_status)

    def errors(self) -> str:
        """Return the last of its standard error."""
        if self._is_open:
            while self._channel.recv_stderr_ready():
                self._errors.add(self._channel.recv_stderr(READ_BYTES))
        return self._errors.text()

    def close(self) -> None:
        """Close the channel: its program's standard input ends."""
        if self._is_open:
            self._is_open = False
            with contextlib.suppress(OSError, EOFError):
                self._channel.close()
            self._bell.close()

    def _send(self, data: Any) -> int:
        try:
            count: int = self._channel.send(data)
        except TimeoutError:
            raise
        except (OSError, EOFError) as error:
            raise self._gone() from error
        if count == 0 and len(data):
            raise self._gone()
        return count

    def _is_broken(self) -> bool:
        return not self._transport.is_active() and not self._channel.eof_received

    def _gone(self) -> MachineFailure:
        if self._transport.is_active():
            return MachineFailure(FailureKind.LOST, "the program there has ended")
        return lost()


def wait_for(descriptor: int, timeout_s: float) -> bool:
    """Wait until *descriptor* is readable; select() would fail above 1024."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(max(0.0, timeout_s) * 1000.0))
