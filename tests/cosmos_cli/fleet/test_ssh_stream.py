"""A program over a real SSH connection: bytes both ways, its end, its errors, and a connection that breaks."""

import contextlib
import os
import selectors
import signal
import threading
import time

import pytest
from ssh_harness import target_of

from cosmos_cli.fleet.connection import OUTPUT_BYTES_MAX
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.liveness import BlockingStream
from cosmos_cli.fleet.open_connection import connect

pytestmark = pytest.mark.process

WAIT_S = 60.0
"""A bound, not an expectation."""


@pytest.fixture
def connection(known):
    made = connect(target_of(known))
    yield made
    made.close()


@pytest.fixture
def fragile(own_sshd, known_hosts):
    """A connection whose server may be hurt."""
    known_hosts.write_text(own_sshd.known_hosts_line())
    made = connect(target_of(own_sshd))
    yield made
    made.close()


def read_all(stream):
    data = bytearray()
    while more := BlockingStream(stream).read_some(65536, timeout_s=WAIT_S):
        data += more
    return bytes(data)


def test_output_ends_with_empty_bytes_and_a_status(connection):
    stream = connection.open("echo one; exit 7")

    assert read_all(stream) == b"one\n"
    assert BlockingStream(stream).read_some(10, timeout_s=WAIT_S) == b""
    assert stream.read(10) == b""
    assert stream.ending(timeout_s=WAIT_S).exit_status == 7
    stream.close()


def test_status_that_comes_long_after_the_end_of_the_output_is_waited_for(connection):
    done = connection.run("echo one; exec >&- 2>&-; sleep 2; exit 7", timeout_s=WAIT_S)

    assert (done.exit_status, done.stdout) == (7, b"one\n")


def test_status_is_unknown_while_it_runs(connection):
    stream = connection.open("cat")

    assert stream.ending().exit_status is None
    stream.close()


def test_signal_is_a_negative_status(connection):
    for number in (signal.SIGKILL, signal.SIGHUP, signal.SIGSEGV):
        assert connection.run(f"kill -{int(number)} $$", timeout_s=WAIT_S).exit_status == -number


def test_reading_without_waiting_says_that_nothing_has_come(connection):
    stream = connection.open("cat")

    with pytest.raises(BlockingIOError):
        stream.read(10)
    stream.close()


def test_waiting_has_a_deadline(connection):
    stream = connection.open("cat")

    with pytest.raises(MachineFailure) as caught:
        BlockingStream(stream).read_some(10, timeout_s=0.1)

    assert caught.value.kind is FailureKind.TIMEOUT
    stream.close()


def test_loop_is_woken_by_bytes_and_by_the_end(connection):
    stream = connection.open("read line; echo got $line; read line")
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        quiet = selector.select(0.05)
        stream.write(b"hello\n")
        woken = selector.select(WAIT_S)
        said = stream.read(100)
        stream.close_writing()
        ended = b"?"
        until_s = time.monotonic() + WAIT_S
        while ended and time.monotonic() < until_s:
            selector.select(WAIT_S)
            try:
                ended = stream.read(100)
            except BlockingIOError:
                continue

    assert quiet == []
    assert len(woken) == 1
    assert (said, ended) == (b"got hello\n", b"")
    stream.close()


def test_loop_sees_every_byte_beside_a_flood_of_errors(connection):
    """Standard error has a buffer of its own, which must neither block the program nor hide output."""
    stream = connection.open(
        "i=0; while [ $i -lt 300 ]; do echo out $i; head -c 20000 /dev/zero >&2; i=$((i+1)); done"
    )
    data = bytearray()
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while True:
            assert selector.select(WAIT_S), "no wake-up though there was more"
            try:
                more = stream.read(4096)
            except BlockingIOError:
                continue
            if not more:
                break
            data += more

    assert bytes(data).split(b"\n")[:-1] == [b"out %d" % n for n in range(300)]
    assert len(stream.ending().errors) <= 16384
    stream.close()


