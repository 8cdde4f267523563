"""
Rehearsal of a run: machines, versions, packages, code, room, datagrams. Changes nothing.

Everything is asked that `cosmos run` needs; what is missing is named with the command that mends it.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.doctor.probe import Responder
from cosmos_cli.fleet.connection import Connection, ConnectOptions, address_here
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.pool import for_each
from cosmos_cli.fleet.target import Target, target_of
from cosmos_cli.launch.machines import Identity, identity_of, refuse_twins
from cosmos_cli.launch.plan import LaunchPlan
from cosmos_cli.launch.preparation import says_address
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.machine_facts import NOEXEC_CURE, MachineFacts
from cosmos_cli.provision import STORE_PARTS
from cosmos_cli.provision.before_run import Cargo, cargo_of, environment_key_of
from cosmos_cli.provision.environment import ask_installed, installed_request
from cosmos_cli.ui import invocation
from cosmos_cli.ui.sizes import size_words
from madns_runtime.timing.rate import count_ticks

PARTS = (
    *("files", "links", "dpkg", "facts", *STORE_PARTS),
    *("madns_runtime.processes", "processes", "udp_probe"),
)
TIMEOUT_S = 60.0
ROUND_TRIP_COUNT = 10
RECORD_BYTES_A_TICK = 256
"""Assumed of one agent; the shipped simulations record 34 to 116 (README)."""
FREE_BYTES_MIN = 64 * 1024**2
"""A run begins on no fuller disk."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Something that a run would stumble over, and what mends it."""

    text: str
    cure: str = ""

    def __str__(self) -> str:
        return f"{self.text}: {self.cure}" if self.cure else self.text


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineRehearsal:
    """State of one machine against all that the run needs."""

    identity: Identity
    agents: int
    is_host: bool
    opening_ms: float
    facts: MachineFacts
    has_environment: bool
    files_missing: int
    """Files of the runtime and the scenario that are not there yet; `cosmos run` sends them."""
    bytes_missing: int
    living: tuple[str, ...] = ()
    """Runs that live there."""
    round_trip_ms: float | None = None
    """Median of datagrams to this computer and back; None without an answer, or where none was tried."""
    is_udp_tried: bool = True
    record_bytes: int = 0
    """About what will be recorded there."""

    def obstacles(self, name: str, up_command: str) -> list[Obstacle]:
        """Return what keeps the run from starting, or from working."""
        found: list[Obstacle] = []
        disk = self.facts.disk
        if not self.has_environment:
            found.append(
                Obstacle(
                    text="the Python packages that the run needs are not installed, or no longer whole",
                    cure=up_command,
                )
            )
        if disk.is_read_only or not disk.is_writable:
            found.append(
                Obstacle(text=f"{disk.path} cannot be written", cure="cosmos doctor tells why")
            )
        if disk.is_noexec:
            text = f"{disk.path} is mounted noexec: no Python package there can be loaded"
            found.append(Obstacle(text=text, cure=NOEXEC_CURE))
        needed = max(FREE_BYTES_MIN, self.bytes_missing + self.record_bytes)
        if disk.free_bytes < needed:
            inventory = invocation.current().inventory_options
            wipe = f"`cosmos wipe{inventory} --limit {shlex.quote(name)}`"
            found.append(
                Obstacle(
                    text=f"{size_words(disk.free_bytes)} free, {size_words(needed)} needed",
                    cure=f"`cosmos collect RUN`, then {wipe}",
                )
            )
        if self.is_udp_tried and self.round_trip_ms is None:
            found.append(
                Obstacle(
                    text="no datagram came back: UDP to this computer is blocked",
                    cure="open it in the firewall here, or set cosmos_host_address",
                )
            )
        return found

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "agents": self.agents,
            "is_host": self.is_host,
            "connect_ms": round(self.opening_ms, 2),
            "architecture": self.facts.board.machine,
            "python": ".".join(map(str, self.facts.python.version)),
            "has_environment": self.has_environment,
            "files_missing": self.files_missing,
            "bytes_missing": self.bytes_missing,
            "disk_free_bytes": self.facts.disk.free_bytes,
            "record_bytes": self.record_bytes,
            "round_trip_ms": None if self.round_trip_ms is None else round(self.round_trip_ms, 3),
            "living": list(self.living),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Rehearsal:
    """Asks the machines of a plan."""

    plan: LaunchPlan
    scenario: ScenarioFile
    runs: Path
    """Folder of all runs here."""
    options: ConnectOptions
    forks: int

    def machines(
        self,
        on_done: Callable[[Outcome[MachineRehearsal]], None],
        say: Callable[[str], None] = lambda text: None,
    ) -> list[Outcome[MachineRehearsal]]:
        """
        Ask every other computer of the plan at once.

        Raises:
            InputError: The scenario's folder cannot be sent, or two machines are one.
        """
        if not self.plan.elsewhere:
            return []
        cargo = cargo_of(self.scenario, tuple(self.plan.involved.values()), say)
        with Responder(self.scenario.scenario.network.port) as responder:

            def work(target: Target) -> MachineRehearsal:
                with contextlib.closing(connect(target, self.options)) as connection:
                    return self._ask(connection, self.plan.involved[target.name], cargo, responder)

            targets = [target_of(machine) for machine in self.plan.elsewhere]
            asked = for_each(targets, work, forks=self.forks, on_done=on_done)
        refuse_twins(
            (target, outcome.value.identity)
            for target, outcome in zip(targets, asked, strict=True)
            if outcome.value is not None
        )
        return asked

    def obstacles_here(self) -> list[Obstacle]:
        """Return what this computer lacks: room, a folder that can be written, a port that is free."""
        found = list(self._folder_obstacles())
        port = self.scenario.scenario.network.port
        if self.plan.host is None and not self.plan.is_lockstep and _is_taken(port):
            found.append(
                Obstacle(
                    text=f"network.port: UDP port {port} is taken here",
                    cure="choose another, or 0 for any that is free",
                )
            )
        return found

    def _folder_obstacles(self) -> Iterator[Obstacle]:
        """Yield what keeps records out of the folder of runs, or out of the one in which it would be made."""
        cure = "choose another folder with --runs"
        try:
            folder = _made_already(self.runs.absolute())
            free_bytes = shutil.disk_usage(folder).free
        except OSError as error:
            yield Obstacle(text=f"{self.runs}: {error.strerror or error}", cure=cure)
            return
        if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
            yield Obstacle(text=f"{self.runs}: {folder} cannot be written", cure=cure)
        needed = max(FREE_BYTES_MIN, self._record_bytes(self.scenario.scenario.agents.count))
        if free_bytes < needed:
            text = f"{self.runs}: {size_words(free_bytes)} free, {size_words(needed)} needed"
            yield Obstacle(text=text, cure=cure)

    def _ask(
        self, connection: Connection, machine: Machine, cargo: Cargo, responder: Responder
    ) -> MachineRehearsal:
        is_host = self.plan.host is not None and self.plan.host.name == machine.name
        agents = len(self.plan.agents_by_machine.get(machine.name, ()))
        layout = Layout(machine.variables.root)
        with Helper.start(connection, PARTS, watch=SilenceWatch(connection)) as helper:
            key = environment_key_of(helper, cargo, machine, is_host=is_host)
            trees = cargo.trees(machine.name)
            request = installed_request(
                layout, trees=[tree.hash for tree in trees], environments=[key]
            )
            installed = ask_installed(helper, request)
            missing = [tree for tree in trees if not installed.trees[tree.hash]]
            told = helper.call("facts", {"root": layout.root}, timeout_s=TIMEOUT_S).value
            processes = helper.call("processes", {"state": layout.state}, timeout_s=TIMEOUT_S).value
            trips = self._trips(helper, connection, machine, responder)
        return MachineRehearsal(
            identity=identity_of(helper.greeting, layout.root),
            agents=agents,
            is_host=is_host,
            opening_ms=connection.opening_s * 1e3,
            facts=MachineFacts.from_mapping(told),
            has_environment=installed.environments[key],
            files_missing=sum(len(tree.files) for tree in missing),
            bytes_missing=sum(tree.size_bytes for tree in missing),
            living=tuple(dict.fromkeys(str(process["run"]) for process in processes)),
            round_trip_ms=None if trips is None else trips.get("p50_ms"),
            is_udp_tried=trips is not None,
            record_bytes=self._record_bytes(agents),
        )

    def _trips(
        self, helper: Helper, connection: Connection, machine: Machine, responder: Responder
    ) -> Mapping[str, Any] | None:
        """Try datagrams to this computer; None where the run's host is another, and in lockstep."""
        if self.plan.host is not None:
            return None
        config = self.scenario.run_config("")
        said = config.network.address if says_address(config) else None
        arguments = {
            "address": address_here(connection, machine.variables.cosmos_host_address or said),
            "port": responder.port,
            "nonce_hex": responder.nonce.hex(),
            "count": ROUND_TRIP_COUNT,
        }
        told: Mapping[str, Any] = helper.call("round_trips", arguments, timeout_s=TIMEOUT_S).value
        return told

    def _record_bytes(self, agents: int) -> int:
        scenario = self.scenario.scenario
        ticks = count_ticks(scenario.time.duration_s, scenario.agents.tick_hz)
        return ticks * agents * RECORD_BYTES_A_TICK


def _made_already(folder: Path) -> Path:
    """
    Return a folder, or the nearest above it that is there.

    Raises:
        OSError: That cannot be seen, as below a folder that may not be entered.
    """
    for each in (folder, *folder.parents):
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            each.stat()
            return each
    return folder


def _is_taken(port: int) -> bool:
    with Responder(port) as responder:
        return responder.is_port_taken


def unready(
    outcomes: Sequence[Outcome[MachineRehearsal]], up_command: str
) -> dict[str, list[Obstacle]]:
    """Return the obstacles of every machine that has any, by name; a failure is one."""
    found: dict[str, list[Obstacle]] = {}
    for outcome in outcomes:
        if outcome.failure is not None:
            told = [Obstacle(text=outcome.failure.text, cure=outcome.failure.advice)]
        else:
            assert outcome.value is not None
            told = outcome.value.obstacles(outcome.machine, up_command)
        if told:
            found[outcome.machine] = told
    return found
