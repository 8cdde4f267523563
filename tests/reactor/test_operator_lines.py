"""The line to the operator: commands in, events out, and the end of either side felt."""

import json
import os
import threading

import pytest

from madns_runtime.errors import ConfigurationError
from madns_runtime.reactor import operator_link
from madns_runtime.reactor.operator_link import OperatorLink, read_launch
from madns_runtime.reactor.reactor import Reactor

pytestmark = pytest.mark.process


@pytest.fixture
def pipes():
    ends = [*os.pipe(), *os.pipe()]
    yield ends
    for fd in ends:
        try:
            os.close(fd)
        except OSError:
            continue


@pytest.fixture
def reactor():
    made = Reactor()
    yield made
    made.close()


def stop_after(reactor, commands):
    """Stop the loop a moment after the first command."""

    def look():
        reactor.call_at(reactor.now_s() + 0.05, reactor.stop if commands else look)

    look()


def link(reactor, pipes, commands, gone, pending=b""):
    return OperatorLink(
        reactor,
        (pipes[0], pipes[3]),
        on_command=commands.append,
        on_gone=lambda: (gone.append(True), reactor.stop()),
        pending=pending,
    )


def test_launch_document_is_the_first_line_and_the_rest_is_kept(pipes):
    os.write(pipes[1], b'{"a": 1}\n{"command": "stop"}\n{"comm')

    document, rest = read_launch(pipes[0])

    assert document == {"a": 1}
    assert rest == b'{"command": "stop"}\n{"comm'


@pytest.mark.parametrize(
    ("written", "expected"),
    [(b'{"a": 1}', "cut"), (b"", "empty"), (b"nonsense\n", "not JSON"), (b"[1]\n", "not a JSON")],
)
def test_broken_launch_document_is_refused(pipes, written, expected):
    os.write(pipes[1], written)
    os.close(pipes[1])

    with pytest.raises(ConfigurationError, match=expected):
        read_launch(pipes[0])


def test_launch_document_that_never_comes_has_a_deadline(pipes, monkeypatch):
    monkeypatch.setattr(operator_link, "LAUNCH_TIMEOUT_S", 0.05)

    with pytest.raises(ConfigurationError, match="no launch document"):
        read_launch(pipes[0])


def test_commands_come_whole_in_whatever_pieces_and_garbage_is_passed_over(reactor, pipes):
    commands, gone = [], []
    link(reactor, pipes, commands, gone, pending=b'{"command": "a"}\n{"comm')
    os.write(pipes[1], b'and": "b"}\nno json\n[1]\n{"command": "c"}\n')
    os.close(pipes[1])

    reactor.run()

    assert commands == [{"command": "a"}, {"command": "b"}, {"command": "c"}]
    assert gone == [True]


def test_events_are_lines_of_json(reactor, pipes):
    made = link(reactor, pipes, [], [])

    made.emit({"event": "state", "state": "EXIT"})

    assert os.read(pipes[2], 4096) == b'{"event":"state","state":"EXIT"}\n'


def test_operator_who_does_not_read_costs_the_oldest_events_and_they_are_counted(
    reactor, pipes, monkeypatch
):
    monkeypatch.setattr(operator_link, "OUT_BYTES_MAX", 200_000)
    made = link(reactor, pipes, [], [])
    for number in range(400):
        made.emit({"event": "log", "number": number, "text": "x" * 1000})

    assert made.dropped_count > 0
    assert not made.flush(0.01)
    text = b""
    while not made.flush(0.05):
        text += os.read(pipes[2], 1 << 20)
    os.close(pipes[3])
    while chunk := os.read(pipes[2], 1 << 20):
        text += chunk
    numbers = [int(line.split(b'"number":')[1].split(b",")[0]) for line in text.splitlines()]
    assert len(numbers) == 400 - made.dropped_count
    assert numbers == sorted(numbers)
    assert numbers[-1] == 399


def test_events_to_an_operator_who_is_gone_are_no_error(reactor, pipes):
    made = link(reactor, pipes, [], [])
    os.close(pipes[2])

    made.emit({"event": "log"})

    assert made.flush(1.0)


def read_events(fd):
    os.set_blocking(fd, False)
    return [json.loads(line) for line in os.read(fd, 65_536).splitlines()]


def test_pings_are_answered_and_are_no_commands(reactor, pipes):
    commands, gone = [], []
    link(reactor, pipes, commands, gone)
    os.write(pipes[1], b'{"command": "ping", "n": 7}\n{"command": "stop"}\n')
    stop_after(reactor, commands)

    reactor.run()

    assert read_events(pipes[2]) == [{"event": "pong", "n": 7}]
    assert commands == [{"command": "stop"}]
    assert gone == []


