from __future__ import annotations

import os
import selectors
import socket
from collections.abc import Iterator

import pytest

from cosmos_cli.launch import channel as channel_module
from cosmos_cli.launch.channel import LineSplitter, PipeChannel


@pytest.fixture
def selector() -> Iterator[selectors.BaseSelector]:
    with selectors.DefaultSelector() as selector:
        yield selector


def turn(selector: selectors.BaseSelector) -> None:
    for key, mask in selector.select(0):
        key.data(mask)


def test_lines_are_whole_whatever_the_pieces() -> None:
    splitter = LineSplitter()

    lines = [line for byte in b"one\n\ntwo\nthr" for line in splitter.feed(bytes([byte]))]

    assert lines == [b"one", b"two"]
    assert splitter.flush() == [b"thr"]
    assert splitter.flush() == []


def test_overlong_line_is_cut_and_its_rest_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel_module, "LINE_BYTES_MAX", 4)
    splitter = LineSplitter()

    lines = splitter.feed(b"abcdefg") + splitter.feed(b"hij") + splitter.feed(b"klmnop\nnext\n")

    assert lines == [b"abcd", b"next"]


def test_memory_of_an_endless_line_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(channel_module, "LINE_BYTES_MAX", 1000)
    splitter = LineSplitter()

    lines = [line for _ in range(100) for line in splitter.feed(b"x" * 999)]

    assert sum(map(len, lines)) == 1000
    assert splitter.flush() == []


def test_commands_wait_for_a_reader_and_then_arrive_in_order(
    selector: selectors.BaseSelector,
) -> None:
    ours, theirs = socket.socketpair()
    theirs.settimeout(5)
    fd = ours.detach()
    channel = PipeChannel(selector, (fd, fd), on_line=lambda line: None, on_end=lambda: None)
    text = "x" * 100_000

    for index in range(20):
        channel.send({"index": index, "text": text})
    received = b""
    while received.count(b"\n") < 20:
        received += theirs.recv(1 << 20)
        turn(selector)

    starts = [line[:12] for line in received.splitlines()]
    assert starts == [f'{{"index":{index},"text'.encode()[:12] for index in range(20)]
    channel.close()
    theirs.close()


def test_end_of_the_other_side_is_told_once_after_its_last_line(
    selector: selectors.BaseSelector,
) -> None:
    ours, theirs = socket.socketpair()
    fd = ours.detach()
    seen: list[object] = []
    channel = PipeChannel(
        selector, (fd, fd), on_line=seen.append, on_end=lambda: seen.append("end")
    )
    theirs.sendall(b"first\nlast")
    theirs.close()

    turn(selector)
    turn(selector)
    channel.close()

    assert seen == [b"first", b"last", "end"]
    assert not channel.is_open


def test_sending_to_a_child_that_is_gone_does_no_harm(selector: selectors.BaseSelector) -> None:
    out_read, out_write = os.pipe()
    in_read, in_write = os.pipe()
    channel = PipeChannel(
        selector, (out_read, in_write), on_line=lambda line: None, on_end=lambda: None
    )
    os.close(in_read)

    channel.send({"command": "stop"})
    channel.close_writing()
    channel.send({"command": "stop"})

    assert channel.is_open
    channel.close()
    os.close(out_write)


def test_closing_removes_the_channel_from_the_loop(selector: selectors.BaseSelector) -> None:
    out_read, out_write = os.pipe()
    in_read, in_write = os.pipe()
    channel = PipeChannel(
        selector, (out_read, in_write), on_line=lambda line: None, on_end=lambda: None
    )
    channel.send({"text": "x" * 1_000_000})

    channel.close()
    channel.close()

    assert len(selector.get_map()) == 0
    os.close(out_write)
    os.close(in_read)
