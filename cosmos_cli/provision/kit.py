"""What `cosmos up` makes machines ready with: environments from the wheelhouse, trees, an echo of datagrams."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosmos_cli.fleet.connect import connect
from cosmos_cli.fleet.connection import Connection, ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.apply import Teller
from cosmos_cli.provision.echo import Echo
from cosmos_cli.provision.environment import RuntimeCheck, check_request, modules_of
from cosmos_cli.provision.platform import Platform, greeted_platform
from cosmos_cli.provision.trees import Tree, runtime_tree, scenario_tree
from cosmos_cli.provision.wanted import Content, Paths, Wanted
from cosmos_cli.provision.wheelhouse import Environment, prepare, sees_system_packages

if TYPE_CHECKING:  # importing the scenario's model takes longer than all that is done with it here
    from cosmos_cli.models.loading import ScenarioFile


@dataclass(frozen=True, slots=True, kw_only=True)
class Need:
    """What an environment is made for."""

    platform: Platform
    requirements: tuple[str, ...]
    is_host: bool
    sees_system: bool


class Workshop:
    """
    The kit of `cosmos_cli.provision.bring_up` for real machines.

    Args:
        scenarios: What machines are made ready for; none for the runtime alone.
        host: Name of the machine that will run the host's half; None for this computer.
        echo: Answers datagrams here.
        options: How machines are connected to.

    Raises:
        InputError: A scenario's folder cannot be sent.
    """

    def __init__(
        self,
        scenarios: Sequence[ScenarioFile],
        *,
        host: str | None,
        echo: Echo,
        options: ConnectOptions,
    ) -> None:
        self._scenarios = tuple((file, scenario_tree(file)) for file in scenarios)
        self._host = host
        self._echo = echo
        self._options = options
        self._runtime = runtime_tree()
        self._files: dict[Path, Content] = {}
        self._environments: dict[Need, Environment] = {}
        self._environment_locks: dict[Need, threading.Lock] = {}
        self._lock = threading.Lock()

    @property
    def trees(self) -> tuple[Tree, ...]:
        """Return the runtime's tree and those of the scenarios."""
        trees = (self._runtime, *(tree for _, tree in self._scenarios))
        return tuple({tree.hash: tree for tree in trees}.values())

    @property
    def paths(self) -> Paths:
        """Return the folders of a real system."""
        return Paths()

    def environments(
        self, machine: Machine, greeting: Mapping[str, Any], teller: Teller
    ) -> tuple[Environment, ...]:
        """Return the environment of each scenario, in their order, or that of the runtime alone."""
        platform = greeted_platform(greeting)
        needs = [
            Need(
                platform=platform,
                requirements=(*machine.requirements, *requirements),
                is_host=machine.name == self._host,
                sees_system=sees_system_packages(machine.packages),
            )
            for requirements in self._requirements()
        ]
        return tuple(self._environment(need, teller) for need in needs)

    def _environment(self, need: Need, teller: Teller) -> Environment:
        """Return an environment, prepared once for all machines that need the same."""
        with self._lock:
            lock = self._environment_locks.setdefault(need, threading.Lock())
        with lock:
            if need not in self._environments:
                self._environments[need] = prepare(
                    need.platform,
                    need.requirements,
                    is_host=need.is_host,
                    sees_system=need.sees_system,
                    progress=lambda what, share: teller.detail(f"{what} ({share:.0%})"),
                )
            return self._environments[need]

    def read_file(self, path: Path) -> Content:
        """Return a file of this computer, read once for all machines."""
        with self._lock:
            if path not in self._files:
                try:
                    self._files[path] = Content.of(path.read_bytes())
                except OSError as error:
                    raise MachineFailure(
                        FailureKind.STEP,
                        f"{path} on this computer cannot be read: {error.strerror}",
                        "cosmos_provision of the inventory names it",
                    ) from error
            return self._files[path]

    def udp_question(self, connection: Connection, machine: Machine) -> dict[str, Any]:
        """Return where a machine is to send a datagram that comes back."""
        return self._echo.question(machine.host_address or connection.own_address)

    def udp_heard(self, question: dict[str, Any]) -> int:
        """Return how many datagrams of a question came here."""
        return self._echo.heard(question)

    def checks(
        self, wanted: Wanted, udp: Mapping[str, Any], *, is_full: bool
    ) -> list[dict[str, Any]]:
        """
        Return the questions whether the runtime starts there; the first asks for a datagram as well.

        A full one, after a change, imports each scenario's agents' half too.
        """
        checks: dict[tuple[str, str], RuntimeCheck] = {}
        scenarios = self._scenarios if is_full else ()
        for environment, scenario in zip_longest(wanted.environments, scenarios):
            file, tree = scenario or (None, None)
            key = (environment.key, tree.hash if tree else "")
            checks.setdefault(
                key,
                RuntimeCheck(
                    key=environment.key,
                    trees=(self._runtime.hash,),
                    is_full=is_full,
                    modules=modules_of(environment),
                    simulation=file.scenario.simulation if file else "",
                    base=tree.hash if tree else "",
                    udp=None if checks else udp,
                ),
            )
        return [check_request(wanted.layout, check) for check in checks.values()]

    def connect_again(self, connection: Connection) -> Connection:
        """Return a second connection to the same machine."""
        return connect(connection.target, self._options)

    def _requirements(self) -> list[tuple[str, ...]]:
        return [tuple(file.scenario.requirements) for file, _ in self._scenarios] or [()]
