"""How long this machine lets a thread wait that is ready to run: what a limit in seconds has to bear on a busy one."""

import threading
import time

NAP_S = 0.005


class MachineWaits:
    """
    Naps in a thread, and adds up by how much it is woken too late.

    A chain of events whose every link is woken by the one before takes its own time and about so much more; a
    path that polls or waits for a timeout takes that longer by itself, and gets nothing for it.
    """

    def __init__(self):
        self._waits = []
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._nap, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._is_over.set()
        self._thread.join()

    def between(self, begin_s, end_s):
        """Return the waits between two moments of the monotonic clock, s; each is its share in between."""
        # One that still goes on is not among them yet: who asks may have been let run first.
        while self._thread.is_alive() and not (self._waits and self._waits[-1][1] >= end_s):
            time.sleep(NAP_S)
        return sum(
            max(0.0, min(woken_s, end_s) - max(due_s, begin_s)) for due_s, woken_s in self._waits
        )

    def _nap(self):
        woken_s = time.monotonic()
        while not self._is_over.is_set():
            due_s = woken_s + NAP_S  # what comes between two naps is a wait, too
            time.sleep(NAP_S)
            woken_s = time.monotonic()
            self._waits.append((due_s, woken_s))
