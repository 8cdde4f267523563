"""Faults in the channels of devices that a simulation's parameters name, as far as no inventory is needed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from cosmos_cli.errors import Fault
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.device_kinds import KindAnswer
from cosmos_cli.models.document import Document, did_you_mean
from cosmos_cli.models.fault_place import fault_found_at
from cosmos_cli.models.scenario import Scenario
from madns_runtime.hardware.contract import Channel
from madns_runtime.hardware.units import unit_fault
from madns_runtime.plain_values import first_few
from madns_runtime.plugin.api import DeviceUse

AGENTS_NAMED_MAX = 3


def use_faults(
    document: Document,
    scenario: Scenario,
    labels: AgentLabels,
    answers: Sequence[KindAnswer],
    uses: Sequence[DeviceUse],
) -> list[Fault]:
    """
    Return the faults, one per parameter and reason.

    Args:
        document: The scenario's.
        scenario: What it says.
        labels: Second names of agents.
        answers: Of the kinds of the scenario's own devices, in their order.
        uses: Channels that the simulation's parameters name.
    """
    given = _devices_by_agent(scenario, labels, answers)
    agents_of: dict[tuple[str, str], dict[str, None]] = {}
    for use in uses:
        text = _fault(use, given.get(use.agent, {}), is_armed=scenario.hardware.armed)
        if text is not None:
            agents_of.setdefault((use.field, text), {})[use.agent] = None
    return [
        fault_found_at(document, f"{field}: {text} (of {named_agents(tuple(agents))})")
        for (field, text), agents in agents_of.items()
    ]


def _devices_by_agent(
    scenario: Scenario, labels: AgentLabels, answers: Sequence[KindAnswer]
) -> dict[str, dict[str, KindAnswer | None]]:
    """Return each agent's devices with what their kinds say; None for those of the inventory."""
    names = scenario.agents.resolved_names()
    given: dict[str, dict[str, KindAnswer | None]] = {name: {} for name in names}
    for use in scenario.hardware.use:
        for agent in labels.like_any(use.agents, names):
            given[agent].update(dict.fromkeys(use.devices))
    for device, answer in zip(scenario.hardware.devices, answers, strict=True):
        for agent in labels.like_any(device.agents, names):
            given[agent][device.name] = answer
    return given


def _fault(
    use: DeviceUse, devices: Mapping[str, KindAnswer | None], *, is_armed: bool
) -> str | None:
    """Return what is wrong with one use; None if nothing is, or nobody can tell yet."""
    if use.device not in devices:
        known = ", ".join(devices) or "none"
        return (
            f"expected a device that the agent uses ({known}), got {use.device!r}"
            f"{did_you_mean(use.device, tuple(devices))}; hardware.use or hardware.devices gives it one"
        )
    if use.direction == "out" and not is_armed:
        return "an output moves only with hardware.armed: true"
    answer = devices[use.device]
    if answer is None or not answer.channels:
        return None  # the agent looks again when it is set up
    fitting = {each.name: each for each in answer.channels if each.direction == use.direction}
    channel = fitting.get(use.channel)
    if channel is None:
        way = "input" if use.direction == "in" else "output"
        hint = did_you_mean(use.channel, tuple(fitting))
        return f"{use.device} has no {way} {use.channel!r}{hint}"
    return next(_channel_faults(use, channel), None)


def _channel_faults(use: DeviceUse, channel: Channel) -> Iterator[str]:
    name = f"{use.device}.{use.channel}"
    if use.size is not None and (channel.is_frame or channel.size != use.size):
        got = "frames of bytes" if channel.is_frame else str(channel.size)
        yield f"{name}: expected values of {use.size} number{'s' * (use.size > 1)}, got {got}"
    elif use.unit is not None and (wrong := unit_fault(channel.unit, use.unit)):
        yield f"{name}: {wrong}"


def named_agents(agents: Sequence[str]) -> str:
    """Return the first of some agents' names, and how many more there are."""
    return first_few(agents, AGENTS_NAMED_MAX)
