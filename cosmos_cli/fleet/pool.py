"""Many machines at once, a bounded number at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import TypeVar

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.outcome import Outcome
from cosmos_cli.fleet.target import Target

T = TypeVar("T")

FORKS_DEFAULT = 10
"""More threads than this gain little: the operator's processors are the limit (measured with 24 machines)."""
WAIT_S = 0.5
"""Between looks at the futures, so that Ctrl-C is heard."""


def for_each(
    targets: Sequence[Target],
    task: Callable[[Target], T],
    *,
    forks: int = FORKS_DEFAULT,
    on_done: Callable[[Outcome[T]], None] = lambda outcome: None,
) -> list[Outcome[T]]:
    """
    Do *task* for every machine and return all outcomes, in the order of *targets*.

    Every wait of *task* must have a deadline of its own.

    Args:
        targets: The machines.
        task: Called in a thread; what it raises becomes its machine's failure.
        forks: Machines at a time.
        on_done: Called in this thread as each machine is done.

    Raises:
        KeyboardInterrupt: Machines that had not begun are left alone.
    """
    outcomes: dict[str, Outcome[T]] = {}
    pool = ThreadPoolExecutor(
        max_workers=max(1, min(forks, len(targets))), thread_name_prefix="fleet"
    )
    try:
        waiting: set[Future[Outcome[T]]] = {pool.submit(_attempt, t, task) for t in targets}
        while waiting:
            done, waiting = wait(waiting, timeout=WAIT_S, return_when=FIRST_COMPLETED)
            for future in done:
                outcome = future.result()
                outcomes[outcome.machine] = outcome
                on_done(outcome)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
    return [outcomes[target.name] for target in targets]


def _attempt(target: Target, task: Callable[[Target], T]) -> Outcome[T]:
    start_s = time.monotonic()
    value: T | None = None
    failure: MachineFailure | None = None
    try:
        value = task(target)
    except MachineFailure as error:
        failure = error
    except Exception as error:  # noqa: BLE001 - one machine's surprise must not hide the others' results
        failure = MachineFailure(
            FailureKind.DEFECT,
            f"unexpected {type(error).__name__}: {error}",
            "this is a defect of COSMoS, please report it",
        )
    return Outcome(
        machine=target.name,
        value=value,
        failure=failure,
        duration_s=time.monotonic() - start_s,
    )
