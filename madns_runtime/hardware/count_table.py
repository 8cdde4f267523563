"""Counts of one device in memory that processes share: they outlive the process that counts."""

from __future__ import annotations

from typing import Final

from madns_runtime.errors import PluginError

CELLS_MAX: Final = 1280
"""Names of one device: all that is counted of 64 channels, and of agents. What is counted under more is counted under REST."""
NUMBER_MAX: Final = 1e15
"""Counted at once: whole numbers of a float64 reach further, and sums of them do."""
NAME_BYTES: Final = 56
"""Of a name; a longer one is cut."""
REST: Final = "others"
CELL_BYTES: Final = NAME_BYTES + 8
TABLE_BYTES: Final = CELLS_MAX * CELL_BYTES
NOT_FINITE: Final = "_not_finite"
"""Behind an input's name: how often it was no number."""
BEYOND_LIMITS: Final = "_beyond_limits"
"""Behind an input's name: how often it was beyond its limits, and is handed on as it is."""
MISSED: Final = "missed:"
"""Before an agent's name: how many messages were given up that it did not take."""


def missed_name(agent: str) -> str:
    """Return the name under which is counted what an agent did not take; of a long name the end."""
    return f"{MISSED}{agent[len(MISSED) - NAME_BYTES :]}"


class CountTable:
    """
    Names with a number each. One process counts, any reads; who counts anew in its place goes on with the same numbers.

    Args:
        view: TABLE_BYTES of shared memory, zero at first.
    """

    def __init__(self, view: memoryview) -> None:
        self._names = view[: CELLS_MAX * NAME_BYTES]
        self._numbers = view[CELLS_MAX * NAME_BYTES : TABLE_BYTES].cast("d")
        self._cells: dict[str, int] = {}
        """Places of the names that this process knows."""

    def add(self, name: str, number: int = 1) -> int:
        """
        Add to a count, and return what it has come to.

        Raises:
            PluginError: It has no name, or is no number: who reads the count would fail at that.
        """
        if not name or not abs(number) <= NUMBER_MAX:
            raise PluginError(
                f"expected a name and a number to count, got {name!r:.80}, {number!r:.40}"
            )
        cell = self._cells.get(name)
        if cell is None:
            cell = self._cells[name] = self._cell_of(name)
        self._numbers[cell] += number
        return int(self._numbers[cell])

    def read(self) -> dict[str, int]:
        """Return all counts by name."""
        return {name: int(self._numbers[cell]) for cell, name in enumerate(self._known())}

    def _cell_of(self, name: str) -> int:
        """Return the place of a name, which may be an earlier process's, or take a new one."""
        known = self._known()
        wanted = name.encode()[:NAME_BYTES].decode(errors="ignore")
        if len(known) >= CELLS_MAX - 1 and wanted not in known:
            wanted = REST
        if wanted in known:
            return known.index(wanted)
        cell, data = len(known), wanted.encode()
        # The first byte last: a name that is half written by a process that is killed is none.
        start = cell * NAME_BYTES
        self._names[start + 1 : start + NAME_BYTES] = data[1:].ljust(NAME_BYTES - 1, b"\0")
        self._names[start] = data[0]
        return cell

    def _known(self) -> list[str]:
        names: list[str] = []
        for start in range(0, CELLS_MAX * NAME_BYTES, NAME_BYTES):
            data = bytes(self._names[start : start + NAME_BYTES])
            if not data[0]:
                break
            names.append(data.rstrip(b"\0").decode(errors="replace"))
        return names
