"""An operator whose connection broke: it comes back, sees what was said meanwhile, once, or is gone after a while."""

from __future__ import annotations

import json
import os
import select
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic
from typing import Any

import pytest

from madns_runtime.config import OPERATOR_SOCKET, RELAY_CONNECTED, RELAY_NOBODY
from madns_runtime.private_socket import socket_address
from madns_runtime.reactor import operator_link, reattachment
from madns_runtime.reactor.operator_link import OperatorLink
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.reactor.reattachment import Reattachment

pytestmark = pytest.mark.process

SESSION = "0123456789abcdef"
WAIT_S = 120.0
"""A bound, not an expectation."""


class Stage:
    """A link with a way back, and both ends of its first line."""

    def __init__(self, directory: Path, *, wait_s: float = WAIT_S) -> None:
        self.directory = directory
        self.reactor = Reactor()
        self.commands: list[dict[str, Any]] = []
        self.gone: list[bool] = []
        self.attached: list[bool] = []
        self.ends = [*os.pipe(), *os.pipe()]
        self.link = OperatorLink(
            self.reactor,
            (self.ends[0], self.ends[3]),
            on_command=self.commands.append,
            on_gone=lambda: self.gone.append(True),
            way_back=Reattachment(directory=directory, session_hex=SESSION, wait_s=wait_s),
            on_attached=lambda: self.attached.append(True),
        )
        self.visitors: list[socket.socket] = []

    def break_line(self) -> None:
        for end in (self.ends[1], self.ends[2]):
            os.close(end)
        self.run_until(lambda: self.link.is_cut or self.link.is_gone)

    def visit(self, seen: int = 0, **changes: Any) -> socket.socket:
        visitor = self.knock()
        self.introduce(visitor, seen, **changes)
        return visitor

    def knock(self) -> socket.socket:
        visitor = socket.socket(socket.AF_UNIX)
        self.visitors.append(visitor)
        visitor.settimeout(WAIT_S)
        with socket_address(self.directory, OPERATOR_SOCKET.format(1)) as address:
            visitor.connect(address)
        return visitor

    def introduce(self, visitor: socket.socket, seen: int = 0, **changes: Any) -> None:
        asked = {"command": "attach", "session": SESSION, "incarnation": 1, "seen": seen, **changes}
        visitor.sendall(json.dumps(asked).encode() + b"\n")

    def run_until(self, condition: Callable[[], Any]) -> None:
        until_s = self.reactor.now_s() + WAIT_S

        is_met = False

        def look() -> None:
            nonlocal is_met
            is_met = bool(condition())
            if is_met or self.reactor.now_s() > until_s:
                self.reactor.stop()
            else:
                self.reactor.call_at(self.reactor.now_s() + 0.01, look)

        look()
        self.reactor.run()
        assert is_met

    def close(self) -> None:
        self.link.close()
        self.reactor.close()
        for visitor in self.visitors:
            visitor.close()
        for end in self.ends:
            try:
                os.close(end)
            except OSError:
                continue


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Stage]]:
    made: list[Stage] = []

    def make_one(directory: Path = tmp_path, **how: Any) -> Stage:
        made.append(Stage(directory, **how))
        return made[-1]

    yield make_one
    for stage in made:
        stage.close()


def said(visitor: socket.socket, count: int) -> list[dict[str, Any]]:
    data = b""
    while data.count(b"\n") < count:
        assert (more := visitor.recv(65_536)), data
        data += more
    return [json.loads(line) for line in data.splitlines()]


def test_events_that_were_not_seen_come_once_and_in_order_to_an_operator_that_is_back(make) -> None:
    stage = make()
    for n in range(1, 4):
        stage.link.emit({"event": "x", "n": n})
    stage.break_line()
    stage.link.emit({"event": "x", "n": 4})

    visitor = stage.visit(seen=2)
    stage.run_until(lambda: stage.attached)
    stage.link.emit({"event": "x", "n": 5})

    hello, *events = said(visitor, 4)
    assert hello == {"event": "attached", "commands": 0}
    assert [(event["n"], event["number"]) for event in events] == [(3, 3), (4, 4), (5, 5)]
    assert (stage.link.is_cut, stage.gone) == (False, [])


def test_what_the_operator_has_seen_is_forgotten(make) -> None:
    stage = make()
    stage.link.emit({"event": "x"})
    stage.link.emit({"event": "y"})
    os.write(stage.ends[1], b'{"command": "ping", "n": 1, "seen": 1}\n')
    stage.run_until(
        lambda: (
            select.select([stage.ends[2]], [], [], 0)[0] and b"pong" in os.read(stage.ends[2], 999)
        )
    )
    stage.break_line()

    visitor = stage.visit(seen=0)
    stage.run_until(lambda: stage.attached)

    assert [event["event"] for event in said(visitor, 2)] == ["attached", "y"]


