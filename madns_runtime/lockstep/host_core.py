"""The core of a lockstep run's host: what most of its other parts work with."""

from __future__ import annotations

from dataclasses import dataclass

from madns_runtime.config import RunConfig
from madns_runtime.lockstep.barrier import Barrier
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.host_half import LockstepHalf
from madns_runtime.lockstep.messages import Outbox
from madns_runtime.lockstep.result import RunAccount
from madns_runtime.lockstep.workers import WorkerPool
from madns_runtime.recording.run_journal import RunJournal


@dataclass(frozen=True, slots=True, kw_only=True)
class LockstepCore:
    """Workers, simulated time, records and simulation of one run."""

    config: RunConfig
    account: RunAccount
    clock: SimulatedClock
    pool: WorkerPool
    barrier: Barrier
    """Where workers are told and awaited."""
    outbox: Outbox
    """The host's messages."""
    half: LockstepHalf
    """The simulation's."""
    journal: RunJournal
