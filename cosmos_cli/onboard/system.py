"""
Requests to the system of a machine: services, and commands of the inventory.

A command may take long: while it runs, a piece is sent every second, so that a dead connection is noticed
soon. A command whose operator is gone goes on to its end, as a package manager must.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Generator, Iterator, Mapping, Sequence

from cosmos_cli.onboard.facts import (
    CONDITION_TIMEOUT_S,
    TOOL_TIMEOUT_S,
    condition_command,
    condition_holds,
    service_state,
)
from cosmos_cli.onboard.request_loop import (
    AnswerPiece,
    HelperRefusal,
    PlainValue,
    VerbRequest,
    last_words,
    verb,
)
from cosmos_cli.onboard.scratch import scratch_file

TYPE_CHECKING = False  # as in `request_loop`
if TYPE_CHECKING:
    from typing import BinaryIO

SIGN_OF_LIFE_S = 1.0
END_TIMEOUT_S = 5.0
OUTPUT_BYTES_MAX = 65_536
TOOL_FOLDERS = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Not on everybody's path in sessions that are not interactive; dpkg needs what lies there."""

NOT_DONE = "it ran, but its `{}` does not hold yet: the next `cosmos up` runs it again"


def running(command: Sequence[str], *, timeout_s: float) -> Iterator[AnswerPiece]:
    """
    Run a command to its end; the last piece holds "exit_status" and "output", the end of what it said.

    Raises:
        Refusal: TIMEOUT; it was killed.
    """
    with scratch_file() as output:
        process = start(command, output)
        end_s = time.monotonic() + timeout_s
        try:
            while (status := wait(process, SIGN_OF_LIFE_S)) is None:
                if time.monotonic() > end_s:
                    raise HelperRefusal("timeout", f"not done in {timeout_s:g} s")
                yield AnswerPiece(value={"is_running": True})
        finally:
            _see_to_end(process, end_s)
        yield AnswerPiece(value={"exit_status": status, "output": last_words(read_end(output))})


def start(command: Sequence[str], output: BinaryIO, **variables: str) -> subprocess.Popen[bytes]:
    """
    Start a program that goes on without anybody who listens; with *variables* in its environment.

    What it says goes to a file: it must not depend on anybody who reads.
    """
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env={**os.environ, "PATH": tool_path(), **variables},
        start_new_session=True,
    )


def read_end(output: BinaryIO, bytes_max: int = OUTPUT_BYTES_MAX) -> bytes:
    """Return the end of what a program said; by position, for the writer shares the file's own."""
    first = max(0, os.fstat(output.fileno()).st_size - bytes_max)
    return os.pread(output.fileno(), bytes_max, first)


def tool_path() -> str:
    """Return the path on which system programs are found, too."""
    paths = (*os.environ.get("PATH", "").split(":"), *TOOL_FOLDERS)
    return ":".join(dict.fromkeys(filter(None, paths)))


def wait(process: subprocess.Popen[bytes], timeout_s: float) -> int | None:
    """Wait for a program's end and return its exit status; None when it still runs."""
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def _see_to_end(process: subprocess.Popen[bytes], end_s: float) -> None:
    """Wait for a command that nobody listens to any more, until its time is over."""
    if wait(process, max(0.0, end_s - time.monotonic())) is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        wait(process, END_TIMEOUT_S)


@verb("command")
def command(request: VerbRequest) -> Iterator[AnswerPiece]:
    """
    Run a shell command unless it is done already.

    The last piece tells whether it "ran", and "notes": that its own condition does not hold even then.
    """
    asked = request.arguments
    if (yield from _is_done(asked)):
        yield AnswerPiece(value={"ran": False})
        return
    yield from _succeeding(["/bin/sh", "-c", asked["run"]], timeout_s=asked["timeout_s"])
    condition = "creates" if asked.get("creates") else "unless"
    is_done_now = yield from _is_done(asked)
    notes = [] if is_done_now else [NOT_DONE.format(condition)]
    yield AnswerPiece(value={"ran": True, "notes": notes})


def _is_done(asked: Mapping[str, PlainValue]) -> Generator[AnswerPiece, None, bool]:
    """Return whether a command's condition holds, with signs of life while it is asked."""
    if asked.get("creates"):
        return os.path.lexists(os.path.expanduser(asked["creates"]))
    status = None
    ask, limit_s = condition_command(asked["unless"]), CONDITION_TIMEOUT_S + TOOL_TIMEOUT_S
    for piece in running(ask, timeout_s=limit_s):
        status = piece.value.get("exit_status")
        if status is None:
            yield piece
    return condition_holds(asked["unless"], status)


def _succeeding(
    command: Sequence[str], name: str = "", *, timeout_s: float
) -> Iterator[AnswerPiece]:
    """
    Run a command with its signs of life.

    Raises:
        Refusal: It failed; the text says *name*, or else its exit status, and what it said. TIMEOUT as `running`.
    """
    for piece in running(command, timeout_s=timeout_s):
        status = piece.value.get("exit_status")
        if status is None:
            yield piece
        elif status:
            said = piece.value["output"]
            space = "\n" if "\n" in said else " "
            raise HelperRefusal("step", f"{name or f'exit status {status}'}:{space}{said}")


@verb("service")
def service(request: VerbRequest) -> Iterator[AnswerPiece]:
    """
    Have systemd do things with one service: "do" holds enable, disable, start, stop.

    With "may_be_new" the plan knew of no such unit: what is so by now, or is not there, is left alone. The last piece
    tells what it "did".
    """
    asked = request.arguments
    name, timeout_s = asked["name"] if asked.get("do") else "", asked["timeout_s"]
    did = []
    if asked.get("reload"):
        yield from _systemctl("daemon-reload", timeout_s=timeout_s)
    state = service_state(name) if asked.get("may_be_new") else {}
    for word in asked.get("do") or ():
        if not state or state[_STATE_OF[word]] in _UNDONE[word]:
            yield from _systemctl(word, name, timeout_s=timeout_s)
            did.append(word)
    yield AnswerPiece(value={"did": did if asked.get("do") else ["daemon-reload"]})


def _systemctl(*words: str, timeout_s: float) -> Iterator[AnswerPiece]:
    yield from _succeeding(
        ["systemctl", *words], f"systemctl {' '.join(words)}", timeout_s=timeout_s
    )


_STATE_OF = {"disable": "enabled", "stop": "active"}
_UNDONE = {
    "disable": ("enabled", "enabled-runtime", "linked", "linked-runtime"),
    "stop": ("active", "reloading", "activating"),
}
"""Words of systemd for a unit of which that is still to be done."""
