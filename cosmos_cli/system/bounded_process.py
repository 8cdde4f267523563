"""A program of this computer that is run to its end or, with all that it started, to its time's; and how one ended."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path

from madns_runtime.signal_names import signal_name


def path_word(path: Path) -> str:
    """Return a path as a word of a command line, where one that begins with a dash would be an option."""
    text = str(path)
    return f"./{text}" if text.startswith("-") else text


def run_bounded(
    command: Sequence[str],
    *,
    timeout_s: float,
    stdin: str = "",
    environment: Mapping[str, str] | None = None,
    pass_fds: Sequence[int] = (),
) -> subprocess.CompletedProcess[str]:
    """
    Run a program and return what it printed.

    Whatever ends the wait ends the program's children as well: one that hangs keeps the pipes open for ever.

    Raises:
        subprocess.TimeoutExpired: It was not done in time.
    """
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
        pass_fds=pass_fds,
    ) as process:
        try:
            said, complained = process.communicate(stdin, timeout=timeout_s)
        except BaseException:  # Ctrl-C too: a session of its own hears none
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            raise
    return subprocess.CompletedProcess(process.args, process.returncode, said, complained)


def describe_exit(returncode: int) -> str:
    """Return how a process ended, from subprocess's return code."""
    if returncode >= 0:
        return f"exited with code {returncode}"
    return f"was killed by {signal_name(-returncode)}"
