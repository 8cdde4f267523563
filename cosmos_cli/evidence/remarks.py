"""
Remarks of the verdict, which decide nothing. Pure.

On processors that kernels did not grant, on calls of the host's half that held its loop for long, on messages that
their receivers had no room for, and on records that a simulation did not declare.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cosmos_cli.evidence.plugin_checks import check_fault, listed_checks
from cosmos_cli.evidence.streams import StreamScan
from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.models.declared_streams import AgentStreams, DeclaredStreams
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.config import from_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.medium.carrier import KEPT_MAX
from madns_runtime.medium.mailbox import HELD_MAX
from madns_runtime.plain_values import mapping_at
from madns_runtime.plugin.api import DeclaredStream
from madns_runtime.protocol.link_settings import LinkLimits
from madns_runtime.protocol.sending import MESSAGES_QUEUED_MAX
from madns_runtime.recording.records import FRAMEWORK_STREAMS, Field

REMARKS_MAX = 20
QUEUE_MIB = LinkLimits().send_queue_bytes_max // 2**20
"""Room for what waits to be sent to one agent, MiB."""
NOT_DECLARED = "not declared by the simulation's streams()"


def result_remarks(
    result: Mapping[str, Any], summaries: Mapping[str, Mapping[str, Any]]
) -> tuple[str, ...]:
    """
    Return the remarks on what the host tells of itself, of its half and of the agents.

    Args:
        result: The host's.
        summaries: Of the halves, by who made them.
    """
    return (
        *affinity_remarks(mapping_at(result, "agents")),
        *long_call_remarks(mapping_at(result, "host_calls")),
        *mailbox_remarks(mapping_at(result, "between_agents")),
        *malformed_check_remarks(summaries),
    )


def mailbox_remarks(account: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the remarks on messages between agents that no medium lost and nobody received; none if there were none."""
    no_room, unqueued = mapping_at(account, "receivers").get("no_room"), account.get("unqueued")
    remarks = []
    if is_number(no_room) and no_room > 0:
        remarks.append(
            f"between agents: {counted(int(no_room), 'message')} found no room at their receivers, each of which holds"
            f" {HELD_MAX} until their times: they were dropped, though delivered"
        )
    if is_number(unqueued) and unqueued > 0:
        remarks.append(
            f"between agents: the queues to their receivers had no room for {counted(int(unqueued), 'message')}, as"
            f" {QUEUE_MIB} MiB or {MESSAGES_QUEUED_MAX} messages waited in them, or {KEPT_MAX} in all were on their way:"
            " send less at once, or smaller ones"
        )
    return tuple(remarks)


def malformed_check_remarks(summaries: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """Return a remark for each kind of malformed check in summaries, with who returned it; at most REMARKS_MAX."""
    found: dict[str, list[str]] = {}
    for who, summary in summaries.items():
        for fault in map(check_fault, listed_checks(summary)):
            if fault:
                found.setdefault(fault, []).append(who)
    remarks = (f"{compact(names)}: checks of finish(): {fault}" for fault, names in found.items())
    return tuple(itertools.islice(remarks, REMARKS_MAX))


def affinity_remarks(agents: Mapping[str, Any]) -> tuple[str, ...]:
    """
    Return a remark for each reason for which processors were refused, with the agents that it was so for.

    Args:
        agents: What the host's result holds of each agent.
    """
    refused: dict[str, list[str]] = {}
    for name in agents:
        refusal = mapping_at(agents, name, "scheduling").get("cpu_affinity_refusal")
        if isinstance(refusal, str):
            refused.setdefault(refusal, []).append(name)
    return tuple(
        f"{compact(names)}: scheduling.cpu_affinity: {refusal}"
        for refusal, names in refused.items()
    )


def long_call_remarks(account: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the remark on long calls, none if there were none."""
    longest = longest_call(account)
    count = account.get("long")
    if longest is None or not is_number(count) or not count:
        return ()
    method, took_s, t_s = longest
    when = f" at t = {t_s:.3g} s" if is_number(t_s) else ""
    limit_ms = float(account.get("limit_s") or 0.0) * 1e3
    return (
        f"host: {counted(int(count), 'call')} of the plug-in held its loop for more than {limit_ms:g} ms,"
        f" the longest {method} for {took_s:.3g} s{when}: everybody's messages waited; hand long work to"
        " context.submit",
    )


def longest_call(account: Mapping[str, Any]) -> tuple[str, float, object] | None:
    """Return the method, the time, s, and the simulated time of the longest call; None for none."""
    methods = mapping_at(account, "methods")
    entries = [(name, mapping_at(methods, name)) for name in methods]
    known = [(name, e["longest_s"], e.get("longest_t_s")) for name, e in entries if _is_timed(e)]
    return max(known, key=lambda entry: entry[1], default=None)


def _is_timed(entry: Mapping[str, Any]) -> bool:
    return is_number(entry.get("longest_s"))


def declared_streams(plan: Mapping[str, Any] | None) -> DeclaredStreams | None:
    """Return what plan.json keeps of a simulation's declaration; None if it has none."""
    listed, of_agents = (plan or {}).get("streams"), (plan or {}).get("agent_streams", [])
    if not isinstance(listed, list) or not isinstance(of_agents, list):
        return None
    try:
        return DeclaredStreams(
            of_all=tuple(from_mapping(DeclaredStream, item) for item in listed),
            of_agents=tuple(from_mapping(AgentStreams, item) for item in of_agents),
        )
    except ConfigurationError:
        return None


def undeclared_remarks(
    declared: DeclaredStreams | None, scans: Sequence[StreamScan]
) -> tuple[str, ...]:
    """
    Return a remark per fault, naming who recorded it; at most REMARKS_MAX, and how many more there are.

    Args:
        declared: By the simulation; None judges nothing.
        scans: Of all streams; one without a schema line is told elsewhere.
    """
    if declared is None:
        return ()
    sources: dict[str, list[str]] = {}
    for scan in scans:
        file = scan.file
        if (
            file.role in ("machine", "device")
            or file.stream in FRAMEWORK_STREAMS
            or not file.fields
        ):
            continue
        known = declared.stream_of(file.role, file.stream, file.source)
        for fault in _faults(known, file.fields):
            sources.setdefault(f"stream {file.stream}{fault}", []).append(file.source)
    remarks = [f"{_named(names)}: {fault}" for fault, names in sources.items()]
    more = len(remarks) - REMARKS_MAX
    if more > 0:
        remarks[REMARKS_MAX:] = [f"{counted(more, 'more fault')} of streams {NOT_DECLARED}"]
    return tuple(remarks)


def _faults(declared: DeclaredStream | None, fields: Sequence[Field]) -> Iterator[str]:
    if declared is None:
        yield f" is {NOT_DECLARED}"
        return
    known = {field.name: field for field in declared.fields}
    for field in fields:
        expected = known.pop(field.name, field if declared.is_open else None)
        if expected is None:
            yield f": field {field.name} is {NOT_DECLARED}"
        elif (field.unit, field.kind) != (expected.unit, expected.kind):
            yield f": field {field.name} is {_told(field)} where {_told(expected)} is declared"
    for name in known:
        yield f": field {name} is declared and not recorded"


def _told(field: Field) -> str:
    return f"{field.kind} in {field.unit}" if field.unit else field.kind


def _named(names: Sequence[str]) -> str:
    different = list(dict.fromkeys(names))
    more = f" and {len(different) - 1} more" if len(different) > 1 else ""
    return f"{different[0]}{more}"
