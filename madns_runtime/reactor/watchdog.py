"""
The end of a process whose loop hangs in a plug-in while whoever started it is gone.

A loop that runs notices by itself and ends in good order; only one that does not needs this.
"""

from __future__ import annotations

import faulthandler
import select
import sys
import threading
from collections.abc import Callable

_lock = threading.Lock()
_has_noticed = False
_watches = 0
"""Number of watches begun in this process: only the last one counts."""


def extend(grace_s: float) -> None:
    """Give a loop that noticed the hang-up itself *grace_s* to end in good order, instead of what was set."""
    global _has_noticed  # noqa: PLW0603 - one loop and one watchdog a process
    with _lock:
        _has_noticed = True
        faulthandler.dump_traceback_later(grace_s, exit=True, file=sys.__stderr__ or 2)


def tell_stack_on(number: int, listen: Callable[[], None] | None = None) -> None:
    """
    Have a signal first write to standard error where the main thread is: it may hang and never take note.

    Args:
        number: The signal's.
        listen: Sets what handles the signal besides; without it that stays.
    """
    faulthandler.unregister(number)  # before: it puts back what handled the signal when it came
    if listen is not None:
        listen()
    faulthandler.register(number, file=sys.__stderr__ or 2, all_threads=False, chain=True)


def end_after_hang_up(fd: int, grace_s: float) -> None:
    """
    End this process by force *grace_s* after the other end of *fd* has closed; see `extend`.

    Called again for a line that takes the place of one that has ended, it forgets that end.

    The thread it starts sleeps in the kernel until then and reads nothing. Who was stuck, and where,
    goes to standard error. The count-down needs no interpreter, so a call into C that never returns
    does not outlive it either.
    """
    global _has_noticed, _watches  # noqa: PLW0603 - one loop and one watchdog a process
    with _lock:
        _has_noticed = False
        _watches += 1
        mine = _watches
        faulthandler.cancel_dump_traceback_later()

    def watch() -> None:
        poll = select.poll()
        poll.register(fd, 0)  # a closed other end is told without being asked for
        poll.poll()
        with _lock:
            if _has_noticed or mine != _watches:
                return
            faulthandler.dump_traceback_later(grace_s, exit=True, file=sys.__stderr__ or 2)

    threading.Thread(target=watch, name="watchdog", daemon=True).start()
