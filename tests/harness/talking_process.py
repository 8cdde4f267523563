"""A command that is watched while it runs: what it says is read as it comes, and nobody waits without end."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from harness.waiting import wait_until

EXEC_LOOKS_MAX = 200
EXEC_POLL_S = 0.005


class Marked(NamedTuple):
    """A process with a test's mark in its environment."""

    pid: int
    command: str


class TalkingProcess:
    """One process after the other; `talk` is what the present one says on standard error."""

    patience_s = 120.0
    process: subprocess.Popen[str] | None = None

    def launch(self, command: Sequence[str], environment: Mapping[str, str], **more: Any) -> None:
        """Start a process, and read what it says."""
        self._lines: list[str] = []
        self.out = ""
        self.process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            **more,
        )
        self._threads = [
            threading.Thread(target=read, args=(self.process,), daemon=True)
            for read in (self._read_err, self._read_out)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def talk(self) -> str:
        """What it has said on standard error."""
        return "".join(self._lines)

    def wait_until(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait for something that must come."""
        return wait_until(condition, lambda: f"no {what}\n{self.talk}", patience_s=self.patience_s)

    def wait_for(self, text: str) -> None:
        """Wait until it has said something."""
        self.wait_until(lambda: text in self.talk, f"{text!r} in its talk")

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self.process is not None
        self.process.send_signal(number)

    def finish(self, patience_s: float | None = None) -> int:
        """Wait for its end, and return its exit code."""
        assert self.process is not None
        limit_s = self.patience_s if patience_s is None else patience_s
        try:
            code = self.process.wait(limit_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"did not end in {limit_s:g} s:\n{self.talk}") from None
        for thread in self._threads:
            thread.join(self.patience_s)
        return code

    def _read_err(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        for line in process.stderr:
            self._lines.append(line)
        process.stderr.close()

    def _read_out(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self.out = process.stdout.read()
        process.stdout.close()


def find_marked(*variables: str) -> list[Marked]:
    """Return the living processes, but this one, whose environment has all these `NAME=value`."""
    marks = {variable.encode() for variable in variables}
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal() and int(folder.name) != os.getpid():
            try:
                environment, command = _settled(folder)
                state = (
                    (folder / "stat").read_text("utf-8", "replace").rpartition(")")[2].split()[0]
                )
            except OSError:
                continue
            if marks <= set(environment.split(b"\0")) and state not in "ZX":
                text = command.replace(b"\0", b" ").decode(errors="replace").strip()
                found.append(Marked(int(folder.name), text))
    return found


def _settled(folder: Path) -> tuple[bytes, bytes]:
    """Return a process's environment and command; in the midst of an exec it has neither, as a kernel's never has."""
    for _ in range(EXEC_LOOKS_MAX):
        environment = (folder / "environ").read_bytes()
        command = (folder / "cmdline").read_bytes()
        if environment or command or not _has_program(folder):
            break
        time.sleep(EXEC_POLL_S)
    return environment, command


def _has_program(folder: Path) -> bool:
    """Return whether a process runs a program, as those of the kernel itself and those that have ended do not."""
    try:
        (folder / "exe").readlink()
    except OSError:
        return False
    return True
