"""A machine that is silent is waited for while it gives signs of life, and given up when it does not."""

import contextlib

import pytest

from cosmos_cli.fleet import liveness
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.liveness import BlockingStream, SilenceWatch, SilentMachine
from cosmos_cli.fleet.local import LocalConnection
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
    monkeypatch.setattr(liveness, "SILENCE_S", 0.05)


@contextlib.contextmanager
def watched(connection, command, **how):
    stream = connection.open(command)
    try:
        yield stream, BlockingStream(stream, SilenceWatch(connection, **how))
    finally:
        stream.close()


def read(connection, command, timeout_s):
    with watched(connection, command) as (_, link):
        return link.read_some(100, timeout_s=timeout_s)


def test_slow_machine_is_waited_for():
    connection = Watchable(alive=[True] * 1000)

    assert read(connection, "sleep 0.3; echo here", 60.0) == b"here\n"
    assert len(connection.alive) < 1000


def test_dead_machine_is_given_up_long_before_the_deadline():
    with pytest.raises(MachineFailure, match="stopped answering") as failure:
        read(Watchable(alive=[True, False, False]), "cat", 60.0)

    assert failure.value.kind is FailureKind.LOST


def test_silence_is_named_long_before_the_machine_is_given_up():
    told, asked = [], []
    connection = Watchable(alive=[])

    def is_alive(*, timeout_s):
        asked.append(timeout_s)
        return False

    connection.is_alive = is_alive

    def tell(silent_s):
        told.append((silent_s, len(asked)))

    with watched(connection, "cat", on_silence=tell) as (_, link), pytest.raises(SilentMachine):
        link.read_some(100, timeout_s=60.0)

    # After a second without a byte and one without a sign: as in a run, where it is 2.5 s.
    assert told == [(2.0, 1)]
    assert asked == pytest.approx([1.95, 6.05])


def test_deadline_holds_for_a_machine_that_lives():
    with pytest.raises(MachineFailure, match="no answer in 0.2 s") as failure:
        read(Watchable(alive=[True] * 1000), "cat", 0.2)

    assert failure.value.kind is FailureKind.TIMEOUT


def test_what_comes_before_the_silence_is_long_asks_for_no_sign(monkeypatch):
    monkeypatch.setattr(liveness, "SILENCE_S", 60.0)

    assert read(Watchable(alive=[]), "echo here", 60.0) == b"here\n"


def test_end_of_a_program_is_its_end():
    assert read(Watchable(alive=[True] * 1000), "true", 60.0) == b""


def test_machine_that_takes_no_more_input_is_asked_for_a_sign_of_life():
    connection = Watchable(alive=[True, False, False])

    with (
        watched(connection, "sleep 60") as (_, link),
        pytest.raises(MachineFailure, match="stopped answering"),
    ):
        link.write_all(bytes(10_000_000), timeout_s=60.0)


def test_all_of_a_large_input_is_taken():
    with watched(Watchable(alive=[True] * 1000), "wc -c") as (stream, link):
        link.write_all(bytes(10_000_000), timeout_s=60.0)
        stream.close_writing()
        assert link.read_some(100, timeout_s=60.0).strip() == b"10000000"
