"""
Faults in what a scenario says of flight software: who flies it, where it is, how it is reached.

As in `check_vehicles`: nothing of it is run.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from madns_runtime.simulations.constellation.check_addresses import address_faults
from madns_runtime.simulations.constellation.check_vehicles import (
    WALL,
    code_faults,
    glob_faults,
    unreached_faults,
)
from madns_runtime.simulations.constellation.flight.programs import find_program
from madns_runtime.simulations.constellation.flight_rates import flight_rate
from madns_runtime.simulations.constellation.flight_settings import (
    FlightAttached,
    FlightClass,
    FlightProcess,
    FlightRule,
    Setting,
)
from madns_runtime.simulations.constellation.interface_settings import (
    PROTOCOLS,
    FlightInterface,
    StdioTransport,
    is_played_back,
)
from madns_runtime.simulations.constellation.parameters import ConstellationParameters
from madns_runtime.simulations.constellation.substitution import NAMES, substitution_faults
from madns_runtime.simulations.constellation.vehicles import flight_of, flight_rules

PLACES: Final = ("address", "pty")
"""Further names in braces, which a program is given: where its transport is."""
SETTING_BYTES_MAX: Final = {"name": 32, "text": 48}
"""Of a setting in frames and Space Packets, whose structs cut what is longer; a test holds them to the structs."""


def flight_faults(
    parameters: ConstellationParameters,
    names: Sequence[tuple[str, str]],
    base_directory: Path,
    *,
    is_lockstep: bool,
) -> list[str]:
    """
    Return the faults.

    Args:
        parameters: Of the scenario, within their bounds.
        names: Names of each agent and of its satellite; empty if they are not known.
        base_directory: Folder of the scenario.
        is_lockstep: Whether simulated time waits for everybody.
    """
    given = parameters.flight
    if isinstance(given, str):
        return code_faults("parameters.flight", given, base_directory, forbidden=WALL)
    rules = flight_rules(parameters)
    faults = unreached_faults("parameters.flight", [rule.agents for rule in rules], names)
    for number, rule in enumerate(rules):
        field = f"parameters.flight[{number}]" if isinstance(given, tuple) else "parameters.flight"
        if isinstance(given, tuple) and isinstance(given[number], str):
            faults += code_faults(field, str(given[number]), base_directory, forbidden=WALL)
            continue
        faults += glob_faults(f"{field}.agents", rule.agents, names)
        faults += _software_faults(field, rule, base_directory)
        interface = None if isinstance(rule, FlightClass) else rule.interface
        if interface is not None:
            inner = f"{field}.interface"
            faults += _interface_faults(inner, interface, base_directory, is_lockstep=is_lockstep)
            flown = [
                {"name": agent, "index": str(index), "satellite": satellite}
                for index, (agent, satellite) in enumerate(names)
                if flight_of(parameters, agent, satellite) is rule
            ]
            transport = f"{inner}.transport"
            faults += address_faults(transport, interface.transport, flown, base_directory)
            if interface.protocol in ("frames", "space_packets"):
                faults += _setting_faults(f"{field}.settings", rule.settings)
    return faults


def rate_faults(parameters: ConstellationParameters, tick_hz: float) -> list[str]:
    """Return rates that have no place among the ticks, such as flight software's without a whole ratio; none are judged without theirs."""
    faults = []
    state_hz = parameters.record.state_hz
    if state_hz is not None and 0.0 < tick_hz < state_hz:
        faults.append(
            f"parameters.record.state_hz: expected at most agents.tick_hz, {tick_hz:g} Hz, got {state_hz:g}: a tick"
            " has one state; leave it out for every tick"
        )
    for number, rule in enumerate(flight_rules(parameters) if tick_hz > 0.0 else ()):
        try:
            flight_rate(rule.rate_hz, tick_hz)
        except ValueError as error:
            place = f"[{number}]" if isinstance(parameters.flight, tuple) else ""
            faults.append(f"parameters.flight{place}.rate_hz: {error}")
    return faults


def _software_faults(field: str, rule: FlightRule, base_directory: Path) -> list[str]:
    if isinstance(rule, FlightClass):
        return code_faults(f"{field}.software", rule.software, base_directory, forbidden=WALL)
    if isinstance(rule, FlightAttached):
        if isinstance(rule.interface.transport, StdioTransport):
            return [f"{field}.interface.transport: stdio is that of a program; give its command"]
        return []
    return [
        *_program_faults(f"{field}.command", rule.command[0], base_directory),
        *_substitution_faults(field, rule),
    ]


def _program_faults(field: str, program: str, base_directory: Path) -> list[str]:
    """Return what is wrong with a program; an absolute path may exist on the boards alone, one with ${...} is another for each."""
    if Path(program).is_absolute() or "${" in program:
        return []
    if find_program((program,), base_directory) is not None:
        return []
    path = base_directory / program
    if os.path.isfile(path):
        return [f"{field}: {path} is not executable; chmod +x makes it so"]
    where = base_directory if "/" in program else f"{base_directory} or on PATH"
    return [f"{field}: no program {program!r} in {where}"]


def _substitution_faults(field: str, rule: FlightProcess) -> Iterator[str]:
    is_pty = rule.interface is not None and rule.interface.transport.kind == "pty"
    known = (*NAMES, *(PLACES if is_pty else PLACES[:1]))
    for number, word in enumerate(rule.command):
        yield from substitution_faults(f"{field}.command[{number}]", word, known)
        yield from _null_faults(f"{field}.command[{number}]", word)
    for name, text in rule.environment.items():
        yield from substitution_faults(f"{field}.environment.{name}", text, known)
        yield from _null_faults(f"{field}.environment.{name}", text)
        if not name or "=" in name or "\0" in name:
            yield f"{field}.environment: expected the name of a variable, without '=' in it, got {name!r:.80}"


def _null_faults(field: str, text: str) -> Iterator[str]:
    """Yield what no program can be given."""
    if "\0" in text:
        yield f"{field}: expected a text without null characters, got {text!r:.80}"


def _interface_faults(
    field: str, interface: FlightInterface, base_directory: Path, *, is_lockstep: bool
) -> list[str]:
    faults = []
    if interface.protocol not in PROTOCOLS:
        if ":" not in interface.protocol:
            expected = ", ".join(PROTOCOLS)
            faults.append(
                f"{field}.protocol: expected {expected} or file.py:Class, got {interface.protocol!r}"
            )
        else:
            faults += code_faults(
                f"{field}.protocol", interface.protocol, base_directory, forbidden=WALL
            )
    if interface.clock == "own" and is_lockstep and not is_played_back(interface):
        faults.append(
            f"{field}.clock: software with a clock of its own cannot wait for simulated time; take "
            "time.mode: realtime, or clock: stepped for software that answers each tick"
        )
    return faults


def _setting_faults(field: str, settings: Mapping[str, Setting]) -> Iterator[str]:
    """Yield settings that fixed structs would cut: two long names could become one."""
    for name, given in settings.items():
        if len(name.encode()) > (most := SETTING_BYTES_MAX["name"]):
            yield f"{field}: expected names of at most {most} bytes for this protocol, got {name!r:.80}"
        most = SETTING_BYTES_MAX["text"]
        for value in given if isinstance(given, list) else [given]:
            if isinstance(value, str) and len(value.encode()) > most:
                yield f"{field}.{name}: expected a text of at most {most} bytes for this protocol, got {value!r:.80}"
            if isinstance(value, int) and int(float(value)) != value:
                yield (
                    f"{field}.{name}: expected a number that this protocol's 64-bit float holds, got {value}: write it as"
                    " a text in quotes"
                )
