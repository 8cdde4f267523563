"""Only regular files of a bounded size are read, without waiting for anybody."""

from __future__ import annotations

import gc
import os
import socket
import threading
from pathlib import Path

import pytest

from madns_runtime import bounded_files
from madns_runtime.bounded_files import FileTooLarge, NotARegularFile, read_regular_file


def test_a_regular_file_is_read_whole_up_to_its_bound(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 100)

    assert read_regular_file(path, bytes_max=100) == b"x" * 100


def test_a_file_of_many_pieces_is_read_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounded_files, "PIECE_BYTES", 7)
    content = bytes(range(256))
    path = tmp_path / "file"
    path.write_bytes(content)

    assert read_regular_file(path, bytes_max=256) == content


def test_one_byte_too_many_is_told_with_both_sizes(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x" * 101)

    with pytest.raises(FileTooLarge, match=f"{path}: expected at most 100 bytes, got 101"):
        read_regular_file(path, bytes_max=100)


def test_a_sparse_file_of_terabytes_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    with path.open("wb") as file:
        file.truncate(2**40)
    reads: list[int] = []
    monkeypatch.setattr(os, "read", lambda descriptor, size: reads.append(size))

    with pytest.raises(FileTooLarge, match=f"got {2**40}"):
        read_regular_file(path, bytes_max=1000)
    assert reads == []


def test_a_file_that_tells_no_size_is_bounded_while_it_is_read() -> None:
    with pytest.raises(FileTooLarge, match="expected at most 10 bytes, got more"):
        read_regular_file("/proc/self/status", bytes_max=10)


def test_a_pipe_that_nobody_writes_to_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    caught: list[BaseException] = []

    def read() -> None:
        try:
            read_regular_file(path, bytes_max=10)
        except OSError as error:
            caught.append(error)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    reader.join(30)

    assert [str(error) for error in caught] == [
        f"{path}: expected a file, got a pipe: write what it carries to a file"
    ]


def test_a_pipe_that_takes_a_files_place_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    regular, path = tmp_path / "file", tmp_path / "pipe"
    regular.touch()
    os.mkfifo(path)
    before = os.stat(regular)
    monkeypatch.setattr(os, "stat", lambda _: before)

    with pytest.raises(NotARegularFile, match="got a pipe"):
        read_regular_file(path, bytes_max=10)


@pytest.mark.parametrize(
    ("path", "kind"), [("/dev/zero", "a device"), ("/dev", "a folder"), ("/dev/tty", "a device")]
)
def test_what_is_no_file_is_named(path: str, kind: str) -> None:
    with pytest.raises(NotARegularFile) as caught:
        read_regular_file(path, bytes_max=10)
    assert caught.value.strerror == f"expected a file, got {kind}"


def test_a_socket_is_named(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        with pytest.raises(NotARegularFile, match="got a socket"):
            read_regular_file(path, bytes_max=10)


def test_a_path_with_nul_is_an_error_of_the_file() -> None:
    with pytest.raises(OSError, match="without NUL"):
        read_regular_file("a\0b", bytes_max=10)


def test_a_missing_file_is_told_as_ever(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_regular_file(tmp_path / "none", bytes_max=10)


def test_no_descriptor_is_left_behind(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"xxx")
    gc.collect()  # what earlier tests left is not to be closed in the midst of this one
    before = len(os.listdir("/proc/self/fd"))
    for bound in (1, 3):
        try:
            read_regular_file(path, bytes_max=bound)
        except FileTooLarge:
            continue

    assert len(os.listdir("/proc/self/fd")) <= before
