"""Caches and registers in folders that others may write in: only what one wrote oneself is believed."""

import os
import socket

import pytest
from harness import full_disk

from cosmos_cli.evidence.run_index import index_directory, remembered_runs
from cosmos_cli.fleet import target_cache
from cosmos_cli.fleet.target import Target
from cosmos_cli.system import ownership
from cosmos_cli.system.ownership import keep_small_file, read_own_file


def test_own_file_is_read_up_to_its_bound(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"12345")

    assert read_own_file(path, bytes_max=5) == b"12345"
    with pytest.raises(OSError, match="at most 4 bytes"):
        read_own_file(path, bytes_max=4)


@pytest.mark.parametrize(
    ("text", "is_full"), [("kept", True), ("\ud800", False)], ids=["no name", "no content"]
)
def test_what_cannot_be_kept_leaves_nothing_behind(tmp_path, monkeypatch, text, is_full):
    if is_full:
        monkeypatch.setattr(os, "replace", full_disk.refuse)

    with pytest.raises((OSError, UnicodeEncodeError)):
        keep_small_file(tmp_path, "a", text, count_max=2)

    assert list(tmp_path.iterdir()) == []


def test_another_users_file_is_not_believed(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_bytes(b"")
    uid = path.stat().st_uid
    monkeypatch.setattr(ownership, "ROOT", uid + 1)
    monkeypatch.setattr(os, "geteuid", lambda: uid + 2)

    with pytest.raises(PermissionError):
        read_own_file(path, bytes_max=5)


def test_targets_that_another_user_laid_into_a_shared_cache_are_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path))
    target_cache.remember("key", (Target(name="pi01", address="192.0.2.1"),))
    assert target_cache.recall("key") is not None

    monkeypatch.setattr(ownership, "ROOT", -1)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)

    assert target_cache.recall("key") is None


def test_pipe_or_socket_in_the_index_of_runs_holds_nobody_up(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "s"))
    index_directory().mkdir(parents=True)
    os.mkfifo(index_directory() / "0001-a@00.json")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(os.path.relpath(index_directory() / "0002-a@00.json"))
        assert remembered_runs() == []
