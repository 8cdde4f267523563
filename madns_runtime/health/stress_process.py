"""
A process that factorises primes until its standard input closes: `python -m madns_runtime.health.stress_process`.

Started by an agent whose timeline says so: its own program, since an agent's process has threads and must not fork.
"""

from __future__ import annotations

import os
import random
import select
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Final

from madns_runtime.health.stress import NUMBER_BITS, factorise

END_TIMEOUT_S: Final = 1.0
"""Time after which one that has not ended is killed, s."""


def start_stress_processes(workers: int) -> tuple[subprocess.Popen[bytes], ...]:
    """
    Start the processes; each uses what it gets of a processor, at ordinary niceness.

    Raises:
        OSError: No process can be started.
    """
    command = [sys.executable, "-P", "-m", __name__]
    return tuple(
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        for _ in range(workers)
    )


def end_stress_processes(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Have the processes end; a moment later `reap` finds that they did."""
    for process in processes:
        if process.stdin is not None:
            process.stdin.close()


def reap(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """Wait for processes that were told to end; who takes too long is killed."""
    for process in processes:
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main() -> None:
    """Factorise until standard input closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is the operator's
    numbers = random.Random(os.getpid())
    while not select.select([sys.stdin], [], [], 0)[0]:
        factorise(numbers.getrandbits(NUMBER_BITS) | 1)


if __name__ == "__main__":
    main()
