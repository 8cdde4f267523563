"""run.json: what is promised to scripts, put together from evidence. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import orjson

from cosmos_cli.expectation import Expected, mapping_at
from cosmos_cli.packets import SERVICES, duplicates_by_service, packet_counts
from cosmos_cli.problem import Problem
from cosmos_cli.refusals import affinity_remarks
from cosmos_cli.rundir import SCHEMA
from cosmos_cli.statistics import TickStatistics, TickTotals, tick_totals
from cosmos_cli.streams import StreamScan
from cosmos_cli.verdict import Facts, Limits, Verdict, is_number, judge, plugin_checks
from madns_runtime.config import RunConfig

TICKS_OF_A_RATE = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """All that a summary is made of."""

    run: str
    started: Mapping[str, Any]
    """run.json as it was written at the start, or as it is."""
    config: RunConfig | None
    expected: Expected
    result: Mapping[str, Any] | None
    """What the host reported; None if it could not."""
    scans: Sequence[StreamScan]
    ticks: TickStatistics
    round_trip_ms: Mapping[str, Any] = field(default_factory=dict)
    clock: Mapping[str, float] = field(default_factory=dict)
    host_machine: str | None = None
    """Where the host was; None when it was this computer."""
    interrupted: bool = False
    problems: tuple[Problem, ...] = ()
    missing: tuple[str, ...] = ()

    def judged(self) -> tuple[Verdict, dict[str, Any]]:
        """Return the verdict and run.json."""
        totals = self._totals()
        verdict = judge(self._facts(totals), self._limits())
        return verdict, _plain(self._document(verdict, totals))

    def _totals(self) -> TickTotals:
        agents = mapping_at(self.result, "agents")
        names = tuple(dict.fromkeys((*self.expected.agents, *self.ticks.agents)))
        due_each = None
        if self.config is not None and self.result and self.result.get("status") == "complete":
            due_each = int(self.config.time.duration_s * self.config.agents.tick_hz)
        counters = {name: mapping_at(agents, name, "ticks") for name in names}
        return tick_totals(self.ticks.agents, counters, agents=names, due_each=due_each)

    def _limits(self) -> Limits:
        if self.config is None:
            return self._limits_before()
        return Limits(
            miss_ratio_max=self.config.deadline.max_miss_ratio,
            rtf_tolerance=self.config.time.rtf_tolerance,
            duration_s=self.config.time.duration_s,
        )

    def _limits_before(self) -> Limits:
        """Return the limits of an earlier verdict: the plan is lost. Those it does not tell are the defaults."""
        listed = self.started.get("checks")
        checks = [c for c in listed if isinstance(c, Mapping)] if isinstance(listed, list) else []
        told = {c.get("name"): c["limit"] for c in checks if is_number(c.get("limit"))}
        default = Limits()
        return Limits(
            miss_ratio_max=told.get("deadline.miss_ratio", default.miss_ratio_max),
            rtf_tolerance=told.get("time.rtf", default.rtf_tolerance),
        )

    def _facts(self, totals: TickTotals) -> Facts:
        result = self.result or {}
        messages = mapping_at(result, "messages")
        return Facts(
            host_status=_text(result.get("status")),
            who=_text(result.get("who")),
            reason=_text(result.get("reason")),
            host_lost=self._host_lost(),
            interrupted=self.interrupted,
            lost_agents=self._lost(),
            machine_problems=tuple(f"{p.machine}: {p.text}" for p in self.problems if p.machine),
            problems=tuple(p.text for p in self.problems if not p.machine),
            missing=self.missing,
            miss_ratio=totals.miss_ratio,
            overrun_ratio=totals.overrun_ratio,
            rtf=_number(result.get("rtf")),
            has_rate=self._has_rate(),
            is_lockstep=self._is_lockstep(),
            reliable_lost=_count(messages, "reliable", "lost"),
            sync_lost=_count(messages, "sync", "lost"),
            sync_deadlines_broken=_count(messages, "sync", "deadlines_broken"),
            records_dropped=sum(scan.dropped for scan in self.scans),
            records_truncated=sum(scan.truncated for scan in self.scans),
            plugin_checks=tuple(self._plugin_checks()),
            remarks=affinity_remarks(mapping_at(result, "agents")),
        )

    def _host_lost(self) -> str | None:
        met = (p for p in self.problems if p.machine == self.host_machine and p.step == "run")
        return next((p.text for p in met), None) if self.host_machine else None

    def _plugin_checks(self) -> list[Any]:
        agents = mapping_at(self.result, "agents")
        of_agents = {name: mapping_at(agents, name, "simulation") for name in agents}
        of_host = {"host": mapping_at(self.result, "simulation")}
        return plugin_checks(of_host) + plugin_checks(of_agents)

    def _has_rate(self) -> bool:
        time, agents = (self.config.time, self.config.agents) if self.config else (None, None)
        return time is None or agents is None or time.duration_s * agents.tick_hz >= TICKS_OF_A_RATE

    def _is_lockstep(self) -> bool:
        return self.config is not None and self.config.time.is_lockstep

    def _records_sha256(self) -> str | None:
        """Return what two lockstep runs of one seed have in common: a hash over all that was recorded."""
        if not self._is_lockstep():
            return None
        digest = hashlib.sha256()
        for scan in sorted(self.scans, key=_place_of):
            digest.update(f"{_place_of(scan)} {scan.sha256}\n".encode())
        return digest.hexdigest()

    def _lost(self) -> tuple[str, ...]:
        lost = (self.result or {}).get("lost")
        return tuple(map(str, lost)) if isinstance(lost, Sequence | Mapping) else ()

    def _document(self, verdict: Verdict, totals: TickTotals) -> dict[str, Any]:
        result = self.result or {}
        config = self.config
        return {
            "schema": SCHEMA,
            "run": self.run,
            "scenario": config.scenario if config else self.started.get("scenario"),
            "status": verdict.status,
            "exit_code": int(verdict.exit_code),
            "verdict": verdict.text,
            "who": verdict.who,
            "reason": verdict.reason,
            "agents": self._agents(),
            "started_utc": self.started.get("started_utc"),
            "t0_utc": result.get("t0_utc"),
            "duration_s": result.get("duration_s"),
            "rtf": result.get("rtf"),
            "time_mode": config.time.mode if config else self.started.get("time_mode"),
            "seed": config.seed if config else self.started.get("seed"),
            "versions": self.started.get("versions", {}),
            "timing": self._timing(totals),
            "messages": self._messages(),
            "packets": packet_counts(mapping_at(result, "agents")),
            "round_trip_ms": self.round_trip_ms,
            "clock": self.clock,
            "records": self._records(),
            "records_sha256": self._records_sha256(),
            "data": {"complete": not self.missing, "missing": list(self.missing)},
            "problems": [problem.to_mapping() for problem in self.problems],
            "checks": [check.to_mapping() for check in verdict.checks],
            "remarks": list(verdict.remarks),
            "scheduling": result.get("scheduling", {}),
            "simulation": self._simulation(),
        }

    def _agents(self) -> dict[str, Any]:
        agents = mapping_at(self.result, "agents")
        restarted = {
            name: agent["incarnations"]
            for name in agents
            if is_number((agent := mapping_at(agents, name)).get("incarnations"))
            and agent["incarnations"] > 1
        }
        count = len(self.expected.agents) or len(self.ticks.agents)
        return {"count": count, "lost": list(self._lost()), "incarnations": restarted}

    def _messages(self) -> dict[str, Any]:
        twice = duplicates_by_service(mapping_at(self.result, "agents"))
        totals = {name: mapping_at(self.result, "messages", name) for name in SERVICES}
        return {name: {**totals[name], "duplicates": twice[name]} for name in SERVICES}

    def _timing(self, totals: TickTotals) -> dict[str, Any]:
        return {
            "ticks": totals.due,
            "missed": totals.missed,
            "miss_ratio": totals.miss_ratio,
            "overrun_errors": totals.overrun_errors,
            "lateness_ms": self.ticks.lateness_ms,
            "margin_ms": self.ticks.margin_ms,
        }

    def _records(self) -> dict[str, int]:
        return {
            "written": sum(scan.records for scan in self.scans),
            "dropped": sum(scan.dropped for scan in self.scans),
            "truncated": sum(scan.truncated for scan in self.scans),
            "damaged": sum(scan.damaged for scan in self.scans),
            "not_finite": sum(scan.not_finite for scan in self.scans),
            "bytes": sum(scan.size_bytes for scan in self.scans),
        }

    def _simulation(self) -> dict[str, Any]:
        agents = mapping_at(self.result, "agents")
        own = {name: mapping_at(agents, name, "simulation") for name in agents}
        return {"host": mapping_at(self.result, "simulation"), "agents": own}


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return what JSON holds of a document: a plug-in's summary may carry NaN, arrays, tuples."""
    data = orjson.dumps(
        document, default=_last_resort, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS
    )
    return orjson.loads(data)  # type: ignore[no-any-return]


def _last_resort(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else str(value)


def _place_of(scan: StreamScan) -> str:
    return f"{scan.file.role}/{scan.file.source}/{scan.file.path.name}"


def _text(value: object) -> str | None:
    return value if isinstance(value, str) else None


def _number(value: object) -> float | None:
    return float(value) if is_number(value) else None


def _count(messages: Mapping[str, Any], service: str, name: str) -> int | None:
    """Return a count; None if the class was not reported at all, 0 if it never counted anything."""
    counts = messages.get(service)
    if not isinstance(counts, Mapping):
        return None
    value = counts.get(name, 0)
    return int(value) if is_number(value) else None
