"""The refusal to touch a run that still lives: where, how many processes, and what to do. Pure."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from cosmos_cli.counted import counted
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.names import compact

PROCESSES_SHOWN_MAX = 3
_SEVERAL_NAMES = re.compile(r"([^\s,]+),(?:\S+,)?([^\s,]+)(?= \(pid )")
"""Of a process that holds several agents: their names with commas."""


def still_running(run: str, living: Mapping[str, Sequence[str]]) -> InputError:
    """
    Return the refusal.

    Args:
        run: The run's name.
        living: In words, the processes on each machine; this computer's name is empty.
    """
    machines = compact(name for name in living if name)
    where = f" on {machines}" if machines else ""
    processes = [words for there in living.values() for words in there]
    shown = ", ".join(
        _SEVERAL_NAMES.sub(r"\1 ... \2", text) for text in processes[:PROCESSES_SHOWN_MAX]
    )
    if len(processes) > PROCESSES_SHOWN_MAX:
        shown = f"{counted(len(processes), 'process')}, such as {shown}"
    return InputError(
        f"{run} is still running{where}: {shown}; wait for its end, or end it with: cosmos down {run}"
    )
