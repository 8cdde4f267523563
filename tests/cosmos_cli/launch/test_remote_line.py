"""The line to a program elsewhere over one stream after another: numbers on both sides, nothing lost or doubled."""

from __future__ import annotations

import json
import os
import selectors
from types import SimpleNamespace
from typing import Any

import pytest

from cosmos_cli.launch.child_commands import inject
from cosmos_cli.launch.events import FaultInserted, parse_event
from cosmos_cli.launch.remote_line import RemoteLine
from cosmos_cli.launch.run_events import FaultOrdered
from madns_runtime.reactor.reattachment import KeptEvents
from madns_runtime.realtime.supervisor import Supervisor


class PipeStream:
    """A stream whose other end is the test's."""

    def __init__(self) -> None:
        self._out, self.far_end = os.pipe()
        os.set_blocking(self._out, False)
        self.written = b""

    def fileno(self) -> int:
        return self._out

    def read(self, count: int) -> bytes:
        return os.read(self._out, count)

    def write(self, data: bytes) -> int:
        self.written += data
        return len(data)

    def close_writing(self) -> None:
        self.written += b"(closed)"

    def say(self, *events: dict[str, Any]) -> None:
        os.write(self.far_end, b"".join(json.dumps(event).encode() + b"\n" for event in events))

    @property
    def commands(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.written.splitlines()]


class Stage:
    def __init__(self) -> None:
        self.selector = selectors.DefaultSelector()
        self.heard: list[dict[str, Any]] = []
        self.ended = 0
        self.line = RemoteLine(
            self.selector,
            on_line=lambda line: self.heard.append(json.loads(line)),
            on_end=lambda failure: setattr(self, "ended", self.ended + 1),
        )

    def turn(self) -> None:
        for key, mask in self.selector.select(0):
            key.data(mask)


@pytest.fixture
def stage() -> Stage:
    return Stage()


def test_commands_wait_for_the_first_stream_and_are_numbered(stage: Stage) -> None:
    stream = PipeStream()
    stage.line.send({"command": "a"})
    stage.line.send({"command": "ping", "n": 1})  # of no use later

    stage.line.open(stream)
    stage.line.send({"command": "b"})

    assert stream.commands == [{"command": "a", "number": 1}, {"command": "b", "number": 2}]


def test_pings_and_the_last_event_tell_what_was_seen(stage: Stage) -> None:
    stream = PipeStream()
    stage.line.open(stream)
    stream.say({"event": "x", "number": 1}, {"event": "finished", "number": 2})
    stage.turn()
    stage.line.send({"command": "ping", "n": 1})

    assert stream.commands == [
        {"command": "seen", "seen": 2},
        {"command": "ping", "n": 1, "seen": 2},
    ]


def test_commands_that_did_not_arrive_are_sent_again_when_the_program_has_greeted(
    stage: Stage,
) -> None:
    first, second = PipeStream(), PipeStream()
    stage.line.open(first)
    stage.line.send({"command": "a"})
    stage.line.send({"command": "b"})
    os.close(first.far_end)
    stage.turn()
    stage.line.send({"command": "c"})
    stage.line.attach(second, b"")
    assert second.commands == []

    second.say({"event": "attached", "commands": 1})
    stage.turn()

    assert [command["command"] for command in second.commands] == ["b", "c"]
    assert stage.heard == []
    assert stage.ended == 1


def test_events_that_come_twice_are_heard_once_and_a_gap_is_told(stage: Stage) -> None:
    first, second = PipeStream(), PipeStream()
    stage.line.open(first)
    first.say({"event": "x", "number": 1}, {"event": "y", "number": 2})
    stage.turn()
    said = (
        b'{"event":"attached","commands":0}\n{"event":"y","number":2}\n{"event":"z","number":5}\n'
    )

    stage.line.attach(second, said)

    assert [event["event"] for event in stage.heard] == ["x", "y", "log", "z"]
    assert stage.heard[2]["text"].startswith("2 of its events did not fit")
    assert stage.line.seen == 5


def test_lines_without_a_number_are_heard_as_they_come(stage: Stage) -> None:
    stream = PipeStream()
    stage.line.open(stream)
    stream.say({"event": "pong", "n": 1}, {"event": "pong", "n": 1})
    stage.turn()

    assert len(stage.heard) == 2


def test_deliberate_end_of_the_line_is_told(stage: Stage) -> None:
    stream = PipeStream()
    stage.line.open(stream)

    stage.line.leave()

    assert stream.written == b'{"command":"leave"}\n(closed)'


@pytest.mark.parametrize(
    "line",
    [b'{"event": "attached", "commands": "all"}', b'{"number": []}', b"[1]", b"no event", b"null"],
)
def test_line_that_makes_no_sense_is_passed_on(line: bytes) -> None:
    lines: list[bytes] = []
    made = RemoteLine(
        selectors.DefaultSelector(), on_line=lines.append, on_end=lambda failure: None
    )

    made.attach(PipeStream(), line + b"\n")

    assert lines == [line]


def test_an_order_and_its_answer_keep_their_number_beside_those_of_the_line(stage: Stage) -> None:
    stream, said = PipeStream(), list[bytes]()
    supervisor: Any = Supervisor.__new__(Supervisor)
    events = KeptEvents()
    supervisor._devices = SimpleNamespace(insert_fault=lambda *fault: "")
    supervisor._operator = SimpleNamespace(emit=lambda event: said.append(events.add(event)))
    stage.line.open(stream)
    stage.line.send(inject(FaultOrdered(7, "pi01/imu", "freeze", None)))

    supervisor._inject(stream.commands[0])

    assert parse_event(said[0]) == FaultInserted(7, "")


@pytest.mark.parametrize("number", [1e20, -1, 2**53 + 1])
def test_a_number_that_cannot_be_told_back_is_none(stage: Stage, number: float) -> None:
    stream, another = PipeStream(), PipeStream()
    stage.line.open(stream)
    stage.line.send({"command": "start"})
    stream.say({"event": "pong", "n": 1, "number": number})
    stage.turn()

    stage.line.send({"command": "ping", "n": 2})
    stage.line.attach(another, b"")
    another.say({"event": "attached", "commands": number})
    stage.turn()

    assert len(stage.heard) == 1
    assert stream.commands[-1] == {"command": "ping", "n": 2, "seen": 0}
    assert another.commands == [{"command": "start", "number": 1}]
