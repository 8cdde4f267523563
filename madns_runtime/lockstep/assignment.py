"""The task of one worker of a lockstep run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from madns_runtime.config import DeviceLaunch, RunConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class Assignment:
    """The task of one worker."""

    config: RunConfig
    devices: tuple[DeviceLaunch, ...]
    """Devices of all agents."""
    directory: Path
    """The run directory."""
    agents: range
    position: memoryview
    """One integer that the host reads: agent's index times POSITIONS, plus what is done with it."""
