"""Whose each path in a run directory is: what one machine brought, no other may replace."""

from __future__ import annotations

import threading

from cosmos_cli.retrieve.notes import retrieved_paths
from cosmos_cli.retrieve.sources import Sources
from cosmos_cli.rundir import RunDirectory


class Claims:
    """
    Owners by plan, and of what no plan names whoever brought it first. For many threads.

    Args:
        run: What came earlier is in its notes.
        sources: What the plan says.
    """

    def __init__(self, run: RunDirectory, sources: Sources) -> None:
        self._sources = sources
        self._owners = dict(retrieved_paths(run))
        self._lock = threading.Lock()

    def claim(self, path: str, machine: str) -> str:
        """Return whose *path* is; *machine*'s if it was nobody's."""
        planned = self._sources.owner_of(path)
        if planned is not None:
            return planned
        with self._lock:
            return self._owners.setdefault(path, machine)
