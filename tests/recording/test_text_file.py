"""What a program wrote, kept beside the records: first part and last, the rest counted."""

import pytest

from madns_runtime.config import Recording
from madns_runtime.errors import PluginError
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.text_file import HEAD_BYTES, TAIL_BYTES, TextFile


def test_what_fits_is_kept_as_it_is(tmp_path):
    text = TextFile(tmp_path / "said.txt")
    text.add(b"one\n")
    text.write_waiting()
    assert (tmp_path / "said.txt").read_bytes() == b"one\n"

    text.add(b"two\n")
    text.finish()

    assert (tmp_path / "said.txt").read_bytes() == b"one\ntwo\n"
    assert text.dropped_bytes == 0


def test_of_too_much_the_first_part_and_the_last_are_kept(tmp_path):
    text = TextFile(tmp_path / "said.txt")
    for number in range(300_000):
        text.add(b"line %06d\n" % number)
    text.finish()

    kept = (tmp_path / "said.txt").read_bytes()
    assert kept.startswith(b"line 000000\n")
    assert kept.endswith(b"line 299999\n")
    assert text.dropped_bytes == 300_000 * 12 - HEAD_BYTES - TAIL_BYTES
    assert f"[{text.dropped_bytes} bytes are left out]".encode() in kept
    assert len(kept) < HEAD_BYTES + TAIL_BYTES + 100


def test_what_waits_is_bounded_though_nobody_writes(tmp_path):
    text = TextFile(tmp_path / "said.txt")
    for _ in range(100):
        text.add(bytes(100_000))

    assert sum(map(len, text._head)) + len(text._tail) == HEAD_BYTES + TAIL_BYTES


def test_a_later_process_continues_the_file_within_its_bound(tmp_path):
    (tmp_path / "said.txt").write_bytes(bytes(HEAD_BYTES - 2))
    text = TextFile(tmp_path / "said.txt")
    text.add(b"abcd")
    text.finish()

    assert (tmp_path / "said.txt").read_bytes()[-4:] == b"abcd"
    assert text.dropped_bytes == 0


def test_no_link_is_followed(tmp_path):
    (tmp_path / "target").write_text("mine")
    (tmp_path / "said.txt").symlink_to(tmp_path / "target")
    text = TextFile(tmp_path / "said.txt")
    text.add(b"theirs")

    with pytest.raises(OSError, match="symbolic links"):
        text.write_waiting()
    assert (tmp_path / "target").read_text() == "mine"


def recorder(tmp_path):
    return Recorder(RecordFiles(tmp_path, run="0001-x", source="agent-01"), Recording())


def test_a_recorder_keeps_texts_whatever_its_verbosity(tmp_path):
    settings = Recording(verbosity=0)
    keeping = Recorder(RecordFiles(tmp_path, run="0001-x", source="agent-01"), settings)
    keeping.start()
    keeping.keep_text("said", b"hello\n")
    keeping.close()

    assert (tmp_path / "said.txt").read_bytes() == b"hello\n"


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden"])
def test_a_name_that_is_no_file_name_is_refused(tmp_path, name):
    with pytest.raises(PluginError, match="expected a name of letters"):
        recorder(tmp_path).keep_text(name, b"x")


def test_text_that_is_no_bytes_is_refused_and_costs_no_record(tmp_path):
    keeping = recorder(tmp_path)

    with pytest.raises(PluginError, match=r"keep_text\('said'\): expected bytes, got str; encode"):
        keeping.keep_text("said", "hello")
    keeping.keep_text("said", bytearray(b"hello"))
    keeping.close()
    assert (tmp_path / "said.txt").read_bytes() == b"hello"


def test_a_disk_that_refuses_is_told_of(tmp_path):
    keeping = recorder(tmp_path)
    (tmp_path / "said.txt").mkdir()
    keeping.keep_text("said", b"x")

    assert "said.txt" in "".join(keeping.close().errors)
