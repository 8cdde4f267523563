"""
One `cosmos run` in a process of its own, which ends before this one does.

A run of its own process starts as a person's does: with no niceness, imports and garbage of runs before it. Stop
signals go on to it, and it ends cleanly by itself; should this process be killed, the kernel tells it to end.
"""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.system.parent_death import end_with_parent
from cosmos_cli.system.stop_signals import stop_signals_noted

CLEAN_END_S = 120.0
"""For the shutdown of a run that was told to end, records and verdict included."""
LAST_LINES_MAX = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class ChildRunOutcome:
    """End of one run."""

    exit_code: int
    document: Mapping[str, Any] = field(default_factory=dict)
    """run.json; empty if it came to none."""
    last_words: str = ""
    """Of a quiet run: the end of what it said on stderr."""
    is_interrupted: bool = False
    """Whether a stop signal came."""
    is_too_long: bool = False
    """Whether it was told to end, or killed, after its limit."""

    @property
    def is_last(self) -> bool:
        """Whether somebody interrupted it, so that no other is to follow; one that took too long was ended here."""
        ended = self.exit_code == ExitCode.INTERRUPTED and not self.is_too_long
        return self.is_interrupted or ended

    @property
    def run(self) -> str:
        """The run's name; empty if there was none."""
        return str(self.document.get("run") or "")


def run_arguments(
    *,
    inventory: Sequence[str] | None,
    limit: str | None,
    host: str | None,
    settings: Sequence[str],
) -> list[str]:
    """Return options of a command as arguments of the `cosmos run` that it starts."""
    arguments = [word for each in inventory or () for word in ("--inventory", each)]
    arguments += ["--limit", limit] if limit else []
    arguments += ["--host", host] if host else []
    return [*arguments, *(word for each in settings for word in ("--set", each))]


def run_child(
    arguments: Sequence[str], *, limit_s: float, is_quiet: bool, verb: str = "run"
) -> ChildRunOutcome:
    """
    Run to the end.

    Args:
        arguments: Those of `cosmos run`; --json and --quiet are added.
        limit_s: A run that takes longer is told to end, and later killed.
        is_quiet: Whether what it says is kept for `last_words` instead of shown.
        verb: The command.

    Raises:
        InputError: The run refused its input; with its words.
    """
    command = [sys.executable, "-P", "-m", "cosmos_cli.start", verb, *arguments, "--json"]
    with subprocess.Popen(
        [*command, "--quiet"] if is_quiet else command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE if is_quiet else None,
        process_group=0,  # Ctrl-C comes once, by us
        preexec_fn=end_with_parent,  # noqa: PLW1509 - there is one thread
    ) as process:
        try:
            with stop_signals_noted(partial(_send_on, process)) as stops:
                out, words, is_too_long = _communicate(process, limit_s)
        except BaseException:
            process.kill()
            raise
    document = _document(out)
    said = (words or b"").decode(errors="replace").strip()
    if process.returncode == ExitCode.BAD_INPUT and not document:
        raise InputError(said.removeprefix("error: ") or "the run refused its input; see above")
    return ChildRunOutcome(
        exit_code=process.returncode,
        document=document,
        last_words=" ".join(said.splitlines()[-LAST_LINES_MAX:]),
        is_interrupted=bool(stops),
        is_too_long=is_too_long,
    )


def _communicate(
    process: subprocess.Popen[bytes], limit_s: float
) -> tuple[bytes, bytes | None, bool]:
    """Return what the run printed and said, and whether it took longer than it may."""
    try:
        return *process.communicate(timeout=limit_s), False
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
    try:
        return *process.communicate(timeout=CLEAN_END_S), True
    except subprocess.TimeoutExpired:
        process.kill()
        return *process.communicate(), True


def _send_on(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(number)


def _document(out: bytes) -> Mapping[str, Any]:
    try:
        found = json.loads(out)
    except ValueError:
        return {}
    return found if isinstance(found, dict) and "run" in found else {}
