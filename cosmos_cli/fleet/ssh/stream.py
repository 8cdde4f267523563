"""A program on a machine, over SSH; see `cosmos_cli.fleet.connection.Stream`."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from typing import Any

from cosmos_cli.fleet.connection import StreamEnd
from cosmos_cli.fleet.failure import MachineFailure, ended_early
from cosmos_cli.fleet.local import wait_for
from cosmos_cli.fleet.ssh.failures import lost
from cosmos_cli.fleet.transfer_limits import BoundedOutput

ERROR_BYTES_MAX = 8192
READ_BYTES = 262_144
ERROR_READS_MAX = 64
"""Of standard error when it is asked for: more than the window of a channel holds."""
UNKNOWN_STATUS = -1
"""Status that paramiko reports when none came; a signal is told by `ssh.transport`."""


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

    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        """Return what has come or comes in time."""
        until_s = time.monotonic() + timeout_s
        while (data := self._come(count)) is None:
            remaining_s = until_s - time.monotonic()
            if remaining_s <= 0:
                raise BlockingIOError
            wait_for(self._bell.fileno(), select.POLLIN, remaining_s)
        return data

    def _come(self, count: int) -> bytes | None:
        """Return what has come, empty at the end; None for nothing."""
        self._bell.silence()
        channel = self._channel
        if channel.recv_stderr_ready():  # once: there may be more of it for ever
            self._errors.add(channel.recv_stderr(READ_BYTES))
            self._bell.set()
        if channel.recv_ready():
            try:
                data: bytes = channel.recv(count)
            except (OSError, EOFError) as error:  # it tells the other side that there is room again
                raise lost(error) from error
            self._bell.set()  # there may be more, and the end is news as well
            return data
        if not (channel.eof_received or channel.closed):
            return None
        if channel.recv_ready() or channel.recv_stderr_ready():
            return self._come(count)
        self._bell.set()
        if not channel.eof_received and not self._transport.is_active():
            raise lost()
        return b""

    def write(self, data: bytes | memoryview, *, timeout_s: float = 0.0) -> int:
        """Hand over what fits."""
        channel = self._channel
        if channel.closed or channel.eof_sent:
            raise self._gone()
        channel.settimeout(timeout_s)
        try:
            count: int = channel.send(data)
        except TimeoutError:
            raise BlockingIOError from None
        except (OSError, EOFError) as error:
            raise self._gone() from error
        if count == 0 and len(data):
            raise self._gone()
        return count

    def close_writing(self) -> None:
        """End its standard input."""
        with contextlib.suppress(OSError, EOFError):
            self._channel.shutdown_write()

    def ending(self, *, timeout_s: float = 0.0) -> StreamEnd:
        """Return how it ended, waiting for its status when its output has ended already."""
        channel = self._channel
        if channel.eof_received and not channel.closed:
            channel.status_event.wait(timeout_s)
        if self._is_open:
            for _ in range(ERROR_READS_MAX):
                if not channel.recv_stderr_ready():
                    break
                self._errors.add(channel.recv_stderr(READ_BYTES))
        return StreamEnd(exit_status=self._status(), errors=self._errors.text())

    def has_exited(self) -> bool:
        """Tell whether its exit status has come; its output may be open still, held by what it left running."""
        return self._status() is not None

    def close(self) -> None:
        """Close the channel: its program's standard input ends."""
        if self._is_open:
            self._is_open = False
            with contextlib.suppress(OSError, EOFError):
                self._channel.close()
            self._bell.close()

    def _status(self) -> int | None:
        channel = self._channel
        if (number := getattr(channel, "signal_number", None)) is not None:
            return -int(number)
        if not channel.status_event.is_set() or channel.exit_status == UNKNOWN_STATUS:
            return None
        return int(channel.exit_status)

    def _gone(self) -> MachineFailure:
        if (breach := self._transport.wire.breach) is not None:  # paramiko may not have noticed yet
            return lost(breach)
        if not self._transport.is_active():
            return lost()
        end = self.ending()
        return ended_early(end.errors, end.exit_status)
