"""
The calls of the agents' halves in one process: which is under way, told to the supervisor through shared memory.

A page of three numbers, made before the fork: a process that ends in the middle of a call, by `os._exit` or a
signal, leaves behind whose call it was, of which method, and when. Marking a call costs a few stores.
"""

from __future__ import annotations

import math
import mmap
from dataclasses import dataclass
from typing import Final

from madns_runtime.hardware.port import Hardware

IDLE: Final = 0.0
SETUP, STEP, RECEIVE, FINISH, HEAR, REFUSED, DEVICE_CHANGED = 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0
BEGIN_ACTION, END_ACTION = 8.0, 9.0
METHODS: Final = {
    SETUP: "setup",
    STEP: "step",
    RECEIVE: "receive",
    FINISH: "finish",
    HEAR: "hear",
    REFUSED: "refused",
    DEVICE_CHANGED: "device_changed",
    BEGIN_ACTION: "begin_action",
    END_ACTION: "end_action",
}
NUMBER_OF: Final = {method: number for number, method in METHODS.items()}
METHOD, AGENT, T_S = 0, 1, 2
"""Places in the page: the number of the method under way, the agent's among those of its process, and the
simulated time of the newest tick, s; not a number before the first."""


class AgentCalls:
    """The page of one process of agents."""

    def __init__(self) -> None:
        self.page = memoryview(mmap.mmap(-1, mmap.PAGESIZE)).cast("d")

        self.page[T_S] = math.nan

    def interrupted(self, agents: tuple[str, ...]) -> str:
        """
        Return the call under way, in words: " in the step of agent-02 at t = 5.7 s"; empty for none.

        Args:
            agents: Names of the process's agents.
        """
        method, agent, t_s = self.page[METHOD], int(self.page[AGENT]), self.page[T_S]
        if method not in METHODS or not 0 <= agent < len(agents):
            return ""
        when = "" if math.isnan(t_s) else f" at t = {t_s:g} s"
        return f" in the {METHODS[method]} of {agents[agent]}{when}"


@dataclass(frozen=True, slots=True)
class LoopSeat:
    """An agent's place in the loop of its process."""

    name: str
    """The agent's."""
    number: int
    """Among the agents of the process, from 0."""
    calls: AgentCalls
    hardware: Hardware
    """The devices that the agent uses."""
