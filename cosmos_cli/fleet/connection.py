"""
What the rest of COSMoS asks of a connection to a machine; SSH and this computer are two ways to have one.

`Stream` is made for two kinds of users: a loop, which polls `fileno` and never blocks, and a thread of
the pool, which waits with a deadline through `read_some` and `write_all`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from cosmos_cli.fleet.target import Target

OUTPUT_BYTES_MAX = 4 * 1024 * 1024
"""What `Connection.run` keeps of each output: one half of its begin, one of its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectOptions:
    """What an operator may decide about all connections of a command."""

    timeout_s: float = 10.0
    """Until a machine is logged in at; ConnectTimeout of the ssh configuration wins."""
    accept_new_host_keys: bool = False
    """Whether unknown host keys are recorded; changed ones are refused whatever stands here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Completed:
    """A command that has ended."""

    exit_status: int
    """Negative for a signal."""
    stdout: bytes
    stderr: bytes
    cut_bytes: int = 0
    """How many bytes of both were too many to keep; a line in their midst says so."""


class Stream(Protocol):
    """A program on a machine: bytes to its standard input, bytes from its standard output."""

    def fileno(self) -> int:
        """Return what to poll: readable when `read` would not block."""

    def read(self, count: int) -> bytes:
        """
        Return what has come, at most *count* bytes; empty at the end.

        Raises:
            BlockingIOError: Nothing has come.
            MachineFailure: The connection is lost.
        """

    def write(self, data: bytes) -> int:
        """
        Hand over what fits, and return how many bytes that was.

        Raises:
            BlockingIOError: Nothing fits now.
            MachineFailure: The program or the connection is gone.
        """

    def read_some(self, count: int, *, timeout_s: float) -> bytes:
        """
        Wait for bytes, at most *timeout_s*; empty at the end.

        Raises:
            MachineFailure: TIMEOUT, or the connection is lost.
        """

    def write_all(self, data: bytes, *, timeout_s: float) -> None:
        """
        Hand over everything, waiting for room; *timeout_s* is for each piece that is taken.

        Raises:
            MachineFailure: TIMEOUT, or the connection is lost.
        """

    def close_writing(self) -> None:
        """End the program's standard input; harmless when repeated."""

    def exit_status(self) -> int | None:
        """Return how the program ended, negative for a signal; None while it runs or when nobody knows."""

    def errors(self) -> str:
        """Return the last of what the program wrote to standard error, some kilobytes at most."""

    def close(self) -> None:
        """Let go of it; a program that watches its standard input ends."""


class Connection(Protocol):
    """A machine that answers. Made by `cosmos_cli.fleet.connect.connect`, closed by its owner."""

    @property
    def target(self) -> Target:
        """The machine."""

    @property
    def own_address(self) -> str:
        """Address of this computer as the machine reaches it."""

    @property
    def peer_address(self) -> str:
        """Address of the machine as this computer reaches it."""

    def open(self, command: str) -> Stream:
        """
        Start a shell command there; closing the stream closes its standard input.

        Raises:
            MachineFailure: The connection is lost.
        """

    @property
    def opening_s(self) -> float:
        """How long it took to be logged in there."""

    def run(self, command: str, *, stdin: bytes | None = b"", timeout_s: float) -> Completed:
        """
        Run a shell command to its end.

        Args:
            command: For the user's shell there.
            stdin: What it reads; None for nothing, and no end either before the connection closes, for
                which `cosmos_cli.fleet.watched` waits.
            timeout_s: Until it has ended.

        Raises:
            MachineFailure: TIMEOUT, or the connection is lost.
        """

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        """Ask the other side for a sign of life."""

    def close(self) -> None:
        """Close it; harmless when repeated."""
