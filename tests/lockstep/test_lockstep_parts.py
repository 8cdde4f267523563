"""The pure parts of lockstep: who shares a worker, what travels, what is recorded."""

import json
import os
import socket
import subprocess
from types import SimpleNamespace

import pytest
from harness import full_disk

from madns_runtime.config import Agents, RunConfig, Timeouts, TimeSettings
from madns_runtime.errors import MachineError, MessageTooLarge, PeerError
from madns_runtime.lockstep import frames, workers
from madns_runtime.lockstep.barrier import Barrier
from madns_runtime.lockstep.clock import SimulatedClock
from madns_runtime.lockstep.frames import FRAME_BYTES_MAX, HEAD, FrameReader, encode_frame
from madns_runtime.lockstep.messages import LARGEST_BYTES, Allowance, decode, encode
from madns_runtime.lockstep.partition import share_out
from madns_runtime.lockstep.recorder import open_journal
from madns_runtime.lockstep.result import EarlyEnd, RunAccount
from madns_runtime.lockstep.workers import WorkerPool, WorkerProcess
from madns_runtime.protocol.datagram import MESSAGE_BYTES_MAX
from madns_runtime.protocol.link_settings import SendQueueFull
from madns_runtime.protocol.messages import Service
from madns_runtime.recording import stream_file
from madns_runtime.recording.records import Field, StreamSchema

OWN = StreamSchema("own", (Field("t_s", "s"), Field("text", "", "str")))


@pytest.mark.parametrize(
    ("count", "per_process", "processors", "sizes"),
    [
        (93, 1, 2, [46, 47]),
        (3, 1, 8, [1, 1, 1]),
        (10, 4, 2, [3, 3, 4]),
        (10, 10, 2, [10]),
        (1, 1, 1, [1]),
    ],
)
def test_agents_are_shared_out_in_order(count, per_process, processors, sizes):
    shares = share_out(Agents(count=count, per_process=per_process), processors)

    assert [len(share) for share in shares] == sizes
    assert [agent for share in shares for agent in share] == list(range(count))


def test_frames_are_cut_wherever_the_stream_is():
    data = encode_frame(frames.TICK, 7, [(1, b"x" * 300)]) + encode_frame(frames.FINISH, 0.8)
    whole = [[frames.TICK, 7, [[1, b"x" * 300]]], [frames.FINISH, 0.8]]

    assert list(FrameReader().feed(data)) == whole
    reader = FrameReader()
    assert [frame for byte in data for frame in reader.feed(bytes([byte]))] == whole


def test_a_frame_of_no_sense_is_refused():
    with pytest.raises(PeerError):
        list(FrameReader().feed(HEAD.pack(FRAME_BYTES_MAX + 1)))


@pytest.mark.parametrize("message", [None, 1.5, [1, "a", b"b"], {"a": [1, {"b": 2}]}])
def test_a_message_arrives_as_it_was_sent(message):
    assert decode(encode(message, Service.RELIABLE)) == message


def test_a_telemetry_message_must_fit_a_datagram_here_too():
    encode(bytes(2000), Service.RELIABLE)
    with pytest.raises(MessageTooLarge):
        encode(bytes(2000), Service.BEST)


def test_what_is_sent_at_one_simulated_time_has_a_bound():
    allowance = Allowance()
    allowance.take(LARGEST_BYTES, 1.0)
    allowance.take(LARGEST_BYTES, 1.0)
    with pytest.raises(SendQueueFull):
        allowance.take(3, 1.0)
    allowance.take(LARGEST_BYTES, 1.5)
    with pytest.raises(MessageTooLarge):
        Allowance().take(LARGEST_BYTES + 1, 1.0)
    assert LARGEST_BYTES == MESSAGE_BYTES_MAX, "as between machines"


def config(**changes):
    return RunConfig(
        run="0009-name",
        scenario="name",
        simulation="counter",
        base_directory=".",
        agents=Agents(count=1),
        time=TimeSettings(mode="lockstep"),
        **changes,
    )


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_records_wait_for_the_disk_and_none_is_dropped(tmp_path):
    journal = open_journal(tmp_path, config(), source="host", clock=SimulatedClock(0.0))
    journal.recorder.open_stream(OWN)
    for number in range(20_000):  # many times what a real-time recorder would hold
        journal.recorder.record("own", (number, "x" * 1000))
    counts = journal.close()

    assert (counts.streams["own"].written, counts.dropped, counts.errors) == (20_000, 0, ())
    assert len(lines(tmp_path / "own.jsonl")) == 20_002


