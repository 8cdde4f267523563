"""How a program on another machine ended, in words: one that never began, and one that ended with its connection."""

from __future__ import annotations

import contextlib
import os
import selectors
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import pytest
from harness.waiting import wait_until

from cosmos_cli.fleet.connection import StreamEnd
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.background import BackgroundTasks
from cosmos_cli.launch.child import RemoteProgram
from cosmos_cli.launch.machines import MachinePaths
from cosmos_cli.launch.remote_child import RemoteChild
from cosmos_cli.launch.run_events import LineBroke, Reattached, RunEvent

pytestmark = pytest.mark.process

LAUNCH = {"session_hex": "00" * 16, "reattach_s": 2.5}


class Started:
    """A program that is started on this computer as on a machine, and the operator's loop around it."""

    def __init__(self, run_directory: str, root: str) -> None:
        self.selector = selectors.DefaultSelector()
        self.background = BackgroundTasks(self.selector)
        self.connection = LocalConnection(Target(name="pi01", address="127.0.0.1"))
        self.told: list[RunEvent] = []
        paths = MachinePaths(
            root=root, state=root, python="/bin/echo", variables={}, base_directory=root
        )
        machine = SimpleNamespace(
            name="pi01",
            paths=paths,
            connection=self.connection,
            is_alive=lambda: True,
            connect_again=lambda: None,
            has_started_anew=lambda: False,
        )
        self.child = RemoteChild(
            RemoteProgram(
                name="agents@pi01",
                module="madns_runtime.agent",
                run_directory=run_directory,
                stderr="stderr.txt",
            ),
            machine,
            self.background,
            launch=LAUNCH,
            on_line=lambda line: None,
            tell=self.told.append,
        )

    def turn(self) -> None:
        for key, mask in self.selector.select(0.05):
            key.data(mask)

    def close(self) -> None:
        self.child.close()
        self.background.close(timeout_s=60.0)
        self.selector.close()


@pytest.fixture
def started(tmp_path) -> Iterator:
    with contextlib.ExitStack() as stack:

        def start(run_directory: str) -> Started:
            made = Started(run_directory, str(tmp_path))
            stack.callback(made.close)
            return made

        yield start


def wait_for(started: Started, condition) -> None:
    def is_so() -> bool:
        started.turn()
        return condition()

    wait_until(is_so, "nothing happened")


def test_program_that_never_began_is_told_with_the_reason(started, tmp_path):
    """As on a disk that has no room for the run's folder: nothing of it is on record, so nothing else tells."""
    (tmp_path / "file").touch()
    made = started(str(tmp_path / "file" / "runs" / "0001-c"))

    wait_for(made, made.child.has_exited)

    assert made.child.pid is None
    assert made.child.describe_exit().startswith("could not be started (mkdir: ")
    assert made.child.describe_exit().endswith("Not a directory)")


def test_program_that_is_gone_behind_a_broken_connection_is_told_as_such(
    started, tmp_path, monkeypatch
):
    made = started(str(tmp_path / "runs" / "0001-c"))
    monkeypatch.setattr(
        "cosmos_cli.launch.remote_child.fate_of", lambda stream, machine: (None, False)
    )
    wait_for(made, lambda: any(isinstance(event, LineBroke) for event in made.told))
    monkeypatch.setattr("cosmos_cli.launch.remote_child.reach_again", lambda *_: None)

    made.child.reattach()
    wait_for(made, made.child.has_exited)

    assert made.child.describe_exit() == "ended as the connection to it broke"


class Relay:
    """A stream whose program says something, and ends well, at once or when its far end is closed."""

    def __init__(self, said: bytes, *, is_ended: bool = True) -> None:
        self._out, self.far_end = os.pipe()
        os.set_blocking(self._out, False)
        os.write(self.far_end, said)
        if is_ended:
            os.close(self.far_end)

    def fileno(self) -> int:
        return self._out

    def read(self, count: int) -> bytes:
        return os.read(self._out, count)

    def write(self, data: bytes) -> int:
        return len(data)

    def ending(self, *, timeout_s: float) -> StreamEnd:
        return StreamEnd(exit_status=0, errors="")

    def close(self) -> None:
        os.close(self._out)


@pytest.mark.parametrize(
    ("said", "has_exited"), [(b"", False), (b'{"event": "attached", "commands": 0}\n', True)]
)
def test_program_that_has_not_greeted_over_a_new_line_is_not_taken_for_ended(
    started, tmp_path, monkeypatch, said, has_exited
):
    """It turns away whoever does not introduce themselves in time, as over a connection that stands still, and lives on."""
    made = started(str(tmp_path / "runs" / "0001-c"))
    monkeypatch.setattr(
        "cosmos_cli.launch.remote_child.fate_of", lambda stream, machine: (None, False)
    )
    wait_for(made, lambda: any(isinstance(event, LineBroke) for event in made.told))
    made.told.clear()
    monkeypatch.setattr("cosmos_cli.launch.remote_child.fate_of", lambda stream, machine: (0, True))
    monkeypatch.setattr("cosmos_cli.launch.remote_child.reach_again", lambda *_: (Relay(said), b""))

    made.child.reattach()
    wait_for(
        made,
        lambda: made.child.has_exited() or any(isinstance(event, LineBroke) for event in made.told),
    )

    assert made.child.has_exited() == has_exited


def test_end_of_a_line_that_another_one_has_replaced_is_none_of_the_program(
    started, tmp_path, monkeypatch
):
    """The program closes the old line for the new one: what became of the old one may be known later than that."""
    made = started(str(tmp_path / "runs" / "0001-c"))
    monkeypatch.setattr(
        "cosmos_cli.launch.remote_child.fate_of", lambda stream, machine: (None, False)
    )
    wait_for(made, lambda: any(isinstance(event, LineBroke) for event in made.told))
    greeting = b'{"event": "attached", "commands": 0}\n'
    old, new = Relay(greeting), Relay(greeting, is_ended=False)
    lines, is_replaced, asked = iter([old, new]), threading.Event(), []

    def fate(stream, machine) -> tuple[int, bool]:
        asked.append(stream)
        is_replaced.wait(60.0)
        return 0, True

    monkeypatch.setattr("cosmos_cli.launch.remote_child.fate_of", fate)
    monkeypatch.setattr("cosmos_cli.launch.remote_child.reach_again", lambda *_: (next(lines), b""))
    made.child.reattach()
    wait_for(made, lambda: asked)
    made.told.clear()
    made.child.reattach()
    wait_for(made, lambda: any(isinstance(event, Reattached) for event in made.told))
    made.told.clear()

    is_replaced.set()
    wait_for(made, lambda: not made.background.pending)

    assert (asked, made.child.has_exited(), made.told) == ([old], False, [])
    os.close(new.far_end)
