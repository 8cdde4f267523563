"""One thread that writes the records of several agents: each is finished by itself, and none waits for another's trouble."""

from __future__ import annotations

import threading

import orjson
import pytest
from harness.waiting import wait_until

from madns_runtime.config import Recording
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import Field, StreamSchema
from madns_runtime.recording.stream_file import StreamFile
from madns_runtime.recording.writer_thread import WriterThread

NUMBERS = StreamSchema("numbers", (Field("n", "", "int"),))


def recorder_in(directory, thread, settings=None):
    files = RecordFiles(directory, run="r", source=directory.name)
    recorder = Recorder(files, settings or Recording(), thread.writes(files))
    recorder.open_stream(NUMBERS)
    return recorder


def written(directory):
    return [orjson.loads(line) for line in (directory / "numbers.jsonl").read_bytes().splitlines()]


def writers():
    return {thread for thread in threading.enumerate() if thread.name == "recorder"}


def test_all_recorders_of_a_process_share_a_thread(tmp_path):
    earlier = writers()
    thread = WriterThread(Recording())
    recorders = [recorder_in(tmp_path / str(number), thread) for number in range(20)]
    for number, recorder in enumerate(recorders):
        recorder.start()
        recorder.record("numbers", (number,))

    assert len(writers() - earlier) == 1

    for number, recorder in enumerate(recorders):
        counts = recorder.close()
        assert counts.streams["numbers"].written == 1
        assert written(tmp_path / str(number))[1] == [number]
        assert "end" in written(tmp_path / str(number))[-1]
    wait_until(lambda: not writers() - earlier, "end of the thread")


def test_who_goes_on_is_written_after_another_has_closed(tmp_path):
    thread = WriterThread(Recording())
    first, second = (recorder_in(tmp_path / name, thread) for name in ("a", "b"))
    first.start()
    second.start()
    first.close()
    second.record("numbers", (7,))

    assert second.close().streams["numbers"].written == 1
    assert written(tmp_path / "b")[1] == [7]


def test_who_never_started_is_written_when_it_closes_after_all_others(tmp_path):
    thread = WriterThread(Recording())
    first, second = (recorder_in(tmp_path / name, thread) for name in ("a", "b"))
    second.record("numbers", (7,))
    first.close()

    assert second.close().streams["numbers"].written == 1


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("a bug")])
def test_a_disk_that_refuses_one_keeps_nothing_from_the_others(tmp_path, monkeypatch, error):
    thread = WriterThread(Recording(flush_interval_s=0.01))
    write_waiting = StreamFile.write_waiting

    def write_elsewhere(file, *arguments, **named):
        if file.path.parent.name == "bad":
            raise error
        write_waiting(file, *arguments, **named)

    monkeypatch.setattr(StreamFile, "write_waiting", write_elsewhere)
    bad, good = (recorder_in(tmp_path / name, thread) for name in ("bad", "good"))
    for recorder in (bad, good):
        recorder.start()
        recorder.record("numbers", (1,))

    lost = bad.close(timeout_s=10)
    assert lost.streams["numbers"].written == 0
    assert str(error.args[-1]) in lost.errors[0]
    kept = good.close(timeout_s=10)
    assert kept.streams["numbers"].written == 1
    assert not kept.errors


@pytest.mark.parametrize("closing_s", [0.05])
def test_a_disk_that_hangs_is_told_by_whoever_waits_for_it(tmp_path, monkeypatch, closing_s):
    thread = WriterThread(Recording())
    recorder = recorder_in(tmp_path / "a", thread)
    released = threading.Event()
    monkeypatch.setattr(recorder._files, "write_waiting", lambda: released.wait(10))
    counts = recorder.close(timeout_s=closing_s)
    released.set()

    assert any("not on disk after" in error for error in counts.errors)
