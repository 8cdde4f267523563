"""The door for faults of devices in a living run: an order that is none is refused, and the next one is obeyed."""

import selectors
import socket

import orjson
import pytest

from cosmos_cli.launch.order_socket import SelectorReaders
from madns_runtime.hardware.order_socket import SOCKET_NAME, OrderSocket

DEEP = b"[" * 1000 + b"]" * 1000


@pytest.fixture
def door(tmp_path):
    """Return a function that gives a line to the socket of one run and returns its answer."""
    selector = selectors.DefaultSelector()

    def obey(number, fault):
        opened.answer(number, "" if fault == ("pi/imu", "bias", 2.0) else "another fault")

    opened = OrderSocket(tmp_path, SelectorReaders(selector), obey)

    def answer_to(line):
        with socket.socket(socket.AF_UNIX) as visitor:
            visitor.settimeout(60.0)
            visitor.connect(str(tmp_path / SOCKET_NAME))
            visitor.sendall(line + b"\n")
            for _ in range(2):  # it is let in, and heard
                for key, mask in selector.select(timeout=0):
                    key.data(mask)
            return orjson.loads(visitor.recv(1 << 16))

    yield answer_to
    opened.close()


@pytest.mark.parametrize(
    "line",
    [
        b'{"target":"pi/imu","action":"bias","value":%s}' % DEEP,
        b'{"target":%s,"action":"bias","value":1}' % DEEP,
        b'{"target":"pi/imu","action":%s,"value":1}' % DEEP,
        b"[" * 2000,
        b"{}",
    ],
)
def test_an_order_that_is_none_is_refused_and_the_next_one_is_obeyed(door, line):
    assert door(line)["refusal"].startswith("no order: ")

    assert door(b'{"target":"pi/imu","action":"bias","value":2}') == {"refusal": ""}