def test_loop_is_woken_by_errors_that_would_fill_the_window(connection):
    stream = connection.open("head -c 12000000 /dev/zero >&2; echo done")
    said = b""
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while not said:
            assert selector.select(WAIT_S), "nobody was woken to make room"
            with contextlib.suppress(BlockingIOError):
                said = stream.read(100)

    assert said == b"done\n"
    stream.close()


def test_loop_is_woken_again_for_what_it_left(connection):
    stream = connection.open("echo 0123456789; read line")
    pieces = []
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while b"".join(pieces) != b"0123456789\n":
            assert selector.select(WAIT_S), "what was left is forgotten"
            with contextlib.suppress(BlockingIOError):
                pieces.append(stream.read(3))

    assert max(map(len, pieces)) == 3
    stream.close()


def test_last_errors_are_kept(connection):
    stream = connection.open(
        "echo first >&2; head -c 100000 /dev/zero | tr '\\0' x >&2; echo last >&2"
    )
    read_all(stream)

    assert stream.ending().errors.endswith("last\n")
    assert "first" not in stream.ending().errors
    stream.close()


def test_end_of_input_is_seen_and_may_be_said_twice(connection):
    stream = connection.open("cat; echo end")
    BlockingStream(stream).write_all(b"abc\n", timeout_s=WAIT_S)
    stream.close_writing()
    stream.close_writing()

    assert read_all(stream) == b"abc\nend\n"
    stream.close()


def test_writing_after_the_end_says_that_it_has_ended(connection):
    stream = connection.open("true")
    read_all(stream)
    stream.close_writing()

    with pytest.raises(MachineFailure) as caught:
        stream.write(b"x")
    assert caught.value.kind is FailureKind.LOST
    with pytest.raises(MachineFailure):
        BlockingStream(stream).write_all(b"x", timeout_s=WAIT_S)
    stream.close()


def test_program_that_reads_nothing_fills_the_window_and_no_more(connection):
    stream = connection.open("sleep 60")
    written = 0
    with pytest.raises(BlockingIOError):
        while written < 256 * 1024 * 1024:
            written += stream.write(b"x" * 65536)
    with pytest.raises(MachineFailure) as caught:
        BlockingStream(stream).write_all(b"x" * 64 * 1024 * 1024, timeout_s=0.2)

    assert caught.value.kind is FailureKind.TIMEOUT
    stream.close()


def test_closing_ends_what_watches_its_input(connection, tmp_path):
    stream = connection.open(f"cat; echo gone > {tmp_path}/gone")
    stream.close()
    stream.close()

    until_s = time.monotonic() + WAIT_S
    while not (tmp_path / "gone").exists() and time.monotonic() < until_s:
        time.sleep(0.01)
    assert (tmp_path / "gone").exists()


@pytest.mark.parametrize("size_bytes", [1, 32 * 1024, 3 * 1024 * 1024 + 1])
def test_many_bytes_come_back_as_they_went(connection, size_bytes):
    data = os.urandom(size_bytes)

    done = connection.run("cat", stdin=data, timeout_s=60.0)

    assert (done.exit_status, done.stdout, done.cut_bytes) == (0, data, 0)


def test_bytes_written_in_one_thread_are_read_in_another(connection):
    data = os.urandom(24 * 1024 * 1024)
    stream = connection.open("cat")

    def write():
        BlockingStream(stream).write_all(data, timeout_s=WAIT_S)
        stream.close_writing()

    writer = threading.Thread(target=write)
    writer.start()
    try:
        assert read_all(stream) == data
    finally:
        writer.join()
        stream.close()


def test_output_beyond_the_bound_is_cut_and_counted(connection):
    size_bytes = 3 * OUTPUT_BYTES_MAX
    done = connection.run(
        f"echo begin; head -c {size_bytes} /dev/zero; echo; echo end", timeout_s=120.0
    )

    whole = size_bytes + len(b"begin\n\nend\n")
    assert done.stdout.startswith(b"begin\n")
    assert done.stdout.endswith(b"end\n")
    assert whole - OUTPUT_BYTES_MAX == done.cut_bytes
    assert f"[... {done.cut_bytes} bytes left out ...]".encode() in done.stdout


