"""run.json: what is promised to scripts, put together from evidence. Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import orjson

from cosmos_cli.evidence.completeness import ExpectedRecords, is_excused, is_in_lockstep
from cosmos_cli.evidence.datagrams import (
    datagram_account,
    datagram_remarks,
    duplicates_by_service,
    packet_counts,
)
from cosmos_cli.evidence.devices import device_checks, device_remarks
from cosmos_cli.evidence.expectations.judge import JudgedExpectations
from cosmos_cli.evidence.flown_files import KEY as FLOWN
from cosmos_cli.evidence.flown_files import flown_remarks
from cosmos_cli.evidence.plugin_checks import plugin_checks
from cosmos_cli.evidence.remarks import result_remarks
from cosmos_cli.evidence.run_directory import SCHEMA
from cosmos_cli.evidence.run_documents import Problem, text_or_none
from cosmos_cli.evidence.statistics import TickStatistics, TickTotals, tick_totals, worst_sources
from cosmos_cli.evidence.streams import StreamScan
from cosmos_cli.evidence.table_labels import time_zero_remarks
from cosmos_cli.evidence.tick_causes import AgentCauses, CauseTotals, cause_totals, told_causes
from cosmos_cli.evidence.verdict import (
    CheckLimits,
    CheckResult,
    RunFacts,
    Verdict,
    is_number,
    judge,
    why_no_rate,
)
from cosmos_cli.models.inventory.machine import LOOPBACK
from madns_runtime.config import HardwareSettings, RunConfig
from madns_runtime.plain_values import mapping_at
from madns_runtime.protocol.messages import SERVICE_NAMES
from madns_runtime.recording.newest_values import clean_values
from madns_runtime.recording.records import WHOLE_MAX
from madns_runtime.timing.rate import count_ticks


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """All that a summary is made of."""

    run: str
    started: Mapping[str, Any]
    """run.json as it was written at the start, or as it is."""
    config: RunConfig | None
    expected: ExpectedRecords
    result: Mapping[str, Any] | None
    """Report of the host; None if it could not give one."""
    scans: Sequence[StreamScan]
    ticks: TickStatistics
    recorded_causes: Mapping[str, AgentCauses] = field(default_factory=dict)
    """Causes of missed and late ticks by agent, from the records."""
    round_trip_ms: Mapping[str, Any] = field(default_factory=dict)
    clock: Mapping[str, float] = field(default_factory=dict)
    host_machine: str | None = None
    """Machine of the host; None when it was this computer."""
    machine_of_agent: Mapping[str, str] = field(default_factory=dict)
    devices: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Outcome of each device, by its full name."""
    interrupted: bool = False
    problems: tuple[Problem, ...] = ()
    missing: tuple[str, ...] = ()
    expectations: JudgedExpectations = JudgedExpectations()  # noqa: RUF009 - frozen
    """Results of what the scenario expected."""
    timeline_remarks: tuple[str, ...] = ()
    undeclared_remarks: tuple[str, ...] = ()

    def judged(self) -> tuple[Verdict, dict[str, Any]]:
        """Return the verdict and run.json."""
        totals = self._totals()
        causes = self._causes(totals)
        verdict = judge(self._facts(totals, causes), self._limits())
        return verdict, _plain(self._document(verdict, totals, causes))

    def _of_agents(self, *keys: str) -> dict[str, Mapping[str, Any]]:
        """Return what the host told of each agent under these keys."""
        agents = mapping_at(self.result, "agents")
        return {name: mapping_at(agents, name, *keys) for name in agents}

    def _totals(self) -> TickTotals:
        names = tuple(dict.fromkeys((*self.expected.agents, *self.ticks.agents)))
        is_complete = self.result is not None and self.result.get("status") == "complete"
        due_each = self._ticks_due() if is_complete else None
        lost = self._lost()
        return tick_totals(
            self.ticks.agents,
            self._of_agents("ticks"),
            agents=names,
            due_each=due_each,
            excused=[name for name in self._lost_on_purpose() if name not in lost],
        )

    def _causes(self, totals: TickTotals) -> CauseTotals | None:
        """Return why ticks were missed or late; None in lockstep, and for a run of a version that did not tell."""
        if self._is_lockstep():
            return None
        told = dict(self.recorded_causes)
        summaries = self._of_agents("ticks")
        for name, ticks in summaries.items():
            own = told_causes(ticks)
            # A restarted agent's summary is of its last incarnation alone; its records are of all.
            if own is not None and not self._is_restarted(name):
                told[name] = own
        if not told and totals.missed:
            return None
        return cause_totals(told, {name: of.missed for name, of in totals.agents.items()})

    def _is_restarted(self, agent: str) -> bool:
        incarnations = mapping_at(self.result, "agents", agent).get("incarnations")
        return is_number(incarnations) and incarnations > 1

    def _limits(self) -> CheckLimits:
        if self.config is None:
            return self._limits_before()
        return CheckLimits(
            miss_ratio_max=self.config.deadline.max_miss_ratio,
            rtf_tolerance=self.config.time.rtf_tolerance,
            not_finite_max=self.config.recording.not_finite_max,
            duration_s=self._duration_s(self.config),
        )

    def _limits_before(self) -> CheckLimits:
        """Return the limits of an earlier verdict: the plan is lost. Those it does not tell are the defaults."""
        listed = self.started.get("checks")
        checks = [c for c in listed if isinstance(c, Mapping)] if isinstance(listed, list) else []
        told = {str(c.get("name")): c["limit"] for c in checks if is_number(c.get("limit"))}
        default = CheckLimits()
        return CheckLimits(
            miss_ratio_max=told.get("deadline.miss_ratio", default.miss_ratio_max),
            rtf_tolerance=told.get("time.rtf", default.rtf_tolerance),
            not_finite_max=int(told.get("records.not_finite", default.not_finite_max)),
        )

    def _facts(self, totals: TickTotals, causes: CauseTotals | None) -> RunFacts:
        result = self.result or {}
        messages = mapping_at(result, "messages")
        ticks_due = self._ticks_due()
        return RunFacts(
            host_status=text_or_none(result.get("status")),
            who=text_or_none(result.get("who")),
            reason=text_or_none(result.get("reason")),
            host_lost=self._host_lost(),
            interrupted=self.interrupted,
            lost_agents=self._lost(),
            lost_because={a: text_or_none(of.get("reason")) for a, of in self._of_agents().items()},
            is_ended_by_machine=self._is_ended_by_machine(),
            machine_problems=tuple(
                f"{p.machine}: {p.text}"
                for p in self.problems
                if p.machine and p.step != "forgotten" and not p.is_of_data
            ),
            problems=tuple(p.text for p in self.problems if not p.machine),
            missing=self._gaps(),
            miss_ratio=totals.miss_ratio,
            overrun_ratio=totals.overrun_ratio,
            rtf=_number(result.get("rtf")),
            no_rate=why_no_rate(result, ticks_due),
            is_lockstep=self._is_lockstep(),
            reliable_lost=_count(messages, "reliable", "lost"),
            sync_lost=_count(messages, "sync", "lost"),
            sync_deadlines_broken=_count(messages, "sync", "deadlines_broken"),
            records_dropped=sum(scan.dropped for scan in self._judged_scans()),
            records_truncated=sum(scan.truncated for scan in self._judged_scans()),
            records_not_finite=sum(scan.not_finite for scan in self.scans),
            worst=worst_sources(totals.agents, mapping_at(result, "agents"), self.scans),
            late_hint=causes.hint if causes else "",
            plugin_checks=(*self._device_checks(), *self._plugin_checks()),
            expectations=self.expectations.results,
            remarks=(
                *(causes.remarks(self._lateness_limit_s()) if causes else ()),
                *result_remarks(result, self._summaries()),
                *time_zero_remarks(self.config, result, self.started.get("started_utc")),
                *device_remarks(mapping_at(result, "agents"), self.devices),
                *datagram_remarks(datagram_account(result)),
                *self.undeclared_remarks,
                *flown_remarks(self.started),
                *self.timeline_remarks,
                *self.expectations.remarks(),
            ),
        )

    def _judged_scans(self) -> list[StreamScan]:
        """Return the scans but those of agents' incarnations that were ended on purpose, which cut them."""
        agents = mapping_at(self.result, "agents")
        return [scan for scan in self.scans if not is_excused(scan, agents)]

    def _gaps(self) -> tuple[str, ...]:
        return (*self.missing, *self.expectations.gaps())

    def _lateness_limit_s(self) -> float | None:
        return None if self.config is None else self.config.deadline.lateness_limit_s

    def _host_lost(self) -> str | None:
        met = (p for p in self.problems if p.machine == self.host_machine and p.step == "run")
        return next((p.text for p in met), None) if self.host_machine else None

    def _is_ended_by_machine(self) -> bool:
        """Tell whether the host, or one of the agents whose loss ended the run, was on a machine that was lost."""
        if self._host_lost() is not None and self.result is None:
            return True
        who = text_or_none((self.result or {}).get("who"))
        if who in self.devices:
            return True
        lost_machines = {p.machine for p in self.problems if p.machine and p.step == "run"}
        lost_machines.discard(LOOPBACK.name)  # what was killed on this computer is no lost machine
        blamed = (who or "").split(", ")
        return any(
            self.machine_of_agent.get(name) in lost_machines
            for name in set(self._lost()).intersection(blamed)
        )

    def _device_checks(self) -> list[CheckResult]:
        limits = self.config.hardware if self.config else HardwareSettings()
        return device_checks(self.devices, limits)

    def _plugin_checks(self) -> list[Any]:
        summaries = self._simulation()
        return plugin_checks({"host": summaries["host"]}) + plugin_checks(summaries["agents"])

    def _summaries(self) -> Mapping[str, Mapping[str, Any]]:
        summaries = self._simulation()
        return {"host": summaries["host"], **summaries["agents"]}

    def _ticks_due(self) -> int | None:
        """Return the ticks of each agent by the plan; None if it is lost."""
        if self.config is None:
            return None
        return count_ticks(self._duration_s(self.config), self.config.agents.tick_hz)

    def _duration_s(self, config: RunConfig) -> float:
        """Return the simulated time that was to be run, s: a stop of the timeline, or live, shortens it."""
        told = (self.result or {}).get("duration_s")
        planned_s = config.time.duration_s
        return min(float(told), planned_s) if is_number(told) and told >= 0 else planned_s

    def _is_lockstep(self) -> bool:
        return is_in_lockstep(self.config, self.started)

    def _records_sha256(self) -> str | None:
        """Return what two lockstep runs of one seed have in common: a hash over all that was recorded."""
        if not self._is_lockstep():
            return None
        lines = (f"{_place_of(scan)} {scan.sha256}\n" for scan in sorted(self.scans, key=_place_of))
        return hashlib.sha256("".join(lines).encode()).hexdigest()

    def _lost(self) -> tuple[str, ...]:
        lost = (self.result or {}).get("lost")
        return tuple(map(str, lost)) if isinstance(lost, Sequence | Mapping) else ()

    def _lost_on_purpose(self) -> tuple[str, ...]:
        lost = (self.result or {}).get("lost_on_purpose")
        return tuple(map(str, lost)) if isinstance(lost, list) else ()

    def _document(
        self, verdict: Verdict, totals: TickTotals, causes: CauseTotals | None
    ) -> dict[str, Any]:
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
            **({FLOWN: self.started[FLOWN]} if FLOWN in self.started else {}),
            "timing": self._timing(totals, causes),
            "messages": self._messages(),
            "between_agents": dict(mapping_at(result, "between_agents")),
            "packets": packet_counts(
                mapping_at(self.result, "agents"), mapping_at(self.result, "faults", "agents")
            ),
            "datagrams": datagram_account(result),
            "faults": dict(mapping_at(result, "faults")),
            "host_calls": dict(mapping_at(result, "host_calls")),
            "round_trip_ms": self.round_trip_ms,
            "clock": self.clock,
            "records": self._records(),
            "records_sha256": self._records_sha256(),
            "data": {"complete": not self._gaps(), "missing": list(self._gaps())},
            "problems": [problem.to_mapping() for problem in self.problems],
            "checks": [check.to_mapping() for check in verdict.checks],
            **self.expectations.document(),
            "remarks": list(verdict.remarks),
            "scheduling": result.get("scheduling", {}),
            "preempt_rt": self._preempt_rt(),
            **({"devices": dict(self.devices)} if self.devices else {}),
            "columns": self._columns(),
            "simulation": self._simulation(),
        }

    def _preempt_rt(self) -> dict[str, bool | None]:
        """Return whether the kernel is PREEMPT_RT, of the host's machine and of those with agents, as far as they told."""
        told = {"host": mapping_at(self.result, "scheduling")}
        for name, scheduling in self._of_agents("scheduling").items():
            told.setdefault(self.machine_of_agent.get(name, LOOPBACK.name), scheduling)
        return {who: each["preempt_rt"] for who, each in told.items() if "preempt_rt" in each}

    def _agents(self) -> dict[str, Any]:
        restarted = {
            name: agent["incarnations"]
            for name, agent in self._of_agents().items()
            if self._is_restarted(name)
        }
        count = len(self.expected.agents) or len(self.ticks.agents)
        return {
            "count": count,
            "lost": list(self._lost()),
            "lost_on_purpose": list(self._lost_on_purpose()),
            "incarnations": restarted,
        }

    def _messages(self) -> dict[str, Any]:
        twice = duplicates_by_service(mapping_at(self.result, "agents"))
        totals = {name: mapping_at(self.result, "messages", name) for name in SERVICE_NAMES}
        return {name: {**totals[name], "duplicates": twice[name]} for name in SERVICE_NAMES}

    def _timing(self, totals: TickTotals, causes: CauseTotals | None) -> dict[str, Any]:
        return {
            "ticks": totals.due,
            "missed": totals.missed,
            "miss_ratio": totals.miss_ratio,
            "late": causes.late if causes else None,
            "causes": causes.causes if causes else {},
            "causes_by_agent": causes.agents if causes else {},
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

    def _columns(self) -> dict[str, Any]:
        """Return the last values of the fields that the simulation wanted shown, by agent."""
        names = list(map(str, (self.result or {}).get("columns") or ()))
        return {
            name: dict(zip(names, clean_values(agent.get("columns"), len(names)), strict=True))
            for name, agent in (self._of_agents() if names else {}).items()
        }

    def _simulation(self) -> dict[str, Any]:
        own = self._of_agents("simulation")
        return {"host": mapping_at(self.result, "simulation"), "agents": own}


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return what JSON holds of a document: a plug-in's summary may carry NaN, arrays, tuples."""
    data = orjson.dumps(
        document, default=_last_resort, option=orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_NON_STR_KEYS
    )
    plain: dict[str, Any] = orjson.loads(data)
    return plain


def _last_resort(value: Any) -> Any:
    return dict(value) if isinstance(value, Mapping) else str(value)


def _place_of(scan: StreamScan) -> str:
    return f"{scan.file.role}/{scan.file.source}/{scan.file.path.name}"


def _number(value: object) -> float | None:
    return float(value) if is_number(value) else None


def _count(messages: Mapping[str, Any], service: str, name: str) -> int | None:
    """Return a count; None if the class was not reported at all, 0 if it never counted anything."""
    counts = messages.get(service)
    value = counts.get(name, 0) if isinstance(counts, Mapping) else None
    return int(value) if is_number(value) and abs(value) <= WHOLE_MAX else None
