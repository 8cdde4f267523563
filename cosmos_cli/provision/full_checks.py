"""
Which machine of a kind imports all that agents import, for the others of its kind.

What can make an import fail is the content, which is known by its hash, and what stands below it: processor, system,
Python. Machines that share all of it are of one *kind*. The first of a kind is checked in full, and the others, when it
has passed, by a start of their interpreter.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field

from cosmos_cli.models.machine_facts import MachineFacts
from cosmos_cli.provision.desired import DesiredState

WAIT_S_MAX = 30.0
"""For the first of a kind; who has waited so long makes a full check of its own."""


def machine_kind(facts: MachineFacts, desired: DesiredState) -> Hashable | None:
    """
    Return a machine's kind; None for one that has to be checked for itself.

    That is one whose processor is not known, and one whose environment takes packages from the distribution: their
    content has no hash.
    """
    environments = desired.environments
    if facts.board.processor_kind is None or any(e.content.sees_system for e in environments):
        return None
    board, python = facts.board, facts.python
    return (
        (board.model, board.machine, board.bits, board.processor_kind, board.kernel),
        (board.os_id, board.os_version, board.os_name),
        (python.version, python.executable, python.libc),
        frozenset(desired.packages),
        tuple(environment.key for environment in environments),
        tuple(tree.hash for tree in desired.trees),
    )


@dataclass(slots=True)
class _Kind:
    lock: threading.Lock = field(default_factory=threading.Lock)
    is_passed: bool = False
    has_failed: bool = False


class FullChecks:
    """The kinds that one command has met; used by many threads."""

    def __init__(self) -> None:
        self._kinds: dict[Hashable, _Kind] = {}
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def turn(self, kind: Hashable | None) -> Iterator[bool]:
        """
        Yield whether a machine of a kind must be checked in full; what is raised within fails that check.

        While the first is checked the others wait. When it fails, which may be its own fault, each is checked in full,
        and nobody waits for anybody any more.
        """
        if kind is None:
            yield True
            return
        with self._lock:
            state = self._kinds.setdefault(kind, _Kind())
        with _held(state.lock):
            is_full = not state.is_passed
            if is_full and not state.has_failed:
                yield from _judged(state)
                return
        if is_full:
            yield from _judged(state)
        else:
            yield False


def _judged(state: _Kind) -> Iterator[bool]:
    try:
        yield True
    except BaseException:
        state.has_failed = True
        raise
    state.is_passed = True


@contextlib.contextmanager
def _held(lock: threading.Lock) -> Iterator[None]:
    """Hold a lock, or go on without it after WAIT_S_MAX."""
    has_it = lock.acquire(timeout=WAIT_S_MAX)
    try:
        yield
    finally:
        if has_it:
            lock.release()
