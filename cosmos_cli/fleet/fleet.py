"""The machines that a command works on, and the one way to work on all of them at once."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from cosmos_cli.fleet.connect import connect
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import FORKS_DEFAULT, for_each
from cosmos_cli.fleet.target import Target, target_of
from cosmos_cli.models.inventory import Machine, load_machines

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleet:
    """What -i and --limit mean."""

    machines: tuple[Machine, ...]
    targets: tuple[Target, ...]
    """Of the machines, in the same order."""
    forks: int = FORKS_DEFAULT
    options: ConnectOptions = ConnectOptions()

    def each(
        self,
        task: Callable[[Connection, Machine], T],
        on_done: Callable[[Outcome[T]], None] = lambda outcome: None,
    ) -> list[Outcome[T]]:
        """
        Connect to every machine, do *task* there, and close the connection.

        Args:
            task: Called in a thread, with an open connection.
            on_done: Called in this thread as each machine is done.

        Returns:
            All outcomes, in the order of the machines; a failure hides nobody else's.

        Raises:
            KeyboardInterrupt: After all connections were closed, so that what runs there ends.
            InputError: The operator's ssh configuration cannot be read.
        """
        machines = {machine.name: machine for machine in self.machines}
        living = _Living()

        def work(target: Target) -> T:
            connection = connect(target, self.options)
            with living.holding(connection):
                return task(connection, machines[target.name])

        try:
            return for_each(self.targets, work, forks=self.forks, on_done=on_done)
        finally:
            living.close()


class _Living:
    """The connections that are open, to close them when a command is interrupted."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._connections: set[Connection] = set()

    @contextlib.contextmanager
    def holding(self, connection: Connection) -> Iterator[None]:
        with self._lock:
            self._connections.add(connection)
        try:
            yield
        finally:
            with self._lock:
                self._connections.discard(connection)
            connection.close()

    def close(self) -> None:
        with self._lock:
            left = list(self._connections)
        for connection in left:
            connection.close()


def fleet_of(
    inventory: Path,
    limit: str | None = None,
    forks: int = FORKS_DEFAULT,
    accept_new_host_keys: bool = False,
) -> Fleet:
    """
    Read an inventory and return the machines that are meant.

    Raises:
        InputError: With every fault found.
    """
    machines = load_machines(inventory, limit)
    return Fleet(
        machines=machines,
        targets=tuple(target_of(machine) for machine in machines),
        forks=forks,
        options=ConnectOptions(accept_new_host_keys=accept_new_host_keys),
    )
