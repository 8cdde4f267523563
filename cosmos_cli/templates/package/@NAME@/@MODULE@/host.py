"""The host's half: where every rover really is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from madns_runtime.plugin.api import Check, HostContext, HostSimulation
from madns_runtime.protocol.messages import Service

from @MODULE@.streams import TRUTH

TRUTH_STEP_S = 0.02


class RoverHost(HostSimulation):
    """Moves every rover at the speed that it commanded last, and measures where it is."""

    def setup(self, context: HostContext) -> None:
        """Place the rovers at the start and their marks before them."""
        self._context = context
        self._t_s = 0.0
        self._position_m = dict.fromkeys(context.agents, 0.0)
        self._speed_m_s = dict.fromkeys(context.agents, 0.0)
        first_m = context.parameters.distance_m
        self._mark_m = {name: first_m + index for index, name in enumerate(context.agents)}
        context.open_stream("truth", TRUTH)

    def initial_data(self, agent: str) -> Mapping[str, Any]:
        """Return what one rover is told before the run starts."""
        return {"mark_m": self._mark_m[agent]}

    def timer(self, t_s: float) -> float:
        """Move and measure; return the next time wanted."""
        step_s = max(0.0, t_s - self._t_s)
        self._t_s = t_s
        for name in self._position_m:
            self._position_m[name] += self._speed_m_s[name] * step_s
            self._context.record("truth", (t_s, name, self._position_m[name]))
            noise_m = self._context.random.normal(0.0, self._context.parameters.noise_m)
            # BEST: only the newest measurement matters, so a lost one is not sent again.
            self._context.send(
                name, {"position_m": self._position_m[name] + noise_m}, Service.BEST
            )
        return t_s + TRUTH_STEP_S

    def receive(self, agent: str, message: Any) -> None:
        """Take a command; the world has limits, whatever the software asks for."""
        wanted_m_s = float(message["speed_m_s"])
        if math.isfinite(wanted_m_s):
            limit_m_s = self._context.parameters.speed_max_m_s
            self._speed_m_s[agent] = max(-limit_m_s, min(limit_m_s, wanted_m_s))

    def finish(self) -> Mapping[str, Any]:
        """Return the summary: a check that has not passed ends `cosmos run` with exit code 4."""
        limit_m = self._context.parameters.error_max_m
        errors_m = {name: abs(x_m - self._mark_m[name]) for name, x_m in self._position_m.items()}
        worst = max(errors_m, key=lambda name: errors_m[name])
        check = Check(
            name="error_m",
            limit=limit_m,
            got=errors_m[worst],
            passed=errors_m[worst] <= limit_m,
            worst=worst,
        )
        return {"checks": [asdict(check)]}
