"""Limits of silence: how long each side may say nothing before the other takes it for lost, by what keeps it busy."""

from __future__ import annotations

from typing import Final

from madns_runtime.config import Timeouts
from madns_runtime.protocol.events import Phase
from madns_runtime.protocol.states import AgentState, HostState

STALL_S: Final = 1.0
"""A session that was not called for this long, though it was due, was itself frozen, and blames nobody for silence."""

KILLED_SILENCE_S: Final = 2.0
"""An agent that is ordered to end without a word, and says none for this long, has done so."""

_NEVER: Final = float("inf")


class Wakefulness:
    """
    Tells since when a session is awake: what it did not hear before, nobody is to blame for.

    Args:
        silence_s: Half of this is the grace after a stall.
        now_s: Present time.
    """

    __slots__ = ("_called_s", "_silence_s", "blameless_until_s")

    def __init__(self, silence_s: float, now_s: float) -> None:
        self._silence_s = silence_s
        self._called_s = now_s
        self.blameless_until_s = -_NEVER
        """Silence is counted from here at the earliest."""

    def called(self, now_s: float, wanted_s: float = -_NEVER) -> None:
        """
        Take note that the session is called now.

        Args:
            now_s: Present time.
            wanted_s: When it asked to be called, at the latest: until then nothing has kept it from that.
        """
        if now_s - max(self._called_s, wanted_s) > STALL_S:
            self.blameless_until_s = now_s - self._silence_s / 2
        self._called_s = now_s


def host_silence_limit_s(state: AgentState, timeouts: Timeouts) -> float:
    """Return how long a host may say nothing to an agent in *state*."""
    # While it sets up its own half the host may be busy; afterwards it answers pings at once.
    busy_s = {
        AgentState.AGENT_READY: timeouts.host_setup_s,
        AgentState.SIMULATION_COMPLETE: timeouts.shutdown_s,  # it makes its summary
    }
    return timeouts.silence_s + busy_s.get(state, 0.0)


def agent_silence_limit_s(
    state: HostState,
    phase: Phase,
    timeouts: Timeouts,
    *,
    is_over: bool,
    is_being_killed: bool = False,
) -> float:
    """
    Return how long an agent may say nothing: longer where its plug-in or its disk keeps it busy.

    Args:
        state: The host's.
        phase: The agent's.
        timeouts: The run's deadlines.
        is_over: Whether the simulated time is.
        is_being_killed: Whether it was ordered to end without a word.
    """
    if phase in (Phase.ABSENT, Phase.STOPPED, Phase.LOST) or state is HostState.BEGIN_SHUTDOWN:
        return _NEVER  # nobody to hear, or a state whose own deadline waits for all
    limit_s = timeouts.silence_s
    if is_being_killed and phase in (Phase.RUNNING, Phase.COMPLETE):
        return min(limit_s, KILLED_SILENCE_S)
    if state is HostState.HOST_SIMULATION_READY or phase is Phase.SETTING_UP:
        # Its half is being set up, or that of an agent which shares its process.
        return limit_s + timeouts.agent_setup_s
    # Its half makes its summary.
    return limit_s + timeouts.complete_s if is_over else limit_s
