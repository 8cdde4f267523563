"""
Layout of COSMoS's folder on a machine: the one place that knows. Pure.

    <root>/trees/<hash>/            code and scenario files, by the hash of their content, never changed
    <root>/environments/<key>/      virtual environments, by the hash of their lock; whole when `.complete` is there
    <root>/wheels/<sha256>/         wheels that environments were made from
    <root>/runs/<run>-<session>/    what a run records there, until it is collected
    <root>/state/                   the register of processes, the lock, what was set and what it was before, what is unchecked
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import PurePosixPath

SESSION_CHARACTERS = 8


@dataclass(frozen=True, slots=True)
class Layout:
    """The paths below one machine's root, which may begin with ~."""

    root: str

    @property
    def trees(self) -> str:
        """Folder of all trees."""
        return self._below("trees")

    @property
    def environments(self) -> str:
        """Folder of all virtual environments."""
        return self._below("environments")

    @property
    def wheels(self) -> str:
        """Folder of all wheels."""
        return self._below("wheels")

    @property
    def runs(self) -> str:
        """Folder of all runs' records."""
        return self._below("runs")

    @property
    def state(self) -> str:
        """COSMOS_STATE_DIR of everything that runs there."""
        return self._below("state")

    @property
    def compiled(self) -> str:
        """Folder of what Python compiled for earlier versions, by the path of the source: only pruned."""
        return self._below("state", "pycache")

    @property
    def lock(self) -> str:
        """File that a command which changes the machine locks."""
        return self._below("state", "lock")

    def tree(self, tree_hash: str) -> str:
        """Folder of one tree."""
        return self._below("trees", tree_hash)

    def environment(self, key: str) -> str:
        """Folder of one environment."""
        return self._below("environments", key)

    def python(self, key: str) -> str:
        """Interpreter of one environment."""
        return self._below("environments", key, "bin/python")

    def run(self, run: str, session_hex: str) -> str:
        """Folder of one run's records; the session tells two operators' runs of one name apart."""
        return self._below("runs", f"{run}-{session_hex[:SESSION_CHARACTERS]}")

    def _below(self, *parts: str) -> str:
        return str(PurePosixPath(self.root, *parts))


def at_home(path: str, home: str) -> str:
    """Return a path of a machine without ~, which root would take for its own."""
    return home + path[1:] if path == "~" or path.startswith("~/") else path
