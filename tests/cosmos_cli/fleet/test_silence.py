"""A machine that is silent is waited for while it gives signs of life, and given up when it does not."""

import pytest

from cosmos_cli.fleet import silence
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.silence import WatchedConnection
from cosmos_cli.fleet.target import Target

pytestmark = pytest.mark.process
TARGET = Target(name="pi01", address="192.0.2.1")


class Watchable(LocalConnection):
    def __init__(self, *, alive):
        super().__init__(TARGET)
        self.alive = list(alive)

    def is_alive(self, *, timeout_s=2.0):
        return self.alive.pop(0)


@pytest.fixture(autouse=True)
def short_silence(monkeypatch):
    monkeypatch.setattr(silence, "SILENCE_S", 0.05)


def read(connection, command, timeout_s):
    stream = WatchedConnection(connection).open(command)
    try:
        return stream.read_some(100, timeout_s=timeout_s)
    finally:
        stream.close()


def test_slow_machine_is_waited_for():
    connection = Watchable(alive=[True] * 1000)

    assert read(connection, "sleep 0.3; echo here", 60.0) == b"here\n"
    assert len(connection.alive) < 1000


def test_dead_machine_is_given_up_long_before_the_deadline():
    with pytest.raises(MachineFailure, match="stopped answering") as failure:
        read(Watchable(alive=[True, False]), "cat", 60.0)

    assert failure.value.kind is FailureKind.LOST


def test_deadline_holds_for_a_machine_that_lives():
    with pytest.raises(MachineFailure, match="no answer in 0.2 s") as failure:
        read(Watchable(alive=[True] * 1000), "cat", 0.2)

    assert failure.value.kind is FailureKind.TIMEOUT


def test_what_comes_at_once_asks_for_no_sign():
    assert read(Watchable(alive=[]), "echo here", 60.0) == b"here\n"


def test_end_of_a_program_is_its_end():
    assert read(Watchable(alive=[True] * 1000), "true", 60.0) == b""


def test_machine_that_takes_no_more_input_is_asked_for_a_sign_of_life():
    stream = WatchedConnection(Watchable(alive=[True, False])).open("sleep 60")
    try:
        with pytest.raises(MachineFailure, match="stopped answering"):
            stream.write_all(bytes(10_000_000), timeout_s=60.0)
    finally:
        stream.close()


def test_all_of_a_large_input_is_taken():
    stream = WatchedConnection(Watchable(alive=[True] * 1000)).open("wc -c")
    try:
        stream.write_all(bytes(10_000_000), timeout_s=60.0)
        stream.close_writing()
        assert stream.read_some(100, timeout_s=60.0).strip() == b"10000000"
    finally:
        stream.close()
