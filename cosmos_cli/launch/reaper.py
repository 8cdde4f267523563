"""
The end of children: SIGTERM, then SIGKILL to the whole process group, and the proof that nobody of it lives.

A child has ended when its group is empty, not merely when its leader has: a dead leader may leave
agents and workers behind.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from cosmos_cli.launch.children import GROUP_CHECK_S, KILL_WAIT_S, Child
from cosmos_cli.launch.deadlines import Deadlines

TERM_GRACE_S = 3.0
"""From SIGTERM to SIGKILL."""
GROUP_GRACE_S = 5.0
"""For what a dead child has left in its group: agents and workers end by themselves in this time."""


class Reaper:
    """
    Ends children and knows which have ended.

    Args:
        deadlines: The loop's.
        problem: Told which child it had to end or kill, and why in words.
    """

    def __init__(self, deadlines: Deadlines, problem: Callable[[Child, str], None]) -> None:
        self._deadlines = deadlines
        self._problem = problem
        self._killed: set[str] = set()
        self._gone: set[str] = set()

    def has_ended(self, child: Child) -> bool:
        """Tell whether nobody of the child's group lives, or even SIGKILL did not help."""
        return child.name in self._gone

    def leader_ended(self, child: Child) -> None:
        """Watch what a dead leader has left until it has ended too, or kill it."""
        self._check_group(child, time.monotonic() + GROUP_GRACE_S)

    def expect_end(self, child: Child, at_s: float, late: str) -> None:
        """End the child by force if it lives at *at_s*; *late* says what it failed to do."""
        action = partial(self.end, child, late)
        self._deadlines.set(_end_name(child), at_s, action)

    def end(self, child: Child, why: str) -> None:
        """SIGTERM now, SIGKILL after a grace."""
        if self.has_ended(child):
            return
        self._problem(child, f"{child.name} (pid {child.pid}) {why}: it is being ended")
        child.close_writing()
        child.signal(signal.SIGTERM)
        why = f"did not heed SIGTERM for {TERM_GRACE_S:g} s"
        at_s = time.monotonic() + TERM_GRACE_S
        self._deadlines.set(_end_name(child), at_s, partial(self.kill, child, why))

    def kill(self, child: Child, why: str) -> None:
        """SIGKILL to the whole group, now."""
        members = child.members()
        if members:
            pids = ", ".join(map(str, members))
            self._problem(
                child, f"{child.name} (pid {child.pid}) {why}: killed with SIGKILL ({pids})"
            )
        self._killed.add(child.name)
        child.signal(signal.SIGKILL)
        at_s = time.monotonic() + KILL_WAIT_S
        self._deadlines.set(_end_name(child), at_s, partial(self._gone.add, child.name))

    def forget(self, child: Child) -> None:
        """Take a child for ended: its machine is lost, and nothing can be done from here."""
        self._gone.add(child.name)
        self._deadlines.cancel(_end_name(child), f"group {child.name}")

    def kill_whatever_lives(self, children: Sequence[Child]) -> tuple[int, ...]:
        """
        Kill and wait, outside of the loop: the last resort, also when the loop itself has failed.

        Returns:
            Processes that outlived it.
        """
        with ThreadPoolExecutor(max(1, len(children))) as pool:
            left = [pid for pids in pool.map(_end_by_force, children) for pid in pids]
        for child in children:
            child.close()
        return tuple(left)

    def _check_group(self, child: Child, until_s: float) -> None:
        now_s = time.monotonic()
        members = child.members()
        if not members:
            self._gone.add(child.name)
            self._deadlines.cancel(_end_name(child))
            return
        if now_s >= until_s and child.name not in self._killed:
            self.kill(child, f"left {len(members)} running that should have ended with it")
        if not self.has_ended(child):
            again = partial(self._check_group, child, until_s)
            self._deadlines.set(f"group {child.name}", now_s + GROUP_CHECK_S, again)


def _end_by_force(child: Child) -> list[int]:
    return child.end_by_force()


def _end_name(child: Child) -> str:
    return f"end {child.name}"
