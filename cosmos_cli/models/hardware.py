"""Faults in the devices of a scenario, as far as that can be told without an inventory."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosmos_cli.errors import Fault
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.device_kinds import DeviceQuestion, KindAnswer, ask_kinds
from cosmos_cli.models.device_uses import use_faults
from cosmos_cli.models.document import Document, did_you_mean
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.known_streams import KnownDevice, channel_fields
from cosmos_cli.models.scenario import Scenario, SectionFault
from cosmos_cli.models.text_forms import RECORDED_NAME
from madns_runtime.config import ScenarioDevice
from madns_runtime.plugin.api import DeviceUse

NOT_IN_LOCKSTEP = (
    "time.mode: lockstep runs without machines of an inventory, whose devices follow the wall clock: leave out"
    " hardware.use, or run with time.mode: realtime"
)


def hardware_faults(
    document: Document,
    scenario: Scenario,
    base_directory: Path,
    *,
    labels: AgentLabels | None,
    uses: Sequence[DeviceUse],
) -> tuple[list[Fault], tuple[KnownDevice, ...]]:
    """
    Return what is wrong with a scenario's section `hardware`, and the devices whose streams rules may name.

    Args:
        document: The scenario's.
        scenario: What it says.
        base_directory: Its folder.
        labels: Second names of agents; None if they are not known, and then agents are not looked for.
        uses: Channels that the simulation's parameters name.
    """
    devices = scenario.hardware.devices
    paths: list[ValuePath] = [("hardware", "devices", index) for index in range(len(devices))]
    answers = ask_kinds(
        [
            DeviceQuestion(
                path=path,
                kind=device.kind,
                parameters=device.parameters,
                base_directory=base_directory,
            )
            for path, device in zip(paths, devices, strict=True)
        ],
        document,
        limit_s=scenario.timeouts.loading_s,
    )
    faults = [fault for answer in answers for fault in answer.faults]
    found: list[SectionFault] = []
    for path, device, answer in zip(paths, devices, answers, strict=True):
        if not RECORDED_NAME.fullmatch(device.name):
            text = (
                "expected a name such as sense_hat: at most 64 letters, digits, '.', '_' and '-', of which the first is a"
                f" letter or a digit; got {device.name!r:.80}"
            )
            found.append(((*path, "name"), text))
        if not answer.faults:
            found += device_faults(path, device, answer, is_lockstep=scenario.time.is_lockstep)
            found += _missing_files(path, device, answer, base_directory)
    if scenario.hardware.use and scenario.time.is_lockstep:
        found.append((("hardware", "use"), NOT_IN_LOCKSTEP))
    if labels is not None:
        found += _agents(scenario, labels)
        faults += use_faults(document, scenario, labels, answers, uses)
    faults += [document.fault(path, text) for path, text in found]
    return faults, _known_devices(scenario, labels, answers)


def _known_devices(
    scenario: Scenario, labels: AgentLabels | None, answers: Sequence[KindAnswer]
) -> tuple[KnownDevice, ...]:
    names = scenario.agents.resolved_names()
    own = [
        KnownDevice(
            name=device.name,
            sources=None
            if labels is None
            else tuple(f"{agent}/{device.name}" for agent in labels.like_any(device.agents, names)),
            streams=channel_fields(answer.channels) if answer.channels else None,
        )
        for device, answer in zip(scenario.hardware.devices, answers, strict=True)
    ]
    listed = dict.fromkeys(name for use in scenario.hardware.use for name in use.devices)
    return (*own, *(KnownDevice(name=name, sources=None, streams=None) for name in listed))


def device_faults(
    path: ValuePath, device: ScenarioDevice, answer: KindAnswer, *, is_lockstep: bool
) -> Iterator[SectionFault]:
    """Yield what does not fit between a device of a scenario and its kind."""
    if answer.needs_hardware:
        text = (
            f"{device.kind} is bound to a machine: list it in cosmos_devices of the inventory,"
            " and under hardware.use here"
        )
        yield (*path, "kind"), text
    elif is_lockstep and not answer.follows_simulated_time:
        text = f"{device.kind} follows the wall clock, and time.mode lockstep does not: use playback or synthetic there"
        yield (*path, "kind"), text
    if device.rate_hz is not None and device.rate_hz > answer.rate_hz_max:
        text = f"expected <= {answer.rate_hz_max:g} ({device.kind}), got {device.rate_hz:g}"
        yield (*path, "rate_hz"), text
    for name in device.frozen_s:
        if name not in answer.inputs:
            hint = did_you_mean(name, answer.inputs)
            yield (*path, "frozen_s", name), f"{device.kind} has no input {name!r}{hint}"


def _missing_files(
    path: ValuePath, device: ScenarioDevice, answer: KindAnswer, base_directory: Path
) -> Iterator[SectionFault]:
    """Yield files of the scenario's folder that are not there; an absolute path may be another machine's."""
    for name in answer.files:
        given = device.parameters.get(name)
        if not isinstance(given, str) or Path(given).is_absolute():
            continue
        file = base_directory / given
        if not os.path.isfile(file):
            has_recipe = os.path.isfile(file.parent / "Makefile")
            hint = f"make -C {file.parent} builds it" if has_recipe else "build it first"
            yield (*path, "parameters", name), f"no file {file}; {hint}"


def agent_faults(
    path: ValuePath, patterns: Sequence[str], names: Sequence[str], labels: AgentLabels
) -> Iterator[SectionFault]:
    """Yield a fault per pattern that finds no agent."""
    for place, pattern in enumerate(patterns):
        if not labels.like(pattern, names):
            yield (*path, place), f"no agent is named {pattern}{did_you_mean(pattern, names)}"


def _agents(scenario: Scenario, labels: AgentLabels) -> Iterator[SectionFault]:
    """Yield what is wrong with the names of agents, and devices of one agent that share a name."""
    names = scenario.agents.resolved_names()
    if len(names) != scenario.agents.count:
        return  # told already, and what the names mean is open
    for index, use in enumerate(scenario.hardware.use):
        path: ValuePath = ("hardware", "use", index)
        yield from agent_faults((*path, "agents"), use.agents, names, labels)
        users = labels.like_any(use.agents, names)
        if use.owner and use.owner not in users:
            hint = did_you_mean(use.owner, users)
            text = f"expected one of the agents that may use it, got {use.owner!r}{hint}"
            yield (*path, "owner"), text
    taken: dict[tuple[str, str], int] = {}
    for index, device in enumerate(scenario.hardware.devices):
        path = ("hardware", "devices", index)
        yield from agent_faults((*path, "agents"), device.agents, names, labels)
        for agent in labels.like_any(device.agents, names):
            first = taken.setdefault((agent, device.name), index)
            if first != index:
                text = f"{agent} has a device {device.name!r} already (hardware.devices[{first}]): name one otherwise"
                yield (*path, "name"), text
                break
