"""Waiting for what must come, never longer than patience lasts; and whether a process lives."""

import time
from pathlib import Path

PATIENCE_S = 120.0
"""A busy machine is slow; what takes this long hangs."""
POLL_S = 0.02


def wait_until(condition, what="what was waited for", *, patience_s=PATIENCE_S, process=None):
    """
    Return what *condition* returns, once that is true.

    Args:
        condition: Asked again and again.
        what: Words for a failure, or a function that returns them.
        patience_s: How long at most.
        process: A `Popen` that must live meanwhile.
    """
    until_s = time.monotonic() + patience_s
    while not (value := condition()):
        is_over = process is not None and process.poll() is not None
        if is_over or time.monotonic() > until_s:
            if value := condition():  # it came while this process was not let run
                return value
            words = what() if callable(what) else what
            why = (
                f"it ended with {process.poll()} before" if is_over else f"not in {patience_s:g} s"
            )
            raise AssertionError(f"{why}: {words}")
        time.sleep(POLL_S)
    return value


def is_alive(pid):
    """Return whether a process has not ended; a zombie has."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text("utf-8", "replace")
    except (FileNotFoundError, ProcessLookupError):
        return False
    return stat.rpartition(")")[2].split()[0] not in "ZX"
