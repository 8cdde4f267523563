"""Resources that `cosmos up` makes machines ready with: environments of the wheelhouse, trees, a datagram echo."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosmos_cli.fleet.connection import Connection, address_here
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.models.device_needs import MachineNeeds, needs_of_machines
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.machine_facts import SystemPaths
from cosmos_cli.models.provision_steps import FILE_BYTES_MAX
from cosmos_cli.provision.desired import DesiredState
from cosmos_cli.provision.driver_files import drivers_by_machine
from cosmos_cli.provision.environment import (
    CheckDepth,
    RuntimeCheck,
    check_request,
    modules_of,
)
from cosmos_cli.provision.full_checks import FullChecks
from cosmos_cli.provision.inventory_steps import Content
from cosmos_cli.provision.trees import Tree, runtime_tree, scenario_tree
from cosmos_cli.provision.udp_echo import Echo
from cosmos_cli.provision.up_view import MachineTeller
from cosmos_cli.provision.wheelhouse import Environment, EnvironmentNeed, prepare_needed
from cosmos_cli.provision.wheels import with_own_wheels
from cosmos_cli.ui.step_times import HERE, timed
from madns_runtime.bounded_files import read_regular_file

if TYPE_CHECKING:  # importing the scenario's model takes longer than all that is done with it here
    from cosmos_cli.models.loading import ScenarioFile


class UpResources:
    """
    Resources of one `cosmos up`; one for all machines, used by many threads.

    Args:
        scenarios: What machines are made ready for; none for the runtime alone.
        fleet: The machines.
        host: Name of the machine that will run the host's half; None for this computer.
        echo: Answers datagrams here.
        say: Told what takes long on this computer before any machine is worked on.

    Raises:
        InputError: A scenario's folder cannot be sent, or no wheel be had of what it requires by path.
    """

    def __init__(
        self,
        scenarios: Sequence[ScenarioFile],
        fleet: Fleet,
        *,
        host: str | None,
        echo: Echo,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._scenarios = tuple((file, scenario_tree(file)) for file in scenarios)
        self._scenario_requirements = [
            with_own_wheels(file.scenario.requirements, file.base_directory, say)
            for file in scenarios
        ]
        machines = fleet.machines
        self._needs = [needs_of_machines(machines, file) for file in scenarios or (None,)]
        self._drivers = [
            drivers_by_machine(
                machines, needs.__getitem__, [file.base_directory] if file is not None else []
            )
            for needs, file in zip(self._needs, scenarios or (None,), strict=True)
        ]
        self._host = host
        self._echo = echo
        self._options = fleet.options
        self._runtime = runtime_tree()
        self.full_checks = FullChecks()
        """Which kinds of machines have passed theirs."""
        self._files: dict[Path, Content] = {}
        self._environments: dict[EnvironmentNeed, Environment] = {}
        self._environment_locks: dict[EnvironmentNeed, threading.Lock] = {}
        self._lock = threading.Lock()

    def trees(self, machine: Machine) -> tuple[Tree, ...]:
        """Return the runtime's tree, those of the scenarios, and that of a machine's own drivers of devices."""
        drivers = [found[machine.name].tree for found in self._drivers if machine.name in found]
        trees = (self._runtime, *(tree for _, tree in self._scenarios), *drivers)
        return tuple({tree.hash: tree for tree in trees}.values())

    def needs(self, machine: Machine) -> MachineNeeds:
        """Return what a machine needs for its devices, and for those of all scenarios."""
        found = [needs[machine.name] for needs in self._needs]
        devices = dict.fromkeys(each for needs in found for each in needs.devices)
        return MachineNeeds(devices=tuple(devices), driver_files=found[0].driver_files)

    @property
    def paths(self) -> SystemPaths:
        """Return the folders of a real system."""
        return SystemPaths()

    def environments(
        self, machine: Machine, greeting: Mapping[str, Any], teller: MachineTeller
    ) -> tuple[Environment, ...]:
        """Return the environment of each scenario, in their order, or that of the runtime alone."""
        needs = [
            EnvironmentNeed.of_machine(
                greeting,
                machine.variables,
                requirements,
                is_host=machine.name == self._host,
                needs=needs[machine.name],
            )
            for requirements, needs in zip(
                self._scenario_requirements or [()], self._needs, strict=True
            )
        ]
        return tuple(self._environment(need, teller) for need in needs)

    def _environment(self, need: EnvironmentNeed, teller: MachineTeller) -> Environment:
        """Return an environment, prepared once for all machines that need the same."""
        with self._lock:
            lock = self._environment_locks.setdefault(need, threading.Lock())
        with lock:
            if need not in self._environments:
                with timed(HERE, f"prepare the Python environment for {need.platform.label}"):
                    self._environments[need] = prepare_needed(
                        need, lambda what, share: teller.detail(f"{what} ({share:.0%})")
                    )
            return self._environments[need]

    def read_file(self, path: Path) -> Content:
        """Return a file of this computer, read once for all machines."""
        with self._lock:
            if path not in self._files:
                try:
                    self._files[path] = Content.of(
                        read_regular_file(path, bytes_max=FILE_BYTES_MAX)
                    )
                except OSError as error:
                    raise MachineFailure(
                        FailureKind.STEP,
                        f"{path} on this computer cannot be read: {error.strerror}",
                        "cosmos_provision of the inventory names it",
                    ) from error
            return self._files[path]

    def udp_question(self, connection: Connection, machine: Machine) -> dict[str, Any]:
        """Return where a machine is to send a datagram that comes back."""
        return self._echo.question(address_here(connection, machine.variables.cosmos_host_address))

    def udp_heard(self, question: dict[str, Any]) -> int:
        """Return how many datagrams of a question came here."""
        return self._echo.heard(question)

    def checks(
        self, desired: DesiredState, udp: Mapping[str, Any], *, depth: CheckDepth
    ) -> list[dict[str, Any]]:
        """
        Return the calls that ask whether the runtime starts there; the first asks for a datagram as well.

        A full one imports each scenario's agents' half too.
        """
        checks: dict[tuple[str, str], RuntimeCheck] = {}
        scenarios = self._scenarios if depth == "full" else ()
        for environment, scenario in zip_longest(desired.environments, scenarios):
            file, tree = scenario or (None, None)
            key = (environment.key, tree.hash if tree else "")
            checks.setdefault(
                key,
                RuntimeCheck(
                    key=environment.key,
                    trees=(self._runtime.hash,),
                    depth=depth,
                    modules=modules_of(environment),
                    simulation=file.scenario.simulation if file else "",
                    base=tree.hash if tree else "",
                    udp=None if checks else udp,
                ),
            )
        return [
            {"verb": "check_runtime", "arguments": check_request(desired.layout, check)}
            for check in checks.values()
        ]

    def connect_again(self, connection: Connection) -> Connection:
        """Return a second connection to the same machine."""
        return connect(connection.target, self._options)
