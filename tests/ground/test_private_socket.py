"""Sockets of one user: who finds the name of one is let in, and another file at its name stays."""

import os
import socket
import stat

import pytest

from madns_runtime.private_socket import listen


def connects(path):
    with socket.socket(socket.AF_UNIX) as visitor:
        return visitor.connect_ex(os.fspath(path)) == 0


def test_it_listens_before_it_has_its_name(tmp_path, monkeypatch):
    path, rename, looks = tmp_path / "door", os.rename, []

    def look(old, new):
        looks.append((path.exists(), connects(old)))
        rename(old, new)

    monkeypatch.setattr(os, "rename", look)
    with listen(tmp_path, "door", backlog=4):
        assert looks == [(False, True)]
        assert connects(path)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert [each.name for each in tmp_path.iterdir()] == ["door"]


@pytest.mark.parametrize("name", ["door", "door.new"])
def test_one_that_an_earlier_process_left_gives_way(name, tmp_path):
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(os.fspath(tmp_path / name))
    with listen(tmp_path, "door", backlog=1):
        assert connects(tmp_path / "door")


@pytest.mark.parametrize("name", ["door", "door.new"])
def test_another_file_stays_and_is_told(name, tmp_path):
    (tmp_path / name).write_text("mine")
    with pytest.raises(OSError, match="exist|in use"):
        listen(tmp_path, "door", backlog=1)
    assert (tmp_path / name).read_text() == "mine"


def test_a_long_path_is_reached_through_its_folder(tmp_path):
    folder = tmp_path / ("deep" * 40)
    folder.mkdir()
    with listen(folder, "door", backlog=1):
        assert (folder / "door").is_socket()
