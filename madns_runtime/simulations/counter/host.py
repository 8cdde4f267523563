"""The host's half of the counting benchmark: increments and returns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.plugin.api import HostContext, HostSimulation
from madns_runtime.protocol.messages import Service


class CounterHost(HostSimulation):
    """Increments each packet's value and sends it back in the class of service it came in."""

    def setup(self, context: HostContext) -> None:
        """Prepare."""
        self._send = context.send
        self._service = Service[context.parameters.service.upper()]
        self._returned_count = 0

    def receive(self, agent: str, message: Any) -> None:
        """Return [packet, value + 1, payload]."""
        packet, value, payload = message
        self._send(agent, [packet, value + 1, payload], self._service)
        self._returned_count += 1

    def finish(self) -> Mapping[str, Any]:
        """Return how many packets went back."""
        return {"returned": self._returned_count}
