"""Records that a run must have, and those of them that are missing, cut or dropped. Pure but for `ExpectedRecords.read`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType
from typing import Any

from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import INCARNATION_MAX, StreamScan
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.conditions.condition import HOST
from madns_runtime.config import RunConfig
from madns_runtime.plain_values import first_few, mapping_at
from madns_runtime.recording.records import CLOCK, EVENTS, HEALTH, LOG, PROCESS, TICKS

AGENT_STREAMS = tuple(schema.name for schema in (TICKS, CLOCK, EVENTS, LOG, PROCESS))
HOST_STREAMS = tuple(schema.name for schema in (EVENTS, LOG, HEALTH))
MACHINE_STREAMS = (HEALTH.name,)
LOCKSTEP_STREAMS = (EVENTS.name, LOG.name)
"""Streams of host and agents in lockstep: there are no machines' clocks, lateness or health to record."""
FAULTS_SHOWN_MAX = 3
LOCKSTEP = "lockstep"
"""The time mode, in run.json."""
NOTHING: Mapping[str, str] = MappingProxyType({})
NO_FILES: Mapping[str, Sequence[str]] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedRecords:
    """Sources that must have recorded, and their least streams; a simulation's own are in the summaries."""

    agents: tuple[str, ...] = ()
    machines: tuple[str, ...] = ()
    devices: tuple[str, ...] = ()
    """Full names of devices."""
    agent_streams: tuple[str, ...] = AGENT_STREAMS
    host_streams: tuple[str, ...] = HOST_STREAMS
    machine_streams: tuple[str, ...] = MACHINE_STREAMS

    @classmethod
    def of(cls, config: RunConfig, machines: Iterable[str]) -> ExpectedRecords:
        """Return what a run of this configuration on these machines must have recorded."""
        agents = config.agents.resolved_names()
        return (
            cls.in_lockstep(agents)
            if config.time.is_lockstep
            else cls(agents=agents, machines=tuple(machines))
        )

    @classmethod
    def in_lockstep(cls, agents: tuple[str, ...] = ()) -> ExpectedRecords:
        """Return what a run in lockstep must have recorded."""
        return cls(agents=agents, agent_streams=LOCKSTEP_STREAMS, host_streams=LOCKSTEP_STREAMS)

    @classmethod
    def read(cls, run: RunDirectory) -> ExpectedRecords:
        """
        Return what plan.json promises; of an unreadable plan nothing but the host's own records.

        What a host and any agents must have recorded depends on the time mode, which run.json tells as well.
        """
        config, plan = run.read_config(), run.read_json(run.plan_json) or {}
        machines = plan.get("machines")
        named = machines if isinstance(machines, Mapping) else {}
        names = tuple(name for name, machine in named.items() if _has_agents(machine))
        if config:
            return cls.of(config, names)
        lockstep = is_in_lockstep(None, run.read_json(run.run_json) or {})
        return cls.in_lockstep() if lockstep else cls(machines=names)


def is_in_lockstep(config: RunConfig | None, document: Mapping[str, Any]) -> bool:
    """
    Tell whether simulated time waited for everybody.

    Args:
        config: The run's; None if its plan is lost.
        document: Its run.json, as an earlier collection left it.
    """
    return config.time.is_lockstep if config else document.get("time_mode") == LOCKSTEP


def find_missing(
    expected: ExpectedRecords,
    scans: Sequence[StreamScan],
    result: Mapping[str, Any] | None,
    unretrieved: Mapping[str, str] = NOTHING,
    of_devices: Mapping[str, Sequence[str]] = NO_FILES,
) -> list[str]:
    """
    Return one line per source whose data are not all there, each starting with its name.

    Args:
        expected: Who should have recorded what.
        scans: What is there.
        result: What the host reported; None if it could not, which is itself a gap.
        unretrieved: By machine whose records have not all come, and by agent that recorded on it, why.
            Such a machine has a line in any case: nobody else knows what it recorded beside.
        of_devices: Names of the files into which each device recorded, as far as accounts of it tell.
    """
    agents = mapping_at(result, "agents")
    faults: dict[str, list[str]] = {HOST: [] if result is not None else ["no result"]}
    found: dict[tuple[str, str], list[StreamScan]] = {}
    for scan in scans:
        found.setdefault((scan.file.role, scan.file.source), []).append(scan)
    _check_source(faults, HOST, found.get((HOST, HOST), ()), expected.host_streams, result)
    for name in expected.agents:
        own, agent = found.get(("agent", name), ()), mapping_at(agents, name)
        kept = [scan for scan in own if not is_excused(scan, agents)]
        if kept or _owes_records(agent):
            _check_source(faults, name, kept, expected.agent_streams, agent)
    for name in expected.machines:
        own = found.get(("machine", name), ())
        _check_source(faults, name, own, expected.machine_streams, None)
    for name in expected.devices:
        own = found.get(("device", name), ())
        _check_device(faults, name, own, of_devices.get(name, ()))
    _check_uninvited(faults, scans, expected)
    for name in unretrieved:
        if name not in (HOST, *expected.agents) and not faults.get(name):
            faults[name] = ["not all of its records are here"]
    causes = {**unretrieved, **_reasons(agents)}
    return [_line(name, texts, causes.get(name)) for name, texts in faults.items() if texts]


