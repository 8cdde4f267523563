"""This computer as a machine: the same as over SSH, through pipes."""

from __future__ import annotations

import contextlib
import os
import select
import selectors
import signal
import subprocess
import sys
import tempfile
import time

from cosmos_cli.fleet.connection import (
    LEFT_OPEN_S,
    OUTPUT_BYTES_MAX,
    SAID_BYTES_MAX,
    Completed,
    StreamEnd,
)
from cosmos_cli.fleet.failure import ended_early
from cosmos_cli.fleet.target import Target
from cosmos_cli.fleet.transfer_limits import BoundedOutput, OutputLimits, not_ended

LOOPBACK = "127.0.0.1"
ERROR_BYTES_MAX = 4096
END_TIMEOUT_S = 5.0
END_POLL_S = 0.25
"""Time between looks whether a command that says nothing has ended."""
READ_BYTES = 262_144


def this_computer(name: str) -> Target:
    """Return this computer as a target, with the Python that runs here."""
    return Target(name=name, address=LOOPBACK, connection="local", python=sys.executable)


class LocalConnection:
    """
    This computer.

    Args:
        target: Its entry in the inventory.
    """

    opening_s = 0.0
    own_address = LOOPBACK
    peer_address = LOOPBACK

    def __init__(self, target: Target) -> None:
        self.target = target

    def open(self, command: str) -> LocalStream:
        """Start a shell command."""
        return LocalStream(command)

    def run(
        self,
        command: str,
        *,
        stdin: bytes | None = b"",
        timeout_s: float,
        said_bytes_max: int = SAID_BYTES_MAX,
    ) -> Completed:
        """Run a shell command to its end."""
        half = OUTPUT_BYTES_MAX // 2
        output, errors = BoundedOutput(half, half), BoundedOutput(half, half)
        limits = OutputLimits(timeout_s=timeout_s, said_bytes_max=said_bytes_max)
        pending = None if stdin is None else memoryview(stdin)
        with subprocess.Popen(
            ["/bin/sh", "-c", command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        ) as process:
            try:
                is_left_open = _converse(process, pending, (output, errors), limits)
            finally:
                if process.poll() is None:  # with its children
                    with contextlib.suppress(ProcessLookupError):
                        os.killpg(process.pid, signal.SIGKILL)
        return Completed(
            exit_status=process.returncode,
            stdout=output.data,
            stderr=errors.data,
            cut_bytes=output.cut_bytes + errors.cut_bytes,
            is_left_open=is_left_open,
        )

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        """Return True: whoever asks is this computer."""
        return True

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


class LocalStream:
    """A program here; see `cosmos_cli.fleet.connection.Stream`."""

    def __init__(self, command: str) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
            bufsize=0,
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._stdin, self._stdout = self._process.stdin, self._process.stdout
        self._has_ended = False
        for pipe in (self._stdin, self._stdout):
            os.set_blocking(pipe.fileno(), False)

    def fileno(self) -> int:
        """Return what to poll."""
        return self._stdout.fileno()

    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        """Return what has come or comes in time."""
        wait_for(self._stdout.fileno(), select.POLLIN, timeout_s)
        data = os.read(self._stdout.fileno(), count)
        self._has_ended = not data
        return data

    def write(self, data: bytes | memoryview, *, timeout_s: float = 0.0) -> int:
        """Hand over what fits."""
        try:
            wait_for(self._stdin.fileno(), select.POLLOUT, timeout_s)
            return os.write(self._stdin.fileno(), data)
        except (BrokenPipeError, ValueError):
            # Its pipes close a moment before the kernel knows how it ended.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(END_TIMEOUT_S)
            end = self.ending()
            raise ended_early(end.errors, end.exit_status) from None

    def close_writing(self) -> None:
        """End its standard input."""
        with contextlib.suppress(OSError):
            self._stdin.close()

    def ending(self, *, timeout_s: float = 0.0) -> StreamEnd:
        """Return how it ended, waiting for its status when its output has ended already."""
        status = self._process.poll()
        if status is None and self._has_ended:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = self._process.wait(timeout_s)
        if self._errors.closed:
            return StreamEnd(exit_status=status, errors="")
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - ERROR_BYTES_MAX))
        return StreamEnd(
            exit_status=status, errors=self._errors.read(ERROR_BYTES_MAX).decode(errors="replace")
        )

    def close(self) -> None:
        """Close the pipes and wait for its end; one that does not heed is killed."""
        self.close_writing()
        self._stdout.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()


def wait_for(descriptor: int, event: int, timeout_s: float) -> None:
    """Wait for a pipe; select() would fail for a descriptor above 1023."""
    if timeout_s > 0:
        poll = select.poll()
        poll.register(descriptor, event)
        poll.poll(timeout_s * 1000.0)


def _converse(
    process: subprocess.Popen[bytes],
    pending: memoryview | None,
    outputs: tuple[BoundedOutput, BoundedOutput],
    limits: OutputLimits,
) -> bool:
    """
    Feed a command, unless *pending* is None, and read what it says until both its outputs have ended.

    Returns:
        Whether one of them is still open, though it has ended: what it left running holds that.
    """
    assert process.stdin is not None and process.stdout is not None and process.stderr is not None
    until_s = time.monotonic() + limits.timeout_s
    heard_s = time.monotonic()
    with selectors.DefaultSelector() as selector:
        for pipe, output in zip((process.stdout, process.stderr), outputs, strict=True):
            selector.register(pipe, selectors.EVENT_READ, output)
        if pending is not None:
            os.set_blocking(process.stdin.fileno(), False)
            selector.register(process.stdin, selectors.EVENT_WRITE)
        while process.stdout in selector.get_map() or process.stderr in selector.get_map():
            remaining_s = until_s - time.monotonic()
            limits.check(remaining_s, outputs)
            ready = selector.select(min(END_POLL_S, remaining_s))
            if ready or process.poll() is None:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s >= LEFT_OPEN_S:
                return True
            for key, _ in ready:
                if key.data is None:
                    pending = _feed(key.fd, pending or memoryview(b""))
                    if not pending:
                        selector.unregister(process.stdin)
                        process.stdin.close()
                elif data := os.read(key.fd, READ_BYTES):
                    key.data.add(data)
                else:
                    selector.unregister(key.fileobj)
    try:
        process.wait(max(0.0, until_s - time.monotonic()))
    except subprocess.TimeoutExpired:
        raise not_ended(limits.timeout_s) from None
    return False


def _feed(descriptor: int, pending: memoryview) -> memoryview:
    """Hand over what fits now and return the rest; a program that has ended reads no more."""
    try:
        return pending[os.write(descriptor, pending) :] if pending else pending
    except BlockingIOError:
        return pending
    except BrokenPipeError:
        return memoryview(b"")
