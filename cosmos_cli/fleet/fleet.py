"""The machines that a command works on, and the one way to work on all of them at once."""

from __future__ import annotations

import dataclasses
import functools
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import FORKS_DEFAULT, for_each
from cosmos_cli.fleet.target import Target, machines_of, target_of
from cosmos_cli.fleet.target_cache import key_of, recall, remember
from cosmos_cli.models.inventory_arguments import Given, sources_of

if TYPE_CHECKING:
    from cosmos_cli.models.inventory import Machine

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Fleet:
    """Machines that -i and --limit mean."""

    targets: tuple[Target, ...]
    """Addresses and logins of the machines, in the order of the inventory."""
    forks: int = FORKS_DEFAULT
    options: ConnectOptions = ConnectOptions()
    load: Callable[[], tuple[Machine, ...]] = tuple
    """Reads the inventory; not called where the targets alone are needed."""
    sources: tuple[str, ...] = ()
    """Inventories that -i named."""

    @functools.cached_property
    def machines(self) -> tuple[Machine, ...]:
        """All that the inventory says of the targets, in the same order."""
        return self.load()

    def elsewhere(self) -> Fleet:
        """Return the fleet without this computer."""
        return dataclasses.replace(
            self, targets=tuple(target for target in self.targets if target.connection != "local")
        )

    def each(
        self,
        task: Callable[[Connection, Machine], T],
        on_done: Callable[[Outcome[T]], None] = lambda outcome: None,
    ) -> list[Outcome[T]]:
        """
        Connect to every machine, do *task* there, and close the connection.

        Args:
            task: Called in a thread, with an open connection and what the inventory says of the machine.
            on_done: Called in this thread as each machine is done.

        Returns:
            All outcomes, in the order of the machines; a failure hides nobody else's.

        Raises:
            KeyboardInterrupt: After all connections were closed, so that what runs there ends.
            InputError: The operator's ssh configuration cannot be read.
        """
        machines = {machine.name: machine for machine in self.machines}
        return self.each_target(
            lambda connection: task(connection, machines[connection.target.name]), on_done
        )

    def each_target(
        self,
        task: Callable[[Connection], T],
        on_done: Callable[[Outcome[T]], None] = lambda outcome: None,
        on_wait: Callable[[], None] = lambda: None,
    ) -> list[Outcome[T]]:
        """Do as `each`, for a *task* that needs no entry of the inventory, which is then not read; *on_wait* as in `for_each`."""
        lock = threading.Lock()
        living: set[Connection] = set()
        is_over = False

        def work(target: Target) -> T:
            connection = connect(target, self.options)
            with lock:
                living.add(connection)
                is_late = is_over
            try:
                if is_late:  # it came when the others had been closed
                    raise MachineFailure(FailureKind.LOST, "the command was interrupted")
                return task(connection)
            finally:
                with lock:
                    living.discard(connection)
                connection.close()

        try:
            return for_each(self.targets, work, forks=self.forks, on_done=on_done, on_wait=on_wait)
        finally:  # of a command that is interrupted some are open
            with lock:
                is_over = True
                left = list(living)
            for connection in left:
                connection.close()


def fleet_of(
    inventory: Given,
    limit: str | None = None,
    forks: int = FORKS_DEFAULT,
    accept_new_host_keys: bool = False,
) -> Fleet:
    """
    Read an inventory and return the machines that are meant.

    Raises:
        InputError: With every fault found.
    """
    key = key_of(inventory, limit)
    targets = recall(key)
    load = functools.partial(machines_of, inventory, limit)
    if targets is None:
        machines = load()
        load = functools.partial(tuple, machines)
        targets = tuple(target_of(machine) for machine in machines)
        if key == key_of(inventory, limit):  # nobody edited it meanwhile
            remember(key, targets)
    return Fleet(
        targets=targets,
        forks=forks,
        options=ConnectOptions(accept_new_host_keys=accept_new_host_keys),
        load=load,
        sources=sources_of(inventory),
    )