def test_records_carry_simulated_time_alone(tmp_path):
    clock = SimulatedClock(-0.5)
    journal = open_journal(tmp_path, config(), source="agent-01", clock=clock)
    journal.event("start")
    clock.t_s = 86_400.25
    journal.log("error", "late", clock.t_s)
    journal.close()

    header, start, end, _ = lines(tmp_path / "events.jsonl")
    assert (header["run"], header["t0_utc"]) == ("name", "1970-01-01T00:00:00.000000Z")
    assert start == {"t_s": -0.5, "utc": "1969-12-31T23:59:59.500000Z", "event": "start"}
    assert end == {"t_s": 86_400.25, "utc": "1970-01-02T00:00:00.250000Z", "event": "end"}
    assert lines(tmp_path / "log.jsonl")[1]["utc"] == "1970-01-02T00:00:00.250000Z"


def test_a_full_disk_ends_it_instead_of_costing_records(tmp_path, monkeypatch):
    journal = open_journal(tmp_path, config(), source="host", clock=SimulatedClock(0.0))
    journal.recorder.open_stream(OWN)
    monkeypatch.setattr(stream_file.os, "write", full_disk.refuse)
    with pytest.raises(MachineError, match="own.jsonl: No space left on device"):
        for number in range(1000):
            journal.recorder.record("own", (number, "x" * 1000))


def test_the_account_tells_speed_and_result():
    account = RunAccount(("a", "b"), duration_s=100.0, workers=1)
    assert account.progress(-0.5, 7.0)["t_s"] is None
    account.began_s = 10.0
    account.ticks = 50
    account.set_states("running")
    progress = account.progress(50.0, 10.5)
    account.wall_s = 0.5

    assert (progress["rtf"], progress["ticks"], progress["running"]) == (100.0, 100, 2)
    assert (account.result()["status"], account.result()["rtf"]) == ("complete", 200.0)
    account.ending = EarlyEnd(who="a", reason="told to")
    assert (account.result()["status"], account.result()["rtf"]) == ("failed", None)


def test_the_account_tells_newest_values_of_those_whose_worker_has_told_them():
    account = RunAccount(("a", "b"), duration_s=100.0, workers=1, columns=("drive.speed_m_s",))

    account.note_values([(1, [2.5])])
    account.note_values([])

    progress = account.progress(1.0, 7.0)
    assert (progress["columns"], progress["values"]) == (["drive.speed_m_s"], {"b": [2.5]})
    assert account.result()["agents"]["b"]["columns"] == [2.5]


@pytest.mark.process
def test_a_worker_that_only_closes_its_line_does_not_live_on(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "EXIT_WAIT_S", 0.05)
    here, _ = socket.socketpair()
    with subprocess.Popen(["sleep", "60"]) as process:
        worker = WorkerProcess(range(1), process.pid, here, memoryview(bytes(8)).cast("q"))
        how = WorkerPool(config(), tmp_path, ()).let_go(worker)

    assert how == "has closed its line to the host and not ended"
    assert not os.path.exists(f"/proc/{process.pid}")


def test_a_run_on_a_full_disk_still_comes_to_its_end(tmp_path, monkeypatch):
    journal = open_journal(tmp_path, config(), source="host", clock=SimulatedClock(0.0))
    journal.recorder.open_stream(OWN)
    monkeypatch.setattr(stream_file.os, "write", full_disk.refuse)
    with pytest.raises(MachineError):
        for number in range(1000):
            journal.recorder.record("own", (number, "x" * 1000))
    journal.event("emergency", who="host", reason="x")
    journal.say("critical", "emergency shutdown: host: x")
    counts = journal.close()

    assert counts.dropped > 60
    assert "No space left on device" in counts.errors[0]


def test_a_failure_stands_whatever_its_worker_answers_behind_it():
    """As a process that came back from a plug-in's call tells it, and the worker itself its order, in one reading."""
    heard = []
    pool = SimpleNamespace(
        listen=lambda reactor, *, on_frame, on_lost: heard.append(on_frame), awaited=None
    )
    launch = SimpleNamespace(config=SimpleNamespace(timeouts=Timeouts()), is_detached=False)
    fds = os.pipe()
    barrier = Barrier(launch, pool, account=None, clock=SimulatedClock(0.0), fds=fds, pending=b"")
    worker = SimpleNamespace(answer=None)

    heard[0](worker, [frames.FAILED, 3, "it forked"])
    heard[0](worker, [frames.DONE, [], []])

    assert worker.answer == [frames.FAILED, 3, "it forked"]
    barrier.reactor.close()
    for fd in fds:
        os.close(fd)
