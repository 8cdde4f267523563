"""What may wait for a machine, away from the loop: background work, and lines over a stream."""

from __future__ import annotations

import json
import os
import selectors
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalStream
from cosmos_cli.launch import background as background_module
from cosmos_cli.launch.background import THREADS_MAX, BackgroundTasks
from cosmos_cli.launch.channel import StreamChannel

PATIENCE_S = 30.0


@pytest.fixture
def selector() -> Iterator[selectors.BaseSelector]:
    with selectors.DefaultSelector() as selector:
        yield selector


@pytest.fixture
def background(selector: selectors.BaseSelector) -> Iterator[BackgroundTasks]:
    background = BackgroundTasks(selector)
    yield background
    background.close(PATIENCE_S)


def turn_until(selector: selectors.BaseSelector, condition: Callable[[], object]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until_s, "waited in vain"
        for key, mask in selector.select(0.05):
            key.data(mask)


def test_values_and_failures_come_back_in_the_loop(
    selector: selectors.BaseSelector, background: BackgroundTasks
) -> None:
    told: list[tuple[object, object]] = []
    lost = MachineFailure(FailureKind.LOST, "gone")

    def fail() -> None:
        raise lost

    def surprise() -> None:
        raise ValueError("x")

    for task in (lambda: 7, fail, surprise):
        background.submit(task, lambda value, failure: told.append((value, failure)))
    turn_until(selector, lambda: len(told) == 3)

    assert (7, None) in told
    assert (None, lost) in told
    surprises = [f for _, f in told if isinstance(f, MachineFailure) and f is not lost]
    assert [failure.kind for failure in surprises] == [FailureKind.DEFECT]
    assert background.pending == 0


def test_tasks_beyond_the_bound_wait_their_turn(
    selector: selectors.BaseSelector, background: BackgroundTasks
) -> None:
    gate, done = threading.Event(), []
    before = set(threading.enumerate())  # a test before may have left some that are just ending
    for number in range(THREADS_MAX + 5):
        background.submit(lambda: gate.wait(PATIENCE_S), lambda v, f: done.append(v))
        assert background.pending == number + 1

    names = [thread.name for thread in set(threading.enumerate()) - before]
    gate.set()
    turn_until(selector, lambda: len(done) == THREADS_MAX + 5)

    assert names.count("machines") <= THREADS_MAX
    assert all(done)


def test_closing_waits_for_what_is_under_way_but_not_for_ever(
    selector: selectors.BaseSelector,
) -> None:
    told: list[object] = []
    quick = BackgroundTasks(selector)
    quick.submit(lambda: 1, lambda value, failure: told.append(value))
    gate = threading.Event()
    slow = BackgroundTasks(selector)
    slow.submit(lambda: gate.wait(PATIENCE_S))

    assert quick.close(PATIENCE_S)
    assert not slow.close(0.1)

    assert told == [1]
    gate.set()
    with pytest.raises(RuntimeError, match="no more tasks"):
        quick.submit(lambda: 1)


def test_pipe_is_open_until_the_last_thread_has_told_of_its_end(
    selector: selectors.BaseSelector, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that was opened in the meantime would have its number, and what was written to it."""
    tasks, is_told, is_closed = BackgroundTasks(selector), threading.Event(), threading.Event()
    written: list[bool] = []
    close, write = os.close, os.write

    def write_late(descriptor: int, data: bytes) -> int:
        is_told.wait(PATIENCE_S)
        written.append(not is_closed.wait(0.5))
        return write(descriptor, data) if written[-1] else 0

    def note(descriptor: int) -> None:
        close(descriptor)
        if descriptor == tasks._write_fd:
            is_closed.set()

    monkeypatch.setattr(background_module.os, "write", write_late)
    monkeypatch.setattr(background_module.os, "close", note)
    tasks.submit(lambda: 1, lambda value, failure: is_told.set())

    assert tasks.close(PATIENCE_S)
    assert written == [True]


@pytest.mark.process
def test_lines_go_both_ways_also_when_a_pipe_is_full(selector: selectors.BaseSelector) -> None:
    stream = LocalStream("sleep 0.3; exec cat")
    lines: list[bytes] = []
    ended: list[bool] = []
    channel = StreamChannel(
        selector, stream, on_line=lines.append, on_end=lambda: ended.append(True)
    )
    channel.send({"large": "x" * 500_000})
    is_full = channel.has_unsent
    channel.send({"small": 1})

    def both() -> bool:
        channel.push()
        return len(lines) == 2

    turn_until(selector, both)
    channel.close_writing()
    turn_until(selector, lambda: ended)
    stream.close()

    assert is_full
    assert [list(json.loads(line)) for line in lines] == [["large"], ["small"]]
    assert channel.failure is None
    assert not channel.is_open


class BrokenStream(LocalStream):
    def read(self, count: int, *, timeout_s: float = 0.0) -> bytes:
        raise MachineFailure(FailureKind.LOST, "the cable was cut")

    def write(self, data: bytes | memoryview, *, timeout_s: float = 0.0) -> int:
        raise MachineFailure(FailureKind.LOST, "the cable was cut")


@pytest.mark.process
def test_lost_connection_ends_the_channel_and_says_why(selector: selectors.BaseSelector) -> None:
    stream = BrokenStream("echo x; exec cat")
    ended: list[bool] = []
    channel = StreamChannel(
        selector, stream, on_line=lambda line: None, on_end=lambda: ended.append(True)
    )
    channel.send({"n": 1})
    unsent = channel.has_unsent

    turn_until(selector, lambda: ended)
    channel.close()
    stream.close()

    assert ended == [True]
    assert not unsent
    assert channel.failure is not None and channel.failure.text == "the cable was cut"
