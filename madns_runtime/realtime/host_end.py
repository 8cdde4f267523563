"""
The end of a run's host as the supervisor of a detached run sees it: by the result that the host leaves beside its records.

No operator tells it, and agents that are away cannot. On another computer than the host's there is no such file: there a
supervisor ends with its agents, which find no host when they return.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from madns_runtime.config import AgentLaunch
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.result_file import RESULT_FILE

LOOK_S = 1.0
HOST_ENDED = "the host has ended"


def watch_host_end(launch: AgentLaunch, reactor: Reactor, end: Callable[[str], None]) -> None:
    """
    Look for the host's end every second from now on.

    Args:
        launch: The supervisor's.
        reactor: The loop.
        end: Called once, with why.
    """
    _look_at(Path(launch.directory, "host", RESULT_FILE), reactor, end)


def _look_at(result: Path, reactor: Reactor, end: Callable[[str], None]) -> None:
    if result.exists():
        end(HOST_ENDED)
    else:
        reactor.call_at(reactor.now_s() + LOOK_S, partial(_look_at, result, reactor, end))
