"""
How a recorded run is flown again: software that can be stepped flies as it is today, other software is played back.

Of software behind a device the device's record has the bytes; of software that was only attached to, or has a clock of
its own, commands and estimates are on record, but not what its messages held. All software is told what became of its
commands in the ticks in which it was told then: in lockstep it would hear of it a tick earlier, and all that it is sent
would move with that. Of a run that was in lockstep itself it hears of it when it did, without a record.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from madns_runtime.plugin.api import Rerun
from madns_runtime.simulations.constellation.flight_settings import (
    FlightAttached,
    FlightClass,
    FlightProcess,
    FlightRule,
    Setting,
)
from madns_runtime.simulations.constellation.interface_settings import DeviceTransport
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.sensor_channels import sensors_from_devices
from madns_runtime.simulations.constellation.vehicles import flight_rules

PLAYER: Final = "madns_runtime.simulations.constellation.flight.recorded_commands:RecordedCommands"
UNLIKE: Final = (
    "flight_answers",
    "flight_clock",
    "truth",
    "truth_changes",
    *(
        f"maneuvers.{name}"
        for name in ("heard_s", "propagation_s", "network_s", "slack_s", "reason")
    ),
)
"""Streams and fields that tell of computers' clocks and networks: how truth came in pieces, when the host heard, and by
how much that was too late. What flight software was told of a command, reason and all, is judged in command_results."""


def for_rerun(
    parameters: ConstellationParameters, agents: tuple[str, ...], run_directory: Path
) -> Rerun:
    """Return the parameters of a rerun, and which software does not fly itself."""
    remarks: list[str] = []
    given = flight_rules(parameters)
    rules = tuple(
        _played(rule, number, run_directory, remarks) for number, rule in enumerate(given)
    )
    flown = replace(parameters, flight=rules) if remarks else parameters
    is_told_by_record = parameters.recorded_agents is not None or _had_clock(run_directory, agents)
    if is_told_by_record and (given or any(vehicle.actuation for vehicle in parameters.vehicles)):
        flown = replace(flown, recorded_agents=str(run_directory / "agents"))
    return Rerun(
        parameters=flown,
        remarks=tuple(remarks),
        unlike=(*UNLIKE, *_read_in_ticks(parameters)),
    )


def _had_clock(run_directory: Path, agents: tuple[str, ...]) -> bool:
    """Tell whether a run was in real time: in lockstep, where nobody is late, there is no stream of ticks."""
    return any((run_directory / "agents" / name / "ticks.jsonl").is_file() for name in agents)


def _read_in_ticks(parameters: ConstellationParameters) -> Iterator[str]:
    """Yield what follows from when a tick of real time came to read a device: some microseconds after it woke up."""
    hardware = {
        name for vehicle in parameters.vehicles for name, _ in sensors_from_devices(vehicle)
    }
    for name in sorted(hardware):
        yield from (f"{name}.t_s", f"{name}_model", f"{name}_truth")


def _played(rule: FlightRule, number: int, run: Path, remarks: list[str]) -> FlightRule:
    """Return a rule as it is flown again; one that is flown otherwise is told."""
    interface = None if isinstance(rule, FlightClass) else rule.interface
    if isinstance(rule, FlightClass) or interface is None:
        return rule
    which = f"flight[{number}] (agents {', '.join(rule.agents)})"
    if isinstance(interface.transport, DeviceTransport):
        remarks.append(
            f"{which}: behind the device {interface.transport.device}: its recorded bytes are played back"
        )
        return FlightAttached(
            interface=replace(interface, transport=replace(interface.transport, recorded=True)),
            agents=rule.agents,
            input=rule.input,
            rate_hz=rule.rate_hz,
            settings=rule.settings,
            answer_s=rule.answer_s,
        )
    if isinstance(rule, FlightProcess) and interface.clock == "stepped":
        return rule
    why = "it has a clock of its own" if interface.clock == "own" else "it was only attached to"
    remarks.append(
        f"{which}: cannot be stepped, as {why}: its recorded commands and estimates are given again, but no messages, "
        "whose content is not on record"
    )
    settings: dict[str, Setting] = {"agents": str(run / "agents")}
    return FlightClass(software=PLAYER, agents=rule.agents, rate_hz=rule.rate_hz, settings=settings)
