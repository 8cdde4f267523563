"""Second names of agents in figures: behind each agent's own, in the choice of a group and at its lines. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cosmos_cli.models.agent_labels import AgentLabels
from madns_runtime.analysis.lines import GROUP_RANGE
from madns_runtime.analysis.values import Block, Figure, Section, Series


def with_second_names(sections: Sequence[Section], labels: AgentLabels) -> list[Section]:
    """Return the sections; those of a run without second names as they are."""
    if not labels.names:
        return list(sections)
    return [
        replace(section, blocks=[_named(block, labels) for block in section.blocks])
        for section in sections
    ]


def _named(block: Block, labels: AgentLabels) -> Block:
    if not isinstance(block, Figure):
        return block
    choices = [
        replace(
            choice,
            name=GROUP_RANGE.join(map(labels.named, choice.name.split(GROUP_RANGE))),
            marks=[
                replace(mark, name=labels.named(mark.name)) if isinstance(mark, Series) else mark
                for mark in choice.marks
            ],
        )
        for choice in block.choices
    ]
    return replace(block, choices=choices)
