"""Threads for machines: many at once, a bounded number at a time; and one for work of this computer meanwhile."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

from cosmos_cli.errors import CosmosError
from cosmos_cli.fleet.failure import MachineFailure, unexpected
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.target import Target
from cosmos_cli.ui.step_times import WHOLE, timed

T = TypeVar("T")

FORKS_DEFAULT = 32
"""A real board keeps the operator waiting while it logs in: with 0.3 s each, 24 take 0.9 s at once and 1.6 s
with 10 forks. Where the operator's processors are the limit, as with virtual boards, more cost nothing."""
WAIT_S = 0.25
"""Time between looks at what is done, so that Ctrl-C is heard on every platform."""


def for_each(
    targets: Sequence[Target],
    task: Callable[[Target], T],
    *,
    forks: int = FORKS_DEFAULT,
    on_done: Callable[[Outcome[T]], None] = lambda outcome: None,
    on_wait: Callable[[], None] = lambda: None,
) -> list[Outcome[T]]:
    """
    Do *task* for every machine and return all outcomes, in the order of *targets*.

    Every wait of *task* must have a deadline of its own. The threads are daemons: an interrupted command
    ends without waiting for machines that do not answer.

    Args:
        targets: The machines.
        task: Called in a thread; what it raises becomes its machine's failure.
        forks: Machines at a time.
        on_done: Called in this thread as each machine is done.
        on_wait: Called in this thread when nobody was done for WAIT_S.

    Raises:
        KeyboardInterrupt: Machines that had not begun are left alone.
        CosmosError: One that *task* raised, such as a fault in the operator's own files.
    """
    waiting = deque(enumerate(targets))
    done: SimpleQueue[tuple[int, Outcome[T] | CosmosError]] = SimpleQueue()
    outcomes: dict[int, Outcome[T]] = {}
    try:
        for number in range(max(1, min(forks, len(targets)))):
            worker = threading.Thread(
                target=_work, args=(waiting, task, done), name=f"fleet-{number}", daemon=True
            )
            worker.start()
        while len(outcomes) < len(targets):
            try:
                index, outcome = done.get(timeout=WAIT_S)
            except Empty:
                on_wait()
                continue
            if isinstance(outcome, CosmosError):
                raise outcome
            outcomes[index] = outcome
            on_done(outcome)
    finally:
        waiting.clear()
    return [outcomes[index] for index in range(len(targets))]


def _work(
    waiting: deque[tuple[int, Target]],
    task: Callable[[Target], T],
    done: SimpleQueue[tuple[int, Outcome[T] | CosmosError]],
) -> None:
    while True:
        try:
            index, target = waiting.popleft()
        except IndexError:
            return
        done.put((index, _attempt(target, task)))


def _attempt(target: Target, task: Callable[[Target], T]) -> Outcome[T] | CosmosError:
    start_s = time.monotonic()
    value: T | None = None
    failure: MachineFailure | None = None
    try:
        with timed(target.name, WHOLE):
            value = task(target)
    except MachineFailure as error:
        failure = error
    except CosmosError as error:
        return error
    except Exception as error:  # noqa: BLE001 - one machine's surprise must not hide the others' results
        failure = unexpected(error)
    return Outcome(
        machine=target.name,
        value=value,
        failure=failure,
        duration_s=time.monotonic() - start_s,
    )


class BackgroundCall(Generic[T]):
    """
    A function that is called at once, in a thread of its own.

    Args:
        function: What it returns or raises is had by `result`, from any thread, as often as wanted.
    """

    def __init__(self, function: Callable[[], T]) -> None:
        self._function = function
        self._value: T
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="background", daemon=True)
        self._thread.start()

    def result(self) -> T:
        """Wait for the function's end; return what it returned, or raise what it raised."""
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._value

    def _run(self) -> None:
        try:
            self._value = self._function()
        except BaseException as error:  # noqa: BLE001 - it is raised where the result is asked for
            self._error = error
