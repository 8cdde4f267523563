"""`cosmos up` on all machines of a fleet: what they have in common, and what became of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.fleet import Fleet
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.provision.bring_up import Site, bring_up
from cosmos_cli.provision.brought import Brought, UpOptions
from cosmos_cli.provision.echo import Echo
from cosmos_cli.provision.kit import Workshop
from cosmos_cli.provision.up_table import MachineResult
from cosmos_cli.provision.up_view import UpView

if TYPE_CHECKING:
    from cosmos_cli.models.loading import ScenarioFile


class FleetUp:
    """
    Makes the machines of a fleet ready, or plans it; used by many threads.

    Args:
        fleet: The machines.
        scenarios: What they are made ready for; none for the runtime alone.
        options: What was asked for.
        echo: Answers datagrams here.
        view: Shows what is done.

    Raises:
        InputError: Faults of the inventory or a scenario, or no such host.
    """

    def __init__(
        self,
        fleet: Fleet,
        scenarios: Sequence[Path],
        options: UpOptions,
        *,
        echo: Echo,
        view: UpView,
    ) -> None:
        self._machines = {machine.name: machine for machine in fleet.machines}
        if options.host is not None and options.host not in self._machines:
            known = ", ".join(self._machines)
            raise InputError(f"--host {options.host}: expected one of the machines {known}")
        self._options = options
        self._view = view
        self._kit = Workshop(_load(scenarios), host=options.host, echo=echo, options=fleet.options)

    def bring(self, connection: Connection, board: Board) -> Brought:
        """Make one machine ready; *board* is started there with HELPER_PARTS."""
        name = connection.target.name
        site = Site(connection=connection, board=board, machine=self._machines[name])
        return bring_up(site, self._kit, self._options, self._view.teller(name))

    def result(self, outcome: Outcome[Brought | None]) -> MachineResult:
        """Return what became of one machine; this computer, which is left alone, has no value."""
        brought = outcome.value or Brought(
            failure=outcome.failure, is_local=outcome.failure is None
        )
        return MachineResult(
            machine=outcome.machine, brought=brought, duration_s=outcome.duration_s
        )


def _load(paths: Sequence[Path]) -> list[ScenarioFile]:
    if not paths:
        return []
    from cosmos_cli.models.loading import load_scenario  # not needed for the runtime alone

    return [load_scenario(path) for path in paths]
