"""
The end of a run's host as the supervisor of a detached run sees it: by the result that the host leaves beside its records.

No operator tells it, and agents that are away cannot. On another computer than the host's there is no such file: there a
supervisor ends with its agents, which find no host when they return.
"""

from __future__ import annotations

from collections.abc import Callable, Sized
from functools import partial
from pathlib import Path

from madns_runtime.config import AgentLaunch
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.recording.result_file import RESULT_FILE

LOOK_S = 1.0
HOST_ENDED = "the host has ended"


def watch_host_end(
    launch: AgentLaunch, reactor: Reactor, children: Sized, end: Callable[[str], None]
) -> None:
    """
    Look for the host's end every second from now on.

    Args:
        launch: The supervisor's.
        reactor: The loop.
        children: Processes that live. Without any the end is at once; those that still close their records have time for it.
        end: Called then, with why.
    """
    result = Path(launch.directory, "host", RESULT_FILE)
    grace_s = launch.config.timeouts.shutdown_s
    _look(result, reactor, partial(_end_soon, reactor, children, partial(end, HOST_ENDED), grace_s))


def _look(result: Path, reactor: Reactor, found: Callable[[], None]) -> None:
    if result.exists():
        found()
    else:
        reactor.call_at(reactor.now_s() + LOOK_S, partial(_look, result, reactor, found))


def _end_soon(reactor: Reactor, children: Sized, end: Callable[[], None], grace_s: float) -> None:
    if children:
        reactor.call_at(reactor.now_s() + grace_s, end)
    else:
        end()
