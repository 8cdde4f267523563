"""Signals as the process of a host takes them, in either time mode."""

from __future__ import annotations

import signal
from collections.abc import Callable
from functools import partial

from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.scheduling import outlive_parent
from madns_runtime.reactor.watchdog import tell_stack_on


def heed_signals(reactor: Reactor, on_terminated: Callable[[], None], *, is_detached: bool) -> None:
    """
    Live on without the operator, whose silence ends the run in good order; a SIGTERM ends it too, and shows the stack.

    Args:
        reactor: The loop.
        on_terminated: Called in the loop: SIGTERM does not come from the operator, which has a line of its own.
        is_detached: Whether the run also outlives the operator's terminal.
    """
    if is_detached:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
    outlive_parent()
    tell_stack_on(signal.SIGTERM, partial(reactor.on_signal, signal.SIGTERM, on_terminated))
    reactor.on_signal(signal.SIGINT, lambda: None)  # a terminal's Ctrl-C is the operator's
