"""An agent's account of its run in real time: what a ping tells of it on the way, and its summary at the end."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final

from madns_runtime.hardware.port import Hardware
from madns_runtime.protocol.codec import pack
from madns_runtime.protocol.datagram import BEST_BYTES_MAX
from madns_runtime.realtime.agent_link import AgentPort
from madns_runtime.realtime.process_records import ProcessRecords
from madns_runtime.realtime.ticks import PacedTicks
from madns_runtime.recording.newest_values import NewestValues

REPORT_BYTES_MAX: Final = BEST_BYTES_MAX - 32
"""Bytes of the entries of a report: the rest of a ping is its time and a few heads."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentOutcome:
    """End of an agent: how and why."""

    as_ordered: bool
    """Whether it ended by the host's order at the end of a run."""
    reason: str = ""
    may_restart: bool = False
    """Whether it failed by itself while the run may go on: another try makes sense."""
    is_run_over: bool = False
    """Whether it was ended with the run: nobody is to return to that any more."""


@dataclass(slots=True, kw_only=True)
class AgentReport:
    """Reads what others keep; holds nothing of its own but what the kernel granted."""

    port: AgentPort
    records: ProcessRecords
    ticks: PacedTicks
    columns: NewestValues
    devices: Hardware
    """Devices that no operator hears of: the host hears of them by pings."""
    scheduling: Mapping[str, Any] = field(default_factory=dict)
    """Scheduling that the kernel granted to the loop."""

    def ping(self) -> Mapping[str, Any]:
        """Return what a ping tells of the agent: an entry that finds no room in its datagram is left out."""
        report = self.records.report()
        if self.port.t0_host_s is not None:
            ticks = self.ticks.pacer.summary()
            report.update(
                ticks=ticks["run"],
                missed=ticks["missed"],
                late_p50_us=ticks["lateness_us_p50"],
                late_p99_us=ticks["lateness_us_p99"],
                rtf=self._real_time_factor(),
                lost=self.port.session.link.counters.best.lost,
                **self.devices.report(),
                columns=self.columns.read(),
            )
        return fitting(report, REPORT_BYTES_MAX)

    def summary(self, simulation: Any) -> dict[str, Any]:
        """Return what the host is told at the end; *simulation* is the summary of the agent's half."""
        clock, now_s = self.port.session.clock, monotonic()
        return {
            "ticks": {**self.ticks.pacer.summary(), "causes": self.ticks.late.counts()},
            "rtf": self._real_time_factor(),
            "clock": {
                "offset_us": clock.offset_s(now_s) * 1e6,
                "drift_ppm": clock.drift_ppm,
                "uncertainty_us": clock.uncertainty_s(now_s) * 1e6,
                "steps": clock.steps,
                "rejected": clock.rejected,
            }
            if clock.is_valid
            else None,
            "scheduling": self.scheduling,
            "columns": self.columns.read(),
            "simulation": simulation or {},
        }

    def last_counts(
        self, records: Mapping[str, Any], messages: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return what the host is told once the records are closed, given their counts and the messages' before."""
        return {
            **records,
            **self.records.device_account,
            "messages": messages,
            "network": self.port.network(),
            "loop": self.port.process.loop(),
            "between_agents": self.port.mailbox.counts(),
            "held_dropped": self.port.session.held_dropped_count,
            "too_late": self.port.too_late,
            "malformed": self.port.session.malformed_count,
        }

    def _real_time_factor(self) -> float | None:
        factor = self.ticks.factor.value()
        return None if factor is None else round(factor, 9)


def fitting(report: Mapping[str, Any], bytes_max: int) -> dict[str, Any]:
    """Return the entries of a report that go into so many bytes, in their order: one that does not is left out."""
    found: dict[str, Any] = {}
    left = bytes_max
    for name, value in report.items():
        size = len(pack(name)) + len(pack(value))
        if size <= left:
            found[name] = value
            left -= size
    return found


def how_ended(code: int, signal_name: str | None, reason: str | None, *, where: str) -> str:
    """Return how a process ended; one that gave no reason, also in which call of the plug-in."""
    if signal_name is not None:
        return f"killed by {signal_name}{where}"
    if reason is not None:
        return reason
    return "ended" if code == 0 else f"exit code {code}{where}"
