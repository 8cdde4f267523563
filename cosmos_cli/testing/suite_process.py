"""
One run of a suite as a process: started, told to end at its deadline, and ended with all that it started.

No thread waits here: who looks after many asks each one in turn.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import IO, Any, Final

from cosmos_cli.launch.living_processes import LivingRun, living_runs
from cosmos_cli.system.parent_death import end_with_parent
from cosmos_cli.system.process_groups import signal_group
from cosmos_cli.testing.case import MACHINES
from madns_runtime.processes import end_process

CLEAN_END_S: Final = 60.0
"""For a run that was told to end, its records and its verdict included."""
DOCUMENT_BYTES_MAX: Final = 256 * 1024 * 1024
WORDS_BYTES_MAX: Final = 16_384
"""Of what a run said on stderr, its end."""


class Ending(Enum):
    """Progress of a process towards its end."""

    RUNNING = "running"
    TOLD = "told to end"
    KILLED = "killed"


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessResult:
    """End of a process."""

    exit_code: int
    """Negative: the number of the signal that killed it."""
    seconds: float
    document: Mapping[str, Any] = field(default_factory=dict)
    """run.json; empty if it came to none."""
    words: str = ""
    """The end of what it said on stderr."""
    is_too_long: bool = False
    """Whether its deadline passed."""
    directory: Path | None = None
    """Run directory; None if none is known."""


class SuiteProcess:
    """
    `cosmos run` of one test.

    Args:
        arguments: Words behind `cosmos run`.
        runs: Folder of its runs.
        deadline_s: Longest time that it may take, s.
        now_s: Monotonic time.
    """

    def __init__(
        self, arguments: Sequence[str], runs: Path, *, deadline_s: float, now_s: float
    ) -> None:
        self._runs = runs
        self._started_s = now_s
        self._end_s = now_s + deadline_s
        self._ending = Ending.RUNNING
        self._is_too_long = False
        self._run: LivingRun | None = None
        self._out: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - until it has ended
        self._words: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - as long
        command = [sys.executable, "-P", "-m", "cosmos_cli.start", "run", *arguments]
        self._process = subprocess.Popen(
            [*command, "--runs", str(runs), "--no-report", "--json", "--quiet"],
            stdin=subprocess.DEVNULL,
            stdout=self._out,
            stderr=self._words,
            env={name: value for name, value in os.environ.items() if name not in MACHINES},
            process_group=0,  # Ctrl-C comes once, by us
            preexec_fn=end_with_parent,  # noqa: PLW1509 - there is one thread
        )

    @property
    def pid(self) -> int:
        """Number of the process, and of its group."""
        return self._process.pid

    def poll(self, now_s: float) -> ProcessResult | None:
        """Return the end if it has come; tell the process to end, or kill it, when it is time."""
        if self._process.poll() is not None:
            return self._finished(now_s)
        if now_s >= self._end_s:
            if self._ending is Ending.RUNNING:
                self._is_too_long = True
                self.stop(now_s)
            elif self._ending is Ending.TOLD:
                self.kill()
        return None

    def stop(self, now_s: float) -> None:
        """Tell it to end; it is killed if it does not."""
        if self._ending is Ending.RUNNING:
            self._ending = Ending.TOLD
            self._end_s = now_s + CLEAN_END_S
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """End it and all that it started, at once."""
        with contextlib.suppress(OSError):  # without descriptors the group is killed all the same
            self._run = self._living_run()
        self._ending = Ending.KILLED
        signal_group(self.pid, signal.SIGKILL)
        for entry in self._run.processes if self._run else ():
            with contextlib.suppress(OSError):
                end_process(entry, signal.SIGKILL)

    def _living_run(self) -> LivingRun | None:
        return next(
            (
                run
                for run in living_runs()
                if any(entry.pid == self.pid for entry in run.of_role("operator"))
            ),
            None,
        )

    def _finished(self, now_s: float) -> ProcessResult:
        signal_group(self.pid, signal.SIGKILL)  # nobody of it should be left, and is not, as a rule
        document = self._document()
        directory = None
        if document:
            directory = self._runs / str(document["run"])
        elif self._run is not None:
            directory = Path(self._run.directory)
        result = ProcessResult(
            exit_code=self._process.returncode,
            seconds=now_s - self._started_s,
            document=document,
            words=self._said(),
            is_too_long=self._is_too_long,
            directory=directory,
        )
        self._out.close()
        self._words.close()
        return result

    def _document(self) -> Mapping[str, Any]:
        self._out.seek(0)
        try:
            found = json.loads(self._out.read(DOCUMENT_BYTES_MAX))
        except ValueError:
            return {}
        return found if isinstance(found, dict) and isinstance(found.get("run"), str) else {}

    def _said(self) -> str:
        size = self._words.seek(0, os.SEEK_END)
        self._words.seek(max(0, size - WORDS_BYTES_MAX))
        return self._words.read().decode(errors="replace").strip()
