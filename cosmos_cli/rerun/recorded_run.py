"""A recorded run as a rerun needs it: its settings, its agents' ticks, and the devices that each of them used."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from cosmos_cli.collect.finished_run import collected_document
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.completeness import ended_on_purpose
from cosmos_cli.evidence.devices import expected_devices
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import file_size_bytes
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.evidence.tables import open_tables
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.analysis.tables import RecordedRun
from madns_runtime.config import RunConfig
from madns_runtime.errors import MadnsError
from madns_runtime.hardware.kinds.playback import streams_of
from madns_runtime.plain_values import first_few, mapping_at
from madns_runtime.recording.reader import read_stream
from madns_runtime.timing.rate import count_ticks

FAULTS_SHOWN_MAX: Final = 10
TICK_FIELDS: Final = 4
"""Of a record of ticks: tick, lateness, margin, missed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UsedDevice:
    """One device as one agent used it."""

    agent: str
    name: str
    """As agents know it, such as imu."""
    full_name: str
    """In the records, such as pi22/imu."""
    folder: Path
    """Of its records."""
    may_write: bool
    """Whether this agent may have moved its outputs: what they were given is compared with what they are given now."""
    given: int | None = None
    """Place among the scenario's own devices; None for one of the inventory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedAgent:
    """The ticks of one agent."""

    ticks: Path | None
    """Its stream of ticks; None in lockstep, which is always on time, and of one that was killed before it wrote any."""
    phase_s: float = 0.0
    last_s: float = 0.0
    """Nominal time of its last tick, s; negative of one that was killed before it wrote any."""
    last_wake_s: float = 0.0
    """When that woke up, simulated, s."""
    missed: int = 0
    """Ticks that were skipped."""
    under_way: tuple[tuple[float, float], ...] = ()
    """When each tick woke up and when its step ended, simulated, s: it looked at its devices in between."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownRun:
    """A recorded run, as far as a rerun is made of it."""

    run: RunDirectory
    config: RunConfig
    agents: Mapping[str, RecordedAgent]
    devices: tuple[UsedDevice, ...]
    is_cut_off: bool = False
    """Whether it was in real time and did not complete: its agents need not have ended with the same tick."""
    cut_s: float | None = None
    """Simulated time at which one in lockstep was interrupted, or its host killed, s; None of any other."""
    killed: frozenset[str] = frozenset()
    """Agents of a run in real time that a fault ended for good: what they had not written yet is on no record."""

    @property
    def folder(self) -> Path:
        """The scenario's folder, as it is today."""
        return Path(self.config.base_directory)


def read_recorded_run(run: RunDirectory, given: str, as_recorded: Path | None) -> FlownRun:
    """
    Read what a rerun needs.

    Args:
        run: The run.
        given: What a person called it, for advice.
        as_recorded: A copy of its scenario's folder as it was; None for the folder as it is today.

    Raises:
        InputError: It cannot be flown again; the text says why, and what to do.
    """
    collected_document(run, given)
    config = run.read_config()
    if config is None:
        raise InputError(
            f"{run.plan_json}: expected the run's settings under config, found none that can be read;"
            f" without them {run.name} cannot be flown again"
        )
    if as_recorded is not None:
        config = dataclasses.replace(config, base_directory=str(as_recorded.resolve()))
    if not os.path.isdir(config.base_directory):  # or may not be looked at
        raise InputError(
            f"{run.name}: the scenario's folder {clean_line(config.base_directory)} is not there;"
            " put it back, fly the run's own copy with --as-recorded, or name another with --as-recorded-from DIR"
        )
    plan = run.read_json(run.plan_json) or {}
    names = config.agents.resolved_names()
    faults: list[str] = []
    agents = {}
    killed, cut_s = _killed(run, config), _cut_s(run, config)
    for name in names:
        try:
            agents[name] = (
                _in_lockstep(run, config, cut_s)
                if config.time.is_lockstep
                else _read_agent(run.path / "agents" / name, config, is_killed=name in killed)
            )
        except InputError as error:
            faults.append(str(error))
    if not faults and all(agent.last_s < 0.0 for agent in agents.values()):
        faults.append("every agent was killed before any of its ticks was written")
    devices = tuple(_devices(run, config, plan, faults))
    if faults:
        told = first_few(faults, FAULTS_SHOWN_MAX, "; ")
        raise InputError(f"{run.name} cannot be flown again: {told}")
    status = (run.read_json(run.run_json) or {}).get("status")
    is_cut_off = not config.time.is_lockstep and status != "complete"
    return FlownRun(
        run=run,
        config=config,
        agents=agents,
        devices=devices,
        is_cut_off=is_cut_off,
        cut_s=cut_s,
        killed=killed,
    )


def _killed(run: RunDirectory, config: RunConfig) -> frozenset[str]:
    """Return the agents of a run in real time that a fault ended, by what its host told."""
    if config.time.is_lockstep:
        return frozenset()
    told = mapping_at(run.read_json(run.result_json), "agents")
    return frozenset(str(name) for name in told if ended_on_purpose(mapping_at(told, name)))


def scenario_folder(run: RunDirectory) -> Path | None:
    """Return the folder of a run's scenario; None if it is not known, or not there any more."""
    config = run.read_config()
    folder = Path(config.base_directory) if config is not None else None
    return folder if folder is not None and os.path.isdir(folder) else None


def _cut_s(run: RunDirectory, config: RunConfig) -> float | None:
    """Return when a run in lockstep was cut off, simulated, s; None if nothing from outside ended it."""
    if not config.time.is_lockstep:
        return None
    document = run.read_json(run.run_json) or {}
    status = document.get("status")
    if status != "interrupted":
        has_no_result = run.read_json(run.result_json) is None
        is_of_operator = document.get("who") == "operator"  # whose terminal was closed, say
        if status not in ("failed", "aborted") or not (has_no_result or is_of_operator):
            return None
    tables = open_tables(run.tables)
    return RecordedRun(document=document, tables=tables, config=config).end_s


