"""Steps of a verification, each in a process of its own that has a deadline."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
from collections.abc import Callable
from dataclasses import asdict
from time import monotonic

from madns_runtime.errors import MadnsError
from madns_runtime.hardware.verification.order import (
    STEP_S_MAX,
    Findings,
    VerificationFinding,
    finding,
)
from madns_runtime.plugin.isolation import said


def run_step(name: str, run: Callable[[], Findings]) -> Findings:
    """Return the findings of a step that runs in a process of its own, within its deadline."""
    read_fd, write_fd = os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        _child(name, run, write_fd)
    os.close(write_fd)
    data, until_s = b"", monotonic() + STEP_S_MAX
    while select.select([read_fd], [], [], max(0.0, until_s - monotonic()))[0]:
        block = os.read(read_fd, 65_536)
        if not block:
            break
        data += block
    os.close(read_fd)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(pid, signal.SIGKILL)
    status = os.waitpid(pid, 0)[1]
    try:
        return [VerificationFinding(**each) for each in json.loads(data)]
    except ValueError:
        code = os.waitstatus_to_exitcode(status)
        how = f"its process ended with {code}" if code != -signal.SIGKILL else "it did not return"
        return [finding(name, False, how, f"within {STEP_S_MAX:g} s")]


def _child(name: str, run: Callable[[], Findings], write_fd: int) -> None:
    """Run a step and tell its findings; never returns."""
    try:
        os.setpgid(0, 0)
        os.dup2(2, 1)  # a driver's own print is no finding
        try:
            findings = run()
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything
            text = str(error) if isinstance(error, MadnsError) else said(error)
            findings = [finding(name, False, text, "no error")]
        with open(write_fd, "wb") as file:
            file.write(json.dumps([asdict(each) for each in findings]).encode())
    finally:
        os._exit(0)
