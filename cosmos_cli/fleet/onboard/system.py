"""
What the system of a machine is asked to do: services, and commands of the inventory.

A command may take long: while it runs, a part is sent every second, so that a dead connection is noticed
soon. A command whose operator is gone goes on to its end, as a package manager must.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence

from cosmos_cli.fleet.onboard.core import Part, Refusal, Request, last_words, verb
from cosmos_cli.fleet.onboard.facts import is_done

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    from typing import Any

SIGN_OF_LIFE_S = 1.0
END_TIMEOUT_S = 5.0
OUTPUT_BYTES_MAX = 65_536
TOOL_FOLDERS = ("/usr/local/sbin", "/usr/sbin", "/sbin")
"""Not on everybody's path in sessions that are not interactive."""

NOT_DONE = "it ran, but its `{}` does not hold yet: the next `cosmos up` runs it again"


def running(
    command: Sequence[str],
    *,
    timeout_s: float,
    environment: Mapping[str, str] | None = None,
) -> Iterator[Part]:
    """
    Run a command to its end; the last part holds "exit_status" and "output", the end of what it said.

    Raises:
        Refusal: TIMEOUT; it was killed.
    """
    import tempfile

    paths = (*os.environ.get("PATH", "").split(":"), *TOOL_FOLDERS)
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={
                **os.environ,
                "PATH": ":".join(dict.fromkeys(filter(None, paths))),
                **(environment or {}),
            },
            start_new_session=True,
        )
        end_s = time.monotonic() + timeout_s
        try:
            while (status := _wait(process, SIGN_OF_LIFE_S)) is None:
                if time.monotonic() > end_s:
                    raise Refusal("timeout", f"not done in {timeout_s:g} s")
                yield Part(value={"is_running": True})
        finally:
            _see_to_end(process, end_s)
        size = output.seek(0, os.SEEK_END)
        output.seek(max(0, size - OUTPUT_BYTES_MAX))
        yield Part(value={"exit_status": status, "output": last_words(output.read())})


def _wait(process: subprocess.Popen[bytes], timeout_s: float) -> int | None:
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return None


def _see_to_end(process: subprocess.Popen[bytes], end_s: float) -> None:
    """Wait for a command that nobody listens to any more, until its time is over."""
    if _wait(process, max(0.0, end_s - time.monotonic())) is None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        _wait(process, END_TIMEOUT_S)


@verb("command")
def command(request: Request) -> Iterator[Part]:
    """
    Run a shell command unless it is done already.

    The last part tells whether it "ran", and "notes": that its own condition does not hold even then.
    """
    asked = request.arguments
    if _is_done(asked):
        yield Part(value={"ran": False})
        return
    for part in running(["/bin/sh", "-c", asked["run"]], timeout_s=asked["timeout_s"]):
        status = part.value.get("exit_status")
        if status is None:
            yield part
        elif status:
            raise Refusal("step", _failed(f"exit status {status}", part.value["output"]))
    notes = (
        []
        if _is_done(asked)
        else [NOT_DONE.format("creates" if asked.get("creates") else "unless")]
    )
    yield Part(value={"ran": True, "notes": notes})


def _is_done(asked: Mapping[str, Any]) -> bool:
    if asked.get("creates"):
        return os.path.lexists(os.path.expanduser(asked["creates"]))
    return is_done(asked["unless"], as_root=False)


def _failed(how: str, said: str) -> str:
    return f"{how}: {said}" if "\n" not in said else f"{how}:\n{said}"


@verb("service")
def service(request: Request) -> Iterator[Part]:
    """Have systemd do things with one service: "do" holds enable, disable, start, stop."""
    asked = request.arguments
    wanted = []
    if asked.get("reload"):
        wanted.append(["daemon-reload"])
    for verb_ in asked.get("do") or ():
        wanted.append([verb_, asked["name"]])
    for words in wanted:
        for part in running(["systemctl", *words], timeout_s=asked["timeout_s"]):
            status = part.value.get("exit_status")
            if status is None:
                yield part
            elif status:
                said = part.value["output"]
                raise Refusal("step", _failed(f"systemctl {' '.join(words)}", said))