def is_excused(scan: StreamScan, agents: Mapping[str, Any]) -> bool:
    """Tell whether what a file lacks was lost on purpose: its incarnation of an agent was ended by a fault."""
    if scan.file.role != "agent":
        return False
    return scan.file.incarnation in ended_on_purpose(mapping_at(agents, scan.file.source))


def _owes_records(agent: Mapping[str, Any]) -> bool:
    """Tell whether an agent was not ended on purpose, or was started again after that."""
    ended, incarnations = ended_on_purpose(agent), agent.get("incarnations")
    return not ended or (isinstance(incarnations, int) and incarnations > max(ended))


def ended_on_purpose(agent: Mapping[str, Any] | None) -> tuple[int, ...]:
    """Return the incarnations of an agent that faults ended, by what the host's result tells of it."""
    ended = (agent or {}).get("ended_on_purpose")
    listed = ended if isinstance(ended, list | tuple) else ()
    return tuple(n for n in listed if type(n) is int and 0 < n <= INCARNATION_MAX)


def _has_agents(machine: object) -> bool:
    """Tell whether a machine of the plan records: the host's may run no agent."""
    return not isinstance(machine, Mapping) or machine.get("agents") != []


def _check_source(
    faults: dict[str, list[str]],
    name: str,
    scans: Sequence[StreamScan],
    streams: Sequence[str],
    summary: Mapping[str, Any] | None,
) -> None:
    found = faults.setdefault(name, [])
    if not scans:
        found.append("no records")
        return
    known = {scan.file.incarnation for scan in scans} | set(ended_on_purpose(summary))
    found.extend(f"no records of incarnation {n}" for n in range(1, max(known)) if n not in known)
    have = {scan.file.stream for scan in scans}
    paths = {scan.file.path.name for scan in scans}
    reported = mapping_at(summary, "records", "streams")
    for stream in dict.fromkeys((*streams, *map(str, reported))):
        counts = mapping_at(reported, stream)
        file = PurePath(str(counts.get("file", ""))).name
        if stream not in have or (file and file not in paths):
            found.append(f"{stream} is missing")
    errors = _errors_of(mapping_at(summary, "records"))
    why = f" ({errors[0]})" if errors else ""
    faulty = [_told(scan) for scan in scans if scan.fault]
    found.extend([faulty[0] + why, *faulty[1:]] if faulty else [])  # one cause, told once
    # A sampler is a process of its own: its trouble, such as having been killed, shows in its own report.
    found.extend(
        f"{HEALTH.name}: {text}" for text in _errors_of(mapping_at(summary, "records", HEALTH.name))
    )


def _check_device(
    faults: dict[str, list[str]], name: str, scans: Sequence[StreamScan], files: Sequence[str]
) -> None:
    """Judge the records of a device; one that was killed leaves them cut, which `records.truncated` counts."""
    found = faults.setdefault(name, [])
    if not scans:
        found.append("no records")
    have = {scan.file.path.name for scan in scans}
    gone = [PurePath(file).stem for file in files if scans and PurePath(file).name not in have]
    found.extend(f"{clean_line(stream)} is missing" for stream in gone)
    found.extend(_told(scan) for scan in scans if scan.fault and scan.promised is not None)


def _errors_of(report: Mapping[str, Any]) -> list[str]:
    errors = report.get("errors")
    return [str(error) for error in errors] if isinstance(errors, list | tuple) else []


def _check_uninvited(
    faults: dict[str, list[str]], scans: Sequence[StreamScan], expected: ExpectedRecords
) -> None:
    """Judge also what a source recorded that no plan names: a plan may be lost, its data are not."""
    known = {HOST, *expected.agents, *expected.machines, *expected.devices}
    for scan in scans:
        if scan.file.source not in known and scan.fault:
            faults.setdefault(scan.file.source, []).append(_told(scan))


def _reasons(agents: Mapping[str, Any]) -> dict[str, str]:
    """Return what became of agents, as far as the host knew."""
    reasons = {name: mapping_at(agents, name).get("reason") for name in agents}
    return {name: text for name, text in reasons.items() if isinstance(text, str) and text}


def _line(name: str, faults: Sequence[str], cause: str | None) -> str:
    """Say what is missing of a source, and first what happened to it if that is known."""
    return f"{name}: {f'{cause}: ' if cause else ''}{first_few(faults, FAULTS_SHOWN_MAX)}"


def _told(scan: StreamScan) -> str:
    which = f" of incarnation {scan.file.incarnation}" if scan.file.incarnation > 1 else ""
    return f"{scan.file.stream}{which} {scan.fault}"
