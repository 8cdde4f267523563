"""The agent's half: the software under test. It knows only what the host told it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from madns_runtime.plugin.api import HOST, AgentContext, AgentSimulation, Tick

from @MODULE@.streams import DRIVE

GAIN_1_S = 1.5


class RoverAgent(AgentSimulation):
    """Drives towards its mark, the slower the nearer it is."""

    def setup(self, context: AgentContext, initial: Mapping[str, Any]) -> None:
        """Take the mark from the host."""
        self._context = context
        self._mark_m = float(initial["mark_m"])
        self._measured_m: float | None = None
        context.open_stream("drive", DRIVE)

    def receive(self, message: Any) -> None:
        """Remember what was measured; `step` acts on it."""
        self._measured_m = float(message["position_m"])

    def step(self, tick: Tick) -> None:
        """Command a speed."""
        if self._measured_m is None:
            return
        speed_m_s = GAIN_1_S * (self._mark_m - self._measured_m)
        self._context.record("drive", (tick.index, self._measured_m, speed_m_s))
        self._context.send(HOST, {"speed_m_s": speed_m_s})

    def finish(self) -> Mapping[str, Any]:
        """Return this rover's part of the summary."""
        return {"mark_m": self._mark_m, "measured_m": self._measured_m}
