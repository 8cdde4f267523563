"""
Contract of a connection to a machine; SSH and this computer are two ways to have one.

`Stream` is made for two kinds of users: a loop, which polls `fileno` and never blocks, and a thread of
the pool, which waits with a deadline through `cosmos_cli.fleet.liveness.BlockingStream`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.target import Target

OUTPUT_BYTES_MAX = 4 * 1024 * 1024
"""Bytes that `Connection.run` keeps of each output: one half from its beginning, one from its end."""
LEFT_OPEN_S = 1.0
"""Silence after a command's end for which its output is still waited for: what it left running may hold that for ever."""
SAID_BYTES_MAX = 1024 * 1024 * 1024
"""Bytes that a command may write at all before it is ended."""
EXIT_STATUS_TIMEOUT_S = 20.0
"""Wait for a program's exit status, once its output has ended: a program closes that first, and may have to wait for a
processor before it has ended itself."""
SMALL_BYTES_MAX = 1024 * 1024
"""Bytes for a command that prints next to nothing; the shell's start-up files may print something as well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectOptions:
    """The operator's decisions about all connections of a command."""

    timeout_s: float = 10.0
    """Time until a machine is logged in at; ConnectTimeout of the ssh configuration wins."""
    accept_new_host_keys: bool = False
    """Whether unknown host keys are recorded; changed ones are refused whatever stands here."""
    listed: Mapping[str, Target] = field(default_factory=dict)
    """Machines where the inventory has them now, by name: tried for one that is not reached where a run's plan has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Completed:
    """A command that has ended."""

    exit_status: int
    """Negative for a signal."""
    stdout: bytes
    stderr: bytes
    cut_bytes: int = 0
    """Number of bytes of both that were too many to keep; a line in their midst says so."""
    is_left_open: bool = False
    """Whether something that it left running still holds its output: what that says later is not waited for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamEnd:
    """End of a program, as far as it is known."""

    exit_status: int | None
    """Negative for a signal; None while it runs or when nobody knows."""
    errors: str
    """The last of what it wrote to standard error, some kilobytes at most."""


class Stream(Protocol):
    """A program on a machine: bytes to its standard input, bytes from its standard output."""

    def fileno(self) -> int:
        """Return what to poll: readable when `read` would not block."""

    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        """
        Return what has come or comes in time, at most *count* bytes; empty at the end.

        Raises:
            BlockingIOError: Nothing has come.
            MachineFailure: The connection is lost.
        """

    def write(self, data: bytes | memoryview, *, timeout_s: float = 0.0) -> int:
        """
        Hand over what fits, as soon as anything does, and return how many bytes that was.

        Raises:
            BlockingIOError: Nothing fitted in time.
            MachineFailure: The program or the connection is gone.
        """

    def close_writing(self) -> None:
        """End the program's standard input; harmless when repeated."""

    def ending(self, *, timeout_s: float = 0.0) -> StreamEnd:
        """Return how the program ended; after the end of its output its status may take a moment to come."""

    def close(self) -> None:
        """Let go of it; a program that watches its standard input ends."""


NO_ADDRESS = (
    "through a ProxyCommand it is not seen by which address this machine reaches this computer"
)
NO_ADDRESS_CURE = (
    "name it with cosmos_host_address in the inventory, or use ProxyJump where it will do"
)


class Connection(Protocol):
    """A machine that answers. Made by `cosmos_cli.fleet.open_connection.connect`, closed by its owner."""

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
        """Duration of the login, s."""

    def run(
        self,
        command: str,
        *,
        stdin: bytes | None = b"",
        timeout_s: float,
        said_bytes_max: int = SAID_BYTES_MAX,
    ) -> Completed:
        """
        Run a shell command to its end.

        Args:
            command: For the user's shell there.
            stdin: What it reads; None for an input without content that ends only with the connection:
                `cosmos_cli.fleet.shell` waits for that end.
            timeout_s: Until it has ended.
            said_bytes_max: Bytes that it may write; a command that writes more is ended.

        Raises:
            MachineFailure: TIMEOUT, or DATA: it said too much; or the connection is lost.
        """

    def is_alive(self, *, timeout_s: float = 2.0) -> bool:
        """Ask the other side for a sign of life."""

    def close(self) -> None:
        """Close it; harmless when repeated."""


def address_here(connection: Connection, given: str | None) -> str:
    """
    Return the address by which a machine reaches this computer: the one *given*, else as its connection shows.

    Raises:
        MachineFailure: None is given, and a ProxyCommand shows none.
    """
    address = given or connection.own_address
    if not address:
        raise MachineFailure(FailureKind.UNSUPPORTED, NO_ADDRESS, NO_ADDRESS_CURE)
    return address