def _in_lockstep(run: RunDirectory, config: RunConfig, cut_s: float | None) -> RecordedAgent:
    """Return an agent whose ticks were on time; of a run that was cut off up to the last that was surely whole, and answered."""
    tick_hz = config.agents.tick_hz
    document = run.read_json(run.run_json) or {}
    duration_s = RecordedRun(document=document, tables={}, config=config).duration_s
    ticks = max(count_ticks(duration_s, tick_hz), 1)
    if cut_s is not None:
        ticks = max(min(ticks, math.floor(cut_s * tick_hz) - 1), 1)
    last_s = (ticks - 1) / tick_hz
    return RecordedAgent(ticks=None, last_s=last_s, last_wake_s=last_s)


def _read_agent(folder: Path, config: RunConfig, *, is_killed: bool) -> RecordedAgent:
    """
    Read an agent's ticks in real time; one that a fault killed may have written none.

    Raises:
        InputError: They are not there, or the agent was started anew.
    """
    name, ticks = folder.name, folder / "ticks.jsonl"
    if any(folder.glob("ticks.[0-9]*.jsonl")):
        raise InputError(
            f"{name} was lost and started anew, which lockstep cannot repeat; rerun a run in which it lived"
        )
    if is_killed and file_size_bytes(ticks) == 0:
        return _without_ticks(config)
    try:
        stream = read_stream(ticks)
        rows = [row for row in stream.records() if len(row) >= TICK_FIELDS]
        phase_s = _phase_of(folder)
    except (MadnsError, OSError, ValueError, TypeError) as error:
        raise InputError(f"{name}: its ticks cannot be read: {error}") from error
    if not rows and is_killed:
        return _without_ticks(config)
    if not rows:
        raise InputError(f"{name}: {ticks}: expected its ticks, found none")
    if not all(map(_is_tick, rows)):
        raise InputError(f"{name}: {ticks}: expected whole numbers in every record")
    last_s = rows[-1][0] / config.agents.tick_hz
    return RecordedAgent(
        ticks=ticks,
        phase_s=phase_s,
        last_s=last_s,
        last_wake_s=last_s + phase_s + rows[-1][1] * 1e-6,
        missed=sum(row[3] for row in rows),
        under_way=tuple(_under_way(rows, config.agents.tick_hz, phase_s)),
    )


def _without_ticks(config: RunConfig) -> RecordedAgent:
    """Return an agent that wrote no tick: its last one would have come before time zero."""
    last_s = -1.0 / config.agents.tick_hz
    return RecordedAgent(ticks=None, last_s=last_s, last_wake_s=last_s)


def _is_tick(row: object) -> bool:
    return isinstance(row, list) and all(type(value) is int for value in row[:TICK_FIELDS])


def _under_way(
    rows: Sequence[Sequence[int]], tick_hz: float, phase_s: float
) -> Iterator[tuple[float, float]]:
    for tick, lateness_us, margin_us, *_ in rows:
        due_s = tick / tick_hz + phase_s
        yield due_s + lateness_us * 1e-6, due_s + 1.0 / tick_hz - margin_us * 1e-6


def _phase_of(folder: Path) -> float:
    """Return by how much an agent's ticks were due behind their nominal times, s."""
    for event in read_stream(folder / "events.jsonl").records():
        if isinstance(event, Mapping) and event.get("event") == "phase":
            return float(event.get("phase_s", 0.0))
    return 0.0


def _devices(
    run: RunDirectory, config: RunConfig, plan: Mapping[str, Any], faults: list[str]
) -> Iterator[UsedDevice]:
    """Yield the devices of each agent; enter those without records in *faults*."""
    names, labels = config.agents.resolved_names(), run_labels(run)
    agents_of = {
        str(machine): [
            str(agent) for agent in mapping_at(plan, "machines", machine).get("agents", ())
        ]
        for machine in mapping_at(plan, "machines")
    }
    for full_name in expected_devices(plan):
        place, _, name = full_name.rpartition("/")
        if clean_line(full_name) != full_name or {place, name} & {"", ".", ".."} or "/" in place:
            faults.append(f"{clean_line(full_name)}: plan.json names no device so")
            continue
        folder = run.path / "devices" / place / name
        try:
            found = streams_of(folder)
        except (MadnsError, OSError, KeyError, TypeError) as error:
            faults.append(f"{clean_line(full_name)}: its records cannot be read: {error}")
            continue
        if not found:
            faults.append(
                f"{clean_line(full_name)}: no records of it in {folder}; fetch them with: cosmos collect {run.shell_path}"
            )
            continue
        own = (
            number
            for number, device in enumerate(config.hardware.devices)
            if device.name == name and place in labels.like_any(device.agents, names)
        )
        if (given := next(own, None)) is not None:
            yield UsedDevice(
                agent=place,
                name=name,
                full_name=full_name,
                folder=folder,
                may_write=True,
                given=given,
            )
            continue
        users: dict[str, bool] = {}
        for use in config.hardware.use:
            if name in use.devices:
                for agent in labels.like_any(use.agents, agents_of.get(place, ())):
                    users[agent] = users.get(agent, False) or use.owner == agent
        if not users:
            faults.append(f"{clean_line(full_name)}: plan.json names no agent that used it")
        for agent, is_owner in users.items():
            yield UsedDevice(
                agent=agent,
                name=name,
                full_name=full_name,
                folder=folder,
                may_write=is_owner or len(users) == 1,
            )
