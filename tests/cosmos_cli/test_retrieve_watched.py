"""A machine that is silent is waited for while it gives signs of life, and given up when it does not."""

import pytest
from split_run import SplitRun

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.retrieve import watched
from cosmos_cli.retrieve.watched import WatchedConnection

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
    monkeypatch.setattr(watched, "SILENCE_S", 0.05)


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


def test_retrieval_works_over_a_watched_connection(tmp_path):
    split = SplitRun(tmp_path, machines=1)

    assert split.retrieve()["pi01"].is_ok