def test_what_is_no_command_is_told_and_the_rest_is_heard(reactor, pipes):
    commands, gone = [], []
    link(reactor, pipes, commands, gone)
    os.write(pipes[1], b'{"comm\n[1]\n\n{"command": "stop"}\n')
    stop_after(reactor, commands)

    reactor.run()

    assert [(event["level"], event["text"]) for event in read_events(pipes[2])] == [
        ("warning", """no command here: b'{"comm'"""),
        ("warning", "no command here: [1]"),
    ]
    assert commands == [{"command": "stop"}]


def test_operator_whose_pings_cease_is_gone(reactor, pipes, monkeypatch):
    monkeypatch.setattr(operator_link, "PING_SILENCE_S", 0.1)
    commands, gone = [], []
    line = link(reactor, pipes, commands, gone)
    os.write(pipes[1], b'{"command": "ping", "n": 1}\n')

    reactor.run()

    assert gone == [True]
    assert line.is_gone


@pytest.mark.parametrize(
    ("waiting", "is_gone"), [(b'{"command": "ping", "n": 2}\n', False), (b"", True)]
)
def test_operator_whose_pings_wait_behind_a_long_call_is_not_gone(reactor, pipes, waiting, is_gone):
    commands, gone = [], []
    line = link(reactor, pipes, commands, gone)
    message = os.pipe()

    def take():
        os.read(message[0], 1)
        os.write(pipes[1], waiting)
        line._silence_timer.reschedule(reactor.now_s())  # it has come while the plug-in was called
        reactor.call_at(reactor.now_s(), reactor.stop)

    reactor.add_reader(message[0], take)
    os.write(message[1], b"x")

    reactor.run()

    assert (bool(gone), line.is_gone) == (is_gone, is_gone)
    for end in message:
        os.close(end)


def test_operator_that_never_pinged_is_not_gone_for_its_silence(reactor, pipes, monkeypatch):
    monkeypatch.setattr(operator_link, "PING_SILENCE_S", 0.05)
    commands, gone = [], []
    link(reactor, pipes, commands, gone)
    reactor.call_at(reactor.now_s() + 0.2, reactor.stop)

    reactor.run()

    assert gone == []


@pytest.mark.parametrize("leaves", ["closes", "falls silent"])
def test_detached_process_stays_when_its_operator(reactor, pipes, monkeypatch, leaves):
    monkeypatch.setattr(operator_link, "PING_SILENCE_S", 0.05)
    commands, gone = [], []
    line = OperatorLink(
        reactor,
        (pipes[0], pipes[3]),
        on_command=commands.append,
        on_gone=lambda: gone.append(True),
        is_detached=True,
    )
    os.write(pipes[1], b'{"command": "ping", "n": 1}\n')
    if leaves == "closes":
        os.close(pipes[1])
        os.close(pipes[2])
    reactor.call_at(reactor.now_s() + 0.2, reactor.stop)

    reactor.run()

    assert gone == []
    assert not line.has_hung_up()


def test_events_that_nobody_takes_are_counted(reactor, pipes):
    line = link(reactor, pipes, [], [])
    os.close(pipes[2])

    for _ in range(3):
        line.emit({"event": "log"})

    assert line.dropped_count == 3
    assert line.flush(0.1)


def test_operator_is_late_when_its_pings_are(reactor, pipes, monkeypatch):
    monkeypatch.setattr(operator_link, "PING_LATE_S", 0.1)
    line = link(reactor, pipes, [], [])
    seen = [line.is_silent]
    os.write(pipes[1], b'{"command": "ping", "n": 1}\n')
    until_s = reactor.now_s() + 60.0

    def look():
        seen.append(line.is_silent)
        if seen[-1] or reactor.now_s() > until_s:
            reactor.stop()
        else:
            reactor.call_at(reactor.now_s() + 0.05, look)

    look()
    reactor.run()

    assert seen[0] is False
    assert seen[-1] is True
    os.write(pipes[1], b'{"command": "ping", "n": 2}\n')  # and the loop has not come to read it
    assert line.is_silent is False


def test_end_that_comes_a_moment_later_is_waited_for(reactor, pipes):
    line = link(reactor, pipes, [], [])
    closing = threading.Timer(0.05, os.close, [pipes[1]])

    assert not line.has_hung_up()
    closing.start()
    assert line.has_hung_up(30.0)
    closing.join()
