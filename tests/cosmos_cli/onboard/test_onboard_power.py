"""The runs that a reboot would end, asked through a helper process as over SSH."""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection, LocalStream
from cosmos_cli.fleet.reboot import PARTS
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard.processes import MARK

pytestmark = pytest.mark.process

NOBODY = 65534
MEMBER = """
import sys, time
from madns_runtime.processes import register

register("0007-own", "agent", "agent1", sys.argv[1])
print("ready", flush=True)
time.sleep(60)
"""
PROGRAM = "print('ready', flush=True); import time; time.sleep(60)"

Start = Callable[..., None]


@pytest.fixture
def start() -> Iterator[Start]:
    with contextlib.ExitStack() as stack:

        def start(*words: str, **options: object) -> None:
            process = stack.enter_context(
                subprocess.Popen(words, stdout=subprocess.PIPE, **options)  # type: ignore[call-overload]
            )
            stack.callback(process.kill)
            assert process.stdout.readline() == b"ready\n"

        yield start


def told(state: Path, connect: type[LocalConnection] = LocalConnection) -> dict[str, list[object]]:
    target = Target(name="pi01", address="127.0.0.1", connection="local")
    with Helper.start(connect(target), PARTS) as board:
        answer = board.call("boot", {"state": str(state), "root": str(state.parent)}).value
    return {name: answer[name] for name in ("living", "others")}


def test_run_of_another_folder_is_told_and_one_of_the_register_only_there(
    start: Start, tmp_path: Path
) -> None:
    state, own, other = (
        tmp_path / name for name in ("state", "runs/0007-own", "b/runs/0009-other")
    )
    environment = {**os.environ, "COSMOS_STATE_DIR": str(state), MARK: str(own)}
    start(sys.executable, "-c", MEMBER, str(own / "host"), env=environment)
    for _ in range(2):
        start(sys.executable, "-c", PROGRAM, env={**os.environ, MARK: str(other)})

    found = told(state)

    assert [entry["run"] for entry in found["living"]] == ["0007-own"]  # type: ignore[index]
    here = [words for words in found["others"] if str(tmp_path) in str(words)]
    assert here == [f"0009-other in {tmp_path}/b/runs"]


class OrdinaryConnection(LocalConnection):
    """This computer, as a user who is nobody."""

    def open(self, command: str) -> LocalStream:
        return super().open(
            f"exec setpriv --reuid {NOBODY} --regid {NOBODY} --clear-groups"
            f" env -i PATH=/usr/bin:/bin HOME=/nonexistent sh -c {shlex.quote(command)}"
        )


@pytest.mark.root
def test_run_of_another_user_is_told_by_its_command_line(start: Start, tmp_path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("asks as another user")
    # A shell stands for the program, whose environment another user may not read.
    script = "echo ready; read answer"
    start(
        *("/bin/sh", "-c", script, "sh", "-P", "-m", "madns_runtime.agent"),
        stdin=subprocess.PIPE,
        env={MARK: str(tmp_path / "runs/0009-other"), "PATH": "/usr/bin:/bin"},
    )

    found = told(tmp_path / "state", OrdinaryConnection)

    assert "a run of root" in found["others"]
    assert not [words for words in found["others"] if str(tmp_path) in str(words)]
