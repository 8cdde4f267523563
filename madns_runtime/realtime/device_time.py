"""Simulated time for an agent's devices: how it runs on this machine's clock, by the agent's estimate."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic

from madns_runtime.hardware.port import Hardware
from madns_runtime.realtime.agent_link import AgentPort

ERROR_S_MAX = 10e-6
"""Error of what was told before that is let stand, s; beyond it simulated time is told anew."""
RATE_SPAN_S = 0.1


class DeviceTime:
    """
    Keeps the simulated time of an agent's devices, by which they record and play, that of the agent.

    Args:
        hardware: The devices.
        port: Knows simulated time.
        end_s: Returns when it ends, s.
    """

    def __init__(self, hardware: Hardware, port: AgentPort, end_s: Callable[[], float]) -> None:
        self._hardware = hardware
        hardware.use_clock(port.local_s)
        self._port = port
        self._end_s, self._told_end_s = end_s, 0.0
        self._local_s = self._t_s = 0.0
        self._rate = 1.0

    def tell(self) -> None:
        """Tell the devices' processes how simulated time runs; it must have begun to be known."""
        if self._hardware:
            port, local_s = self._port, monotonic()
            self._local_s, self._t_s = local_s, port.at(local_s)
            self._rate = port.session.clock.rate(local_s, RATE_SPAN_S)
            self._told_end_s = self._end_s()
            self._hardware.tell_time(local_s, self._t_s, self._rate, self._told_end_s)

    def follow(self) -> None:
        """Tell it anew if what was told holds no longer: the estimate has learnt, is slewed, or was put wrong, or the end is sooner."""
        local_s = monotonic()
        told_s = self._t_s + (local_s - self._local_s) * self._rate
        is_wrong = abs(told_s - self._port.at(local_s)) > ERROR_S_MAX
        if is_wrong or self._told_end_s != self._end_s():
            self.tell()
