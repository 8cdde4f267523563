"""A process that does nothing but live, entered into a machine's register for a run."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

PROGRAM = """
import sys, time
from madns_runtime.processes import register

register(*sys.argv[1:])
print("ready", flush=True)
time.sleep(600)
"""


@contextlib.contextmanager
def registered(run: str, role: str, name: str, *, directory: Path, state: Path) -> Iterator[int]:
    """Run one, and give its pid."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, run, role, name, str(directory)],
        env={**os.environ, "COSMOS_STATE_DIR": str(state)},
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        yield process.pid
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
