"""
Words that choose what is compared, --agents and --streams: each has to choose something.

One that is misspelt would pass for runs without a difference. Of scenarios that are run for it this is known before the
first starts, as far as the names of their streams are.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Iterator, Sequence

from cosmos_cli.diff.compare import Selection
from cosmos_cli.diff.side import Side
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.declared_streams import every_stream
from cosmos_cli.models.document import did_you_mean
from cosmos_cli.models.known_streams import REAL_TIME_ONLY
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.ui.name_ranges import compact
from madns_runtime.recording.records import FRAMEWORK_STREAMS

SIGNS = "*?[."
"""Of a glob, and between a device and its channel: a word with one of them may be of a device."""
Agents = tuple[AgentLabels, Sequence[str]]


def check_chosen(sides: Sequence[Side], selection: Selection) -> None:
    """
    Refuse a word that chooses nothing of recorded runs.

    Raises:
        InputError: There is one.
    """
    if selection.agents:
        agents = [(run_labels(side.run), side.agents) for side in sides]
        _check_agents(selection.agents, agents, "these runs")
    names = {name for side in sides for name in side.stream_names}
    _check_streams(selection.streams, names, "these runs recorded")


def check_will_be_chosen(scenarios: Sequence[ScenarioFile], selection: Selection) -> None:
    """
    Refuse a word that will choose nothing of the runs of these scenarios.

    A stream that nobody declares, or of a device, may be recorded all the same: what could be one is left to `check_chosen`.

    Raises:
        InputError: There is one.
    """
    agents = [(each.labels, each.scenario.agents.resolved_names()) for each in scenarios]
    _check_agents(selection.agents, agents, "these scenarios")
    if any(each.streams is None for each in scenarios):
        return
    settings = [each.scenario.hardware for each in scenarios]
    has_devices = any(each.devices or each.use for each in settings)
    globs = [g for g in selection.streams if not (has_devices and any(sign in g for sign in SIGNS))]
    names = {name for each in scenarios for name in _names_of(each)}
    _check_streams(globs, names, "these scenarios record")


def _names_of(scenario: ScenarioFile) -> Iterator[str]:
    """Give the names of all streams that a run may record, but devices', as streams and as tables."""
    is_lockstep = scenario.scenario.time.is_lockstep
    for name in FRAMEWORK_STREAMS:
        if not (is_lockstep and name in REAL_TIME_ONLY):
            yield from (name, f"host_{name}", f"machine_{name}")
    for stream in every_stream(scenario.streams or (), scenario.agent_streams):
        yield stream.name
        if stream.role == "host":
            yield f"host_{stream.name}"


def _check_agents(globs: Iterable[str], agents: Sequence[Agents], where: str) -> None:
    for glob in globs:
        if not any(labels.like(glob, names) for labels, names in agents):
            known = compact(dict.fromkeys(name for _, names in agents for name in names))
            raise InputError(
                f"--agents {glob}: no agent of {where} is called so; there are {known}"
            )


def _check_streams(globs: Iterable[str], known: Iterable[str], whose: str) -> None:
    names = sorted(known)
    for glob in globs:
        if not fnmatch.filter(names, glob):
            hint = did_you_mean(glob, names)
            raise InputError(f"--streams {glob}: {whose} no such stream{hint}")
