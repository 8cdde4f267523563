"""Asks a machine, or this computer, for everything that is judged, in one request, and answers its datagrams."""

from __future__ import annotations

import dataclasses
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cosmos_cli.doctor.case import Wants
from cosmos_cli.doctor.device_needs import conditions_of, missing_of, need_questions
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout, at_home
from cosmos_cli.fleet.udp_server import DatagramServer, bound_socket
from cosmos_cli.models.device_needs import MachineNeeds, needs_of_machines
from cosmos_cli.models.inventory import Machine
from cosmos_cli.models.text_forms import is_own_requirement
from cosmos_cli.onboard.udp_probe import ANSWER, ASK, NONCE_BYTES, UNASKED, Datagram
from cosmos_cli.provision.wheelhouse import EnvironmentNeed, remembered_key

if TYPE_CHECKING:
    from cosmos_cli.models.loading import ScenarioFile

PARTS = (
    "files",
    "links",
    "dpkg",
    "facts",
    "madns_runtime.processes",
    "processes",
    "cpu_load",
    "timer_latency",
    "udp_probe",
    "interfaces",
    "doctor",
)
WAKE_UP_COUNT = 200
WAKE_UP_HZ = 100.0
ROUND_TRIP_COUNT = 50
TIMEOUT_S = 60.0
"""Some seconds are usual; a disk that has to wait for a worn card may take many."""


class Responder(DatagramServer):
    """
    Answers machines that know its nonce; use it as a context manager.

    Args:
        port: UDP port to listen at, as the host of a run would; one that is free when it is 0 or taken.
    """

    def __init__(self, port: int = 0) -> None:
        self.nonce = secrets.token_bytes(NONCE_BYTES)
        self.ignored = 0
        """Datagrams of somebody else."""
        super().__init__(self._reply, port=port)
        self._other = bound_socket(family=self.family)

    def close(self) -> None:
        """Hear no more; harmless when repeated."""
        super().close()
        self._other.close()

    def question(
        self, connection: Connection, machine: Machine | None, count: int
    ) -> dict[str, Any] | None:
        """Return where a machine is to send datagrams; None if it is not known how it reaches this computer."""
        own = machine.variables.cosmos_host_address if machine else None
        address = own or connection.own_address
        if not address:
            return None
        return {
            "address": address,
            "port": self.port,
            "nonce_hex": self.nonce.hex(),
            "count": count,
        }

    def _reply(self, own: socket.socket, data: bytes, where: Any) -> None:
        received_s = time.clock_gettime(time.CLOCK_REALTIME)
        asked = Datagram.decode(data)
        if asked is None or asked.kind != ASK or asked.nonce != self.nonce:
            self.ignored += 1
            return
        answer = dataclasses.replace(
            asked,
            kind=ANSWER,
            received_s=received_s,
            answered_s=time.clock_gettime(time.CLOCK_REALTIME),
        )
        own.sendto(answer.encode(), where)
        if asked.port:
            unasked = dataclasses.replace(asked, kind=UNASKED)
            self._other.sendto(unasked.encode(), (where[0], asked.port, *where[2:]))


def ask(
    connection: Connection,
    wants: Wants,
    responder: Responder,
    *,
    machine: Machine | None = None,
    needs: DoctorNeeds | None = None,
) -> dict[str, Any]:
    """
    Return what a machine tells of itself.

    Args:
        connection: To the machine.
        wants: What a run would ask for.
        responder: Answers the machine's datagrams.
        machine: Its entry in the inventory, if it has one.
        needs: Of devices; None to leave them out.

    Raises:
        MachineFailure: It cannot be asked.
    """
    layout = Layout(connection.target.root)
    arguments = {
        "wake_ups": _wake_ups(wants, wants.priority),
        "round_trips": responder.question(connection, machine, ROUND_TRIP_COUNT),
        "root": layout.root,
        "runs": layout.runs,
        "environments": layout.environments,
        "state": layout.state,
        "sudo": connection.target.may_become_root,
    }
    return _call(
        connection,
        arguments,
        lambda board: needs.ask(board, machine) if needs and machine else [],
    )


def ask_here(
    connection: Connection, wants: Wants, *, runs: str, state: str, interface: str
) -> dict[str, Any]:
    """
    Return what this computer tells of itself, as the machine that a run's host works on.

    Args:
        connection: To this computer.
        wants: What a run would ask for.
        runs: Folder of all runs.
        state: Of the register of processes, COSMOS_STATE_DIR.
        interface: By which the machines are reached.

    Raises:
        MachineFailure: It cannot be asked.
    """
    arguments = {
        "wake_ups": _wake_ups(wants, wants.priority + 1),
        "root": runs,
        "state": state,
        "interface": interface,
        "sudo": True,
    }
    return _call(connection, arguments)


def _wake_ups(wants: Wants, priority: int) -> dict[str, Any]:
    return {
        "count": WAKE_UP_COUNT,
        "rate_hz": WAKE_UP_HZ,
        "policy": wants.policy,
        "priority": priority,
    }


def _call(
    connection: Connection,
    arguments: Mapping[str, Any],
    ask_devices: Callable[[Helper], Any] = lambda board: (),
) -> dict[str, Any]:
    with Helper.start(connection, PARTS) as board:
        asked_s = time.clock_gettime(time.CLOCK_REALTIME)
        told = dict(board.call("doctor", arguments, timeout_s=TIMEOUT_S).value)
        told["devices"] = ask_devices(board)
    told["asked_utc_s"] = asked_s
    return told


class DoctorNeeds:
    """
    Asks machines what their devices need and is missing there.

    Args:
        machines: All of them.
        scenario_file: Whose devices count as well; None for none.
    """

    def __init__(self, machines: Sequence[Machine], scenario_file: ScenarioFile | None) -> None:
        self._needs = needs_of_machines(machines, scenario_file)
        requirements = scenario_file.scenario.requirements if scenario_file else ()
        self._requirements = tuple(text for text in requirements if not is_own_requirement(text))

    def ask(self, board: Helper, machine: Machine) -> list[dict[str, Any]]:
        """
        Return what is missing on a machine, by device.

        Raises:
            MachineFailure: It cannot be asked.
        """
        needs = self._needs[machine.name]
        if not needs.devices:
            return []
        asked = need_questions(
            machine.name,
            needs,
            greeting=board.greeting,
            environments=tuple(self._environments(board, machine, needs)),
        )
        conditions = conditions_of(asked)
        told = board.call("look", {"conditions": conditions}, timeout_s=TIMEOUT_S).value
        return missing_of(machine.name, needs, asked, told["conditions"])

    def _environments(self, board: Helper, machine: Machine, needs: MachineNeeds) -> Iterator[str]:
        """Yield the folders of environments that `cosmos up` would have made for these needs."""
        layout = Layout(at_home(machine.variables.root, str(board.greeting["home"])))
        for requirements in {(), self._requirements}:
            for is_host in (False, True):
                key = remembered_key(
                    EnvironmentNeed.of_machine(
                        board.greeting,
                        machine.variables,
                        requirements,
                        is_host=is_host,
                        needs=needs,
                    )
                )
                if key is not None:
                    yield layout.environment(key)
