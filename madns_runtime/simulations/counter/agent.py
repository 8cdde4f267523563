"""The agent's half of the counting benchmark: increments, sends, and times what comes back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from madns_runtime.plugin.api import HOST, AgentContext, AgentSimulation, Tick
from madns_runtime.protocol.messages import Service
from madns_runtime.recording.records import Field

IN_FLIGHT_MAX = 10_000
"""Packets whose return is still awaited; an older one counts as lost when it leaves."""
ROUND_TRIPS_MAX = 20_000_000
"""Round trips kept for the summary: 55 h at 100 Hz, 4 bytes each."""
BLOCK = 4096


class CounterAgent(AgentSimulation):
    """Each tick sends [packet, value, payload]; the host returns value + 1."""

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """Prepare the stream of round trips."""
        self._context = context
        self._service = Service[context.parameters.service.upper()]
        self._payload = bytes(context.parameters.payload_bytes)
        self._value = 0
        self._in_flight: dict[int, tuple[float, int]] = {}
        self._sent_count = 0
        self._newest = -1
        self._duplicated_count = 0
        self._reordered_count = 0
        self._wrong_count = 0
        self._blocks: list[np.ndarray[Any, np.dtype[np.float32]]] = []
        self._block = np.empty(BLOCK, dtype=np.float32)
        self._fill = 0
        context.open_stream(
            "round_trips",
            (
                Field("packet", "", "int"),
                Field("value", "", "int"),
                Field("round_trip_us", "us", "int"),
            ),
        )

    def step(self, tick: Tick) -> None:
        """Increment and send."""
        packet = tick.index
        self._value += 1
        if len(self._in_flight) >= IN_FLIGHT_MAX:
            del self._in_flight[next(iter(self._in_flight))]
        self._in_flight[packet] = (self._context.now_s(), self._value)
        self._sent_count += 1
        self._context.send(HOST, [packet, self._value, self._payload], self._service)

    def receive(self, message: Any) -> None:
        """Time a packet that came back."""
        now_s = self._context.now_s()
        packet, value, _ = message
        sent = self._in_flight.pop(packet, None)
        if sent is None:
            self._duplicated_count += 1
            return
        sent_s, sent_value = sent
        if value != sent_value + 1:
            self._wrong_count += 1
        if packet < self._newest:
            self._reordered_count += 1
        self._newest = max(self._newest, packet)
        self._value = max(self._value, value)
        round_trip_s = now_s - sent_s
        self._keep(round_trip_s)
        self._context.record("round_trips", (packet, value, round(round_trip_s * 1e6)))

    def finish(self) -> Mapping[str, Any]:
        """Return the thesis's figures over all round trips, in microseconds."""
        samples = np.concatenate([*self._blocks, self._block[: self._fill]]).astype(np.float64)
        lost = self._sent_count - len(samples)
        summary: dict[str, Any] = {
            "sent": self._sent_count,
            "returned": len(samples),
            "lost": lost,
            "duplicated": self._duplicated_count,
            "out_of_order": self._reordered_count,
            "wrong_values": self._wrong_count,
            "round_trip_us": _statistics(samples * 1e6) if len(samples) else None,
        }
        summary["checks"] = [
            {"name": f"counter.{name}", "limit": 0, "got": got, "passed": got == 0}
            for name, got in (("lost", lost), ("wrong_values", self._wrong_count))
        ]
        return summary

    def _keep(self, round_trip_s: float) -> None:
        if self._fill == BLOCK:
            if len(self._blocks) * BLOCK < ROUND_TRIPS_MAX:
                self._blocks.append(self._block)
            self._block = np.empty(BLOCK, dtype=np.float32)
            self._fill = 0
        self._block[self._fill] = round_trip_s
        self._fill += 1


def _statistics(samples_us: np.ndarray[Any, np.dtype[np.float64]]) -> dict[str, float]:
    p50, p99, p999 = np.percentile(samples_us, (50, 99, 99.9))
    low, high = samples_us.min(), samples_us.max()
    figures = {
        "mean": samples_us.mean(),
        "sd": samples_us.std(),
        "min": low,
        "max": high,
        "range": high - low,
        "p50": p50,
        "p99": p99,
        "p999": p999,
    }
    return {name: round(float(value), 3) for name, value in figures.items()}
