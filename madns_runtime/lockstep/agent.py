"""One agent of a worker: its half of the simulation, its context, its records."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from madns_runtime.config import RunConfig
from madns_runtime.context import RunContext, check_sending
from madns_runtime.half import Half, Program
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.frames import POSITIONS, STEPPING, Sent
from madns_runtime.lockstep.post import Allowance, encode
from madns_runtime.lockstep.recorder import LockstepRecorder
from madns_runtime.plugin.api import HOST
from madns_runtime.protocol.messages import Service


@dataclass(frozen=True, slots=True, kw_only=True)
class Crewmates:
    """What the agents of one worker share."""

    config: RunConfig
    directory: Path
    """The run directory."""
    program: Program
    clock: SimulatedClock
    outbox: list[Sent] = field(default_factory=list)
    """What was sent since the last answer to the host, in order."""


class LockstepAgent:
    """
    One agent.

    Args:
        index: Its number among the run's agents, from 0.
        mates: What it shares with the others of its process.

    Raises:
        MachineError: It cannot record.
        HalfFailed: Its half cannot be made.
    """

    def __init__(self, index: int, mates: Crewmates) -> None:
        self.index = index
        self.name = mates.config.agents.resolved_names()[index]
        self._clock = mates.clock
        self._outbox = mates.outbox
        self.recorder = LockstepRecorder(
            mates.directory / "agents" / self.name,
            mates.config,
            source=self.name,
            clock=mates.clock,
        )
        self.half = Half(mates.program.make, self.recorder.say)
        self.step = self.half.simulation.step
        self.stepping = index * POSITIONS + STEPPING
        self.is_running = False
        self.deadlines_broken = 0
        self._allowance = Allowance()
        self.context = RunContext(
            name=self.name,
            config=mates.config,
            parameters=mates.program.parameters,
            recorder=self.recorder,
            now_s=mates.clock.now_s,
            send=self.send,
        )

    def send(
        self,
        to: str,
        message: Any,
        service: Service = Service.RELIABLE,
        *,
        deadline_s: float | None = None,
    ) -> None:
        """Send to the host's half; see `plugin.api.Context.send`."""
        check_sending(to, (HOST,), service, deadline_s, is_running=self.is_running)
        t_s = self._clock.t_s
        body = encode(message, service)
        self._allowance.take(len(body), t_s)
        if deadline_s is not None and deadline_s < t_s:  # it arrives when it is sent
            self.deadlines_broken += 1
            self.recorder.event("sync_deadline_broken", late_s=t_s - deadline_s)
        self._outbox.append(Sent(self.index, int(service), body))
