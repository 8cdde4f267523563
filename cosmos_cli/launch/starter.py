"""Starts the programs of a run, each where it belongs: here, or on a machine that is logged in at."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.launch import children
from cosmos_cli.launch.children import Child, LocalChild, Program
from cosmos_cli.launch.loop import Loop
from cosmos_cli.launch.machines import RemoteMachine
from cosmos_cli.launch.outcome import LaunchRequest
from cosmos_cli.launch.remote import RemoteChild, RemoteProgram

HOST = "host"
HOST_MODULE = "madns_runtime.host"
AGENT_MODULE = "madns_runtime.agent"
LOCKSTEP_ENVIRONMENT: Mapping[str, str] = {"PYTHONHASHSEED": "0"}
"""The order of a set of names depends on it: with it, that is the same in every run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """Who hears of a child."""

    on_line: Callable[[bytes], None]
    on_unreachable: Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Starter:
    """Knows the programs, and which machine is another computer."""

    request: LaunchRequest
    remote: Mapping[str, RemoteMachine]
    loop: Loop

    def start_host(self, told: Told) -> Child:
        """
        Start the host.

        Raises:
            OSError: It is to run here, and cannot be started.
        """
        where, launch = self.request.host_machine, self.request.host_launch()
        if where is not None and where in self.remote:
            program = self._program(where, HOST, HOST_MODULE, f"{HOST}/stderr.txt")
            return self._start_there(where, program, launch, told)
        return self._start_here(HOST, children.HOST_PROGRAM, HOST, launch=launch, told=told)

    def start_agents(self, name: str, machine: str, launch: Mapping[str, Any], told: Told) -> Child:
        """
        Start a machine's supervisor.

        Raises:
            OSError: It is to run here, and cannot be started.
        """
        folder = f"machines/{machine}"
        if machine in self.remote:
            program = self._program(machine, name, AGENT_MODULE, f"{folder}/stderr.txt")
            return self._start_there(machine, program, launch, told)
        return self._start_here(name, children.AGENT_PROGRAM, folder, launch=launch, told=told)

    def _start_here(
        self,
        name: str,
        arguments: tuple[str, ...],
        folder: str,
        *,
        launch: Mapping[str, Any],
        told: Told,
    ) -> Child:
        directory = self.request.directory
        program = Program(
            name=name,
            arguments=arguments,
            stderr=Path(directory, folder, "stderr.txt"),
            run_directory=str(directory),
            environment=LOCKSTEP_ENVIRONMENT if self.request.config.time.is_lockstep else {},
        )
        return LocalChild(program, self.loop.selector, launch=launch, on_line=told.on_line)

    def _program(self, machine: str, name: str, module: str, stderr: str) -> RemoteProgram:
        directory = self.request.place_of(machine).directory
        return RemoteProgram(name=name, module=module, run_directory=directory, stderr=stderr)

    def _start_there(
        self, machine: str, program: RemoteProgram, launch: Mapping[str, Any], told: Told
    ) -> Child:
        return RemoteChild(
            program,
            self.remote[machine],
            self.loop,
            launch=launch,
            on_line=told.on_line,
            on_unreachable=told.on_unreachable,
        )
