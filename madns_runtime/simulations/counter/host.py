"""The host's half of the counting benchmark: increments and returns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from madns_runtime.plugin.api import HostContext, HostSimulation
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.counter.parameters import DEVICE_SAMPLES


class CounterHost(HostSimulation):
    """Increments each packet's value and sends it back in the class of service it came in."""

    def setup(self, context: HostContext) -> None:
        """Prepare."""
        self._send = context.send
        self._service = Service[context.parameters.service.upper()]
        self._returned_count = 0
        self._samples: Counter[str] = Counter()
        """Samples of a device that have come, by agent."""
        self._context = context
        if context.parameters.send_device:
            context.open_stream("device_samples", DEVICE_SAMPLES)

    def receive(self, agent: str, message: Any) -> None:
        """Return [packet, value + 1, payload]; record [device, samples]."""
        if len(message) == 2:
            self._record_samples(agent, *message)
            return
        packet, value, payload = message
        self._send(agent, [packet, value + 1, payload], self._service)
        self._returned_count += 1

    def finish(self) -> Mapping[str, Any]:
        """Return how many packets went back, and what came of a device."""
        summary: dict[str, Any] = {"returned": self._returned_count}
        if self._context.parameters.send_device:
            absent = int(not self._samples)
            summary["device_samples"] = dict(self._samples)
            summary["checks"] = [
                {
                    "name": "counter.device_absent",
                    "limit": 0,
                    "got": absent,
                    "passed": not absent,
                    "worst": self._context.parameters.send_device,
                }
            ]
        return summary

    def _record_samples(self, agent: str, device: str, samples: Sequence[Any]) -> None:
        now_s = self._context.now_s()
        for channel, number, taken_s, value in samples:
            delay_us = round((now_s - taken_s) * 1e6)
            self._context.record(
                "device_samples",
                (round(taken_s, 6), f"{agent}/{device}", channel, number, delay_us, value),
            )
        self._samples[agent] += len(samples)