def test_commands_are_obeyed_once(make) -> None:
    stage = make()
    os.write(stage.ends[1], b'{"command": "a", "number": 1}\n')
    stage.run_until(lambda: stage.commands)
    stage.break_line()

    visitor = stage.visit()
    stage.run_until(lambda: stage.attached)
    visitor.sendall(b'{"command": "a", "number": 1}\n{"command": "b", "number": 2}\n')
    stage.run_until(lambda: len(stage.commands) > 1)

    assert said(visitor, 1)[0]["commands"] == 1
    assert [command["command"] for command in stage.commands] == ["a", "b"]


def test_line_breaks_and_comes_back_again_and_again(make) -> None:
    stage = make()
    stage.break_line()
    for n in range(1, 4):
        visitor = stage.visit(seen=n - 1)
        stage.run_until(lambda n=n: len(stage.attached) == n)
        stage.link.emit({"event": "x", "n": n})
        assert said(visitor, 2)[1]["n"] == n
        visitor.close()
        stage.run_until(lambda: stage.link.is_cut)

    assert stage.gone == []


def test_new_line_takes_the_place_of_one_that_has_not_ended_here(make) -> None:
    stage = make()

    visitor = stage.visit()
    stage.run_until(lambda: stage.attached)
    stage.link.emit({"event": "x"})

    assert said(visitor, 2)[1]["event"] == "x"
    with pytest.raises(BrokenPipeError):
        os.write(stage.ends[1], b"x")  # its reader is gone


def test_operator_that_does_not_come_back_in_time_is_gone(make) -> None:
    stage = make(wait_s=0.2)
    stage.break_line()

    stage.run_until(lambda: stage.gone)

    assert stage.link.is_gone


def test_operator_that_is_back_and_sends_no_pings_is_gone(make, monkeypatch) -> None:
    monkeypatch.setattr(operator_link, "PING_SILENCE_S", 0.2)
    stage = make()
    stage.break_line()
    stage.visit()
    stage.run_until(lambda: stage.attached)

    stage.run_until(lambda: stage.gone)

    assert stage.link.is_gone


def test_operator_that_means_the_end_of_its_line_is_gone_at_once(make) -> None:
    stage = make()
    os.write(stage.ends[1], b'{"command": "leave"}\n')
    stage.break_line()

    assert (stage.link.is_cut, stage.gone) == (False, [True])


def test_operator_that_came_while_the_loop_was_busy_is_heard(make) -> None:
    stage = make(wait_s=0.2)
    stage.break_line()
    visitor = stage.visit()
    threading.Event().wait(0.4)  # the plug-in's call

    stage.run_until(lambda: stage.attached or stage.gone)

    assert (stage.gone, said(visitor, 1)[0]["event"]) == ([], "attached")


@pytest.mark.parametrize(
    "wrong",
    [{"session": "ffff"}, {"incarnation": 2}, {"command": "stop"}, {"seen": "all"}],
    ids=lambda wrong: next(iter(wrong)),
)
def test_visitor_that_belongs_elsewhere_is_turned_away_and_the_right_one_let_in(
    make, wrong
) -> None:
    stage = make()
    stage.break_line()
    stranger, visitor = stage.visit(**wrong), stage.visit()

    stage.run_until(lambda: stage.attached)

    assert stranger.recv(100) == b""
    assert said(visitor, 1)[0]["event"] == "attached"


def test_visitor_that_says_nothing_does_not_keep_others_out(make, monkeypatch) -> None:
    monkeypatch.setattr(reattachment, "ATTACH_LINE_S", 0.1)
    stage = make()
    stage.break_line()
    mute = socket.socket(socket.AF_UNIX)
    with mute, socket_address(stage.directory, OPERATOR_SOCKET.format(1)) as address:
        mute.connect(address)
        stage.visit()

        stage.run_until(lambda: stage.attached)


def test_visitor_whose_line_came_while_the_loop_was_busy_is_let_in(make, monkeypatch) -> None:
    monkeypatch.setattr(reattachment, "ATTACH_LINE_S", 0.2)
    stage = make()
    stage.break_line()
    visitor = stage.knock()
    stage.run_until(lambda: stage.link._attach_socket.has_client)
    stage.introduce(visitor)
    threading.Event().wait(0.4)  # the plug-in's call

    stage.run_until(lambda: stage.attached or not stage.link._attach_socket.has_client)

    assert stage.attached


