"""
Answers of a program in the rerun of a run in real time, each held until the tick in which it was carried out then.

In real time an answer is carried out in the first tick after it has come: that behind the tick which it answers, or a
later one by the time on record (stream `flight_answers`). In lockstep it would be in the tick that it answers.
"""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

from madns_runtime.plugin.api import AgentContext
from madns_runtime.recording.reader import read_stream
from madns_runtime.simulations.constellation.flight.interface.answers import FlightAnswer

TICK_TOLERANCE = 1e-6
"""Rounding of times, in ticks."""


def tick_of(t_s: float, tick_hz: float) -> int:
    """Return the tick in which a step is taken: several have one where flight software is faster than its vehicle."""
    return math.ceil(t_s * tick_hz - TICK_TOLERANCE)


def held_answers(agent: AgentContext) -> HeldAnswers | None:
    """Return what holds the answers of an agent's program in a rerun of real time; None where they are carried out as they come."""
    folder = agent.parameters.recorded_agents
    return HeldAnswers(Path(folder, agent.name), agent.tick_hz) if folder else None


class HeldAnswers:
    """
    Answers of one agent's program that wait for their ticks; no more than the steps of a few of these.

    Args:
        folder: Of the agent's records; without an interface it has no times of answers.
        tick_hz: Of the agent, Hz.
    """

    def __init__(self, folder: Path, tick_hz: float) -> None:
        self._tick_hz = tick_hz
        self._held: deque[tuple[int, FlightAnswer, float]] = deque()
        self._late: dict[float, int] = {}
        """Ticks from asking to carrying out, by the simulated time of the asking, where it is more than one."""
        path = folder / "flight_answers.jsonl"
        if path.is_file():
            for _, asked_s, answer_us in read_stream(path).records():
                if (ticks := math.ceil(answer_us * 1e-6 * tick_hz)) > 1:
                    self._late[asked_s] = ticks

    def hold(self, answer: FlightAnswer, asked_s: float) -> None:
        """Take the answer to the step at simulated time *asked_s*, s."""
        due = tick_of(asked_s, self._tick_hz) + self._late.get(asked_s, 1)
        # One behind another is never carried out before it.
        self._held.append((max(due, self._held[-1][0] if self._held else due), answer, asked_s))

    def take(self, t_s: float) -> list[tuple[FlightAnswer, float]]:
        """Return what is due by the step at *t_s*, s, each answer with the time of the step that it answers."""
        tick, found = tick_of(t_s, self._tick_hz), []
        while self._held and self._held[0][0] <= tick:
            found.append(self._held.popleft()[1:])
        return found
