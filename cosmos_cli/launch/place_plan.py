"""Whether the agents of a machine get what each of them takes of it for itself, such as a TCP port."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.models.place_uses import cure_of, shared_places

if TYPE_CHECKING:  # `cosmos validate` plans nothing, and a plan's imports would double its own
    from cosmos_cli.launch.plan import LaunchPlan


def check_places(scenario_file: ScenarioFile, plan: LaunchPlan) -> None:
    """
    Look for places that several agents of one computer would take.

    Raises:
        InputError: With every fault.
    """
    faults = [
        scenario_file.fault_of(
            f"{field}: {text} (here {computer}); {cure_of(field, scenario_file.placeholders)}"
        )
        for computer, agents in _agents_by_computer(plan)
        for field, text in shared_places(scenario_file.place_uses, agents)
    ]
    if faults:
        raise InputError(faults=faults)


def place_notes(scenario_file: ScenarioFile) -> list[str]:
    """Return what only the machines of a run can tell: places that agents must not share, but on machines of their own."""
    names = scenario_file.scenario.agents.resolved_names()
    return [
        scenario_file.fault_of(
            f"{field}: {text}; {cure_of(field, scenario_file.placeholders)}"
        ).render()
        for field, text in shared_places(scenario_file.place_uses, names)
    ]


def _agents_by_computer(plan: LaunchPlan) -> Iterator[tuple[str, list[str]]]:
    """Yield computers and their agents: all machines that are reached without a network are this one."""
    here: list[str] = []
    for planned in plan.machines:
        if planned.machine.connection == "local":
            here += planned.agents
        else:
            yield planned.name, list(planned.agents)
    if here:
        yield "this computer", here