def test_events_that_do_not_fit_are_dropped_oldest_first_and_counted(make, monkeypatch) -> None:
    monkeypatch.setattr(reattachment, "KEPT_BYTES_MAX", 10_000)
    stage = make()
    stage.break_line()
    for n in range(100):
        stage.link.emit({"event": "x", "n": n, "text": "x" * 1000})

    visitor = stage.visit()
    stage.run_until(lambda: stage.attached)

    events = said(visitor, 10)[1:]
    assert [event["n"] for event in events] == list(range(91, 100))
    assert stage.link.dropped_count == 91


def test_last_event_is_told_although_the_line_breaks_at_the_end(make) -> None:
    stage = make()
    stage.break_line()
    stage.link.emit({"event": "finished"})
    visitor = stage.visit()
    flushed: list[bool] = []

    def hear() -> None:
        flushed.append(said(visitor, 2)[1]["event"] == "finished")
        visitor.sendall(b'{"command": "seen", "seen": 1}\n')

    operator = threading.Thread(target=hear)
    operator.start()

    assert stage.link.flush(WAIT_S)
    operator.join()
    assert flushed == [True]


def test_last_event_is_told_to_an_operator_that_is_back_after_the_time_for_it(
    make, monkeypatch
) -> None:
    stage = make(wait_s=10 * WAIT_S)
    stage.break_line()
    stage.link.emit({"event": "finished"})
    visitor = stage.visit()
    later_s = iter([0.0])
    monkeypatch.setattr(operator_link, "monotonic", lambda: monotonic() + next(later_s, 2 * WAIT_S))

    def hear() -> None:
        said(visitor, 2)
        visitor.sendall(b'{"command": "seen", "seen": 1}\n')

    operator = threading.Thread(target=hear)
    operator.start()

    assert stage.link.flush(WAIT_S)
    operator.join()


def test_end_does_not_wait_for_ever_for_an_operator_that_does_not_come(make) -> None:
    stage = make(wait_s=0.2)
    stage.break_line()
    stage.link.emit({"event": "finished"})

    assert not stage.link.flush(0.1)


def test_socket_is_for_its_user_alone_and_goes_with_the_link(make, tmp_path: Path) -> None:
    stage = make()
    path = tmp_path / OPERATOR_SOCKET.format(1)
    mode = path.stat().st_mode

    stage.close()

    assert (stat.S_ISSOCK(mode), stat.S_IMODE(mode)) == (True, 0o600)
    assert not path.exists()


def test_socket_lies_in_a_folder_with_a_path_longer_than_a_sockets_may_be(make, tmp_path) -> None:
    folder = tmp_path / ("long" * 30)
    folder.mkdir()
    stage = make(folder)
    stage.break_line()

    stage.visit()

    stage.run_until(lambda: stage.attached)


@pytest.mark.parametrize("kind", ["folder", "file"])
def test_link_in_the_sockets_place_is_not_followed_and_the_run_goes_without(
    make, tmp_path: Path, kind: str
) -> None:
    target = tmp_path / "target"
    folder = tmp_path / "folder"
    if kind == "folder":
        target.mkdir()
        folder.symlink_to(target)
    else:
        folder.mkdir()
        (folder / OPERATOR_SOCKET.format(1)).symlink_to(target)

    stage = make(folder)

    assert b"a broken connection would end what runs here" in os.read(stage.ends[2], 65_536)
    assert not target.exists() or not list(target.iterdir())
    stage.break_line()
    assert stage.gone == [True]


def test_relay_carries_both_ways_and_ends_with_the_process(make, monkeypatch) -> None:
    stage = make()
    stage.break_line()
    command = [sys.executable, "-m", "madns_runtime.reactor.relay", str(stage.directory)]
    name = OPERATOR_SOCKET.format(1)
    relay = subprocess.Popen(
        [*command, name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
    )
    assert relay.stdin is not None and relay.stdout is not None
    asked = {"command": "attach", "session": SESSION, "incarnation": 1, "seen": 0}
    relay.stdin.write(json.dumps(asked).encode() + b'\n{"command": "a"}\n')
    stage.run_until(lambda: stage.commands)
    assert relay.stdout.readline() == RELAY_CONNECTED
    assert json.loads(relay.stdout.readline())["event"] == "attached"

    stage.link.close()
    for fd in (stage.ends[0], stage.ends[3]):
        os.close(fd)

    assert relay.wait(WAIT_S) == 0
    nobody = subprocess.run([*command, name], capture_output=True, timeout=WAIT_S, check=False)
    assert nobody.returncode == RELAY_NOBODY
    relay.stdin.close()
    relay.stdout.close()


def test_silent_operator_is_late_only_while_its_line_stands(make, monkeypatch) -> None:
    monkeypatch.setattr(operator_link, "PING_LATE_S", 0.05)
    stage = make()
    os.write(stage.ends[1], b'{"command": "ping", "n": 1}\n')
    stage.run_until(lambda: stage.link.is_silent)

    stage.break_line()

    assert not stage.link.is_silent