def test_command_that_does_not_end_in_time_is_told(connection):
    with pytest.raises(MachineFailure) as caught:
        connection.run("sleep 60", timeout_s=0.2)

    assert caught.value.kind is FailureKind.TIMEOUT
    assert connection.run("echo still there", timeout_s=WAIT_S).stdout == b"still there\n"


def test_input_that_nobody_reads_does_not_keep_a_command(connection):
    done = connection.run("exit 4", stdin=b"x" * 20_000_000, timeout_s=WAIT_S)

    assert done.exit_status == 4


def test_many_programs_run_over_one_connection(connection):
    streams = [connection.open(f"cat; exit {n}") for n in range(5)]
    for n, stream in enumerate(streams):
        BlockingStream(stream).write_all(b"%d" % n, timeout_s=WAIT_S)
        stream.close_writing()

    assert [read_all(stream) for stream in streams] == [b"%d" % n for n in range(5)]
    assert [stream.ending(timeout_s=WAIT_S).exit_status for stream in streams] == list(range(5))
    for stream in streams:
        stream.close()


def test_more_sessions_than_the_server_allows_are_told(connection):
    streams = []
    with pytest.raises(MachineFailure) as caught:
        streams += [connection.open("cat") for _ in range(10)]
        connection.open("cat")

    assert caught.value.kind is FailureKind.BUSY
    assert "MaxSessions" in caught.value.advice


@pytest.mark.parametrize("how", ["cut", "close"])
def test_connection_that_breaks_wakes_who_waits_and_is_told(fragile, own_sshd, how):
    stream = fragile.open("sleep 60")
    breaker = threading.Timer(0.3, own_sshd.cut if how == "cut" else fragile.close)
    breaker.start()
    start_s = time.monotonic()
    try:
        with pytest.raises(MachineFailure) as caught:
            BlockingStream(stream).read_some(10, timeout_s=WAIT_S)
    finally:
        breaker.join()

    assert caught.value.kind is FailureKind.LOST
    assert time.monotonic() - start_s < WAIT_S
    assert stream.ending().exit_status is None
    with pytest.raises(MachineFailure) as caught:
        BlockingStream(stream).write_all(b"x" * 10_000_000, timeout_s=WAIT_S)
    assert caught.value.kind is FailureKind.LOST
    stream.close()


def test_upload_to_a_machine_that_dies_is_lost_and_does_not_hang(fragile, own_sshd):
    stream = fragile.open("cat > /dev/null")
    breaker = threading.Timer(0.3, own_sshd.cut)
    breaker.start()
    try:
        with pytest.raises(MachineFailure) as caught:
            while True:
                BlockingStream(stream).write_all(b"x" * 1_000_000, timeout_s=WAIT_S)
    finally:
        breaker.join()

    assert caught.value.kind is FailureKind.LOST
    stream.close()


def test_upload_to_a_frozen_machine_ends_by_its_deadline(fragile, own_sshd):
    stream = fragile.open("cat > /dev/null")
    own_sshd.freeze()
    try:
        with pytest.raises(MachineFailure) as caught:
            for _ in range(100):
                BlockingStream(stream).write_all(b"x" * 1_000_000, timeout_s=0.5)
    finally:
        own_sshd.thaw()

    assert caught.value.kind in (FailureKind.TIMEOUT, FailureKind.LOST)
    stream.close()


def test_command_whose_end_is_not_told_is_no_success(fragile, own_sshd):
    breaker = threading.Timer(0.3, own_sshd.cut)
    breaker.start()
    try:
        with pytest.raises(MachineFailure) as caught:
            fragile.run("sleep 60", timeout_s=WAIT_S)
    finally:
        breaker.join()

    assert caught.value.kind is FailureKind.LOST
