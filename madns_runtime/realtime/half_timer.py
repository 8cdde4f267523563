"""The timer of the host's half in real time: called when simulated time has come to what it asked for."""

from __future__ import annotations

import math
from time import monotonic

from madns_runtime.protocol.states import HostState
from madns_runtime.realtime.host_core import RealtimeCore


class HalfTimer:
    """
    Calls the half's timer.

    Args:
        core: Of the host.
    """

    def __init__(self, core: RealtimeCore) -> None:
        self._port = core.port
        self._half = core.half
        self._guard = core.guard
        self._pump = core.pump
        # Infinite is never: the timer is made once and moved.
        self._timer = core.reactor.call_at(math.inf, self.call)

    def call(self) -> None:
        """Call it, now, if simulated time runs."""
        if self._port.is_in(HostState.SIMULATION_START):
            self._guard(self._half.call_timer, self._port.now_s())
            self._arm()
            self._pump()

    def wake(self, t_s: float) -> None:
        """Have it called at simulated time *t_s*, if not earlier."""
        self._half.wake(t_s)
        self._arm()

    def _arm(self) -> None:
        # Not before now: what waits in the sockets has its turn between two calls that are late.
        self._timer.reschedule(max(self._port.due_s(self._half.next_s), monotonic()))
