"""Numbers of runs in a folder that others share: given once, and nobody can hold them up."""

import fcntl
import os

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.evidence import run_number
from cosmos_cli.evidence.run_directory import create_run, list_runs
from cosmos_cli.evidence.run_number import NoNumber, make_numbered


@pytest.fixture(autouse=True)
def own_register(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))


def test_lock_file_of_a_shared_folder_is_neither_followed_nor_waited_for(tmp_path):
    """Earlier states locked runs/.lock: whoever could write there had any file emptied, or all runs wait."""
    root = tmp_path / "runs"
    root.mkdir()
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    (root / ".lock").symlink_to(victim)
    holder = os.open(victim, os.O_RDONLY)
    fcntl.flock(holder, fcntl.LOCK_EX)
    try:
        run = create_run(root, "a")
    finally:
        os.close(holder)

    assert run.number == 1
    assert victim.read_bytes() == b"precious"


def test_number_that_another_took_at_the_same_moment_is_given_up(tmp_path):
    looks = iter([[], [(1, "0001-other"), (1, "0001-mine")], [(1, "0001-other")]])

    path = make_numbered(tmp_path, "mine", lambda: next(looks, []), mode=0o700)

    assert path.name == "0002-mine"
    assert os.listdir(tmp_path) == ["0002-mine"]


def test_number_that_no_run_has_keeps_nobody_from_theirs(tmp_path):
    (tmp_path / f"{'9' * 246}-x").mkdir()

    assert create_run(tmp_path, "a").name == "0001-a"


def test_folder_whose_last_number_is_taken_asks_for_another(tmp_path):
    (tmp_path / "999999999-x").mkdir()

    with pytest.raises(InputError, match="number 999999999 is taken.*move.*--runs"):
        create_run(tmp_path, "a")


def test_number_of_a_link_is_not_given_again(tmp_path):
    (tmp_path / "0001-a").symlink_to(tmp_path)

    assert create_run(tmp_path, "a").name == "0002-a"


def test_others_who_are_always_quicker_end_the_search(tmp_path, monkeypatch):
    monkeypatch.setattr(run_number, "PAUSE_S_MAX", 0.0)

    def taken():
        return [(int(path.name[:4]), "other") for path in tmp_path.iterdir()]

    with pytest.raises(NoNumber, match="others took every number first"):
        make_numbered(tmp_path, "mine", taken, mode=0o700)
    assert list_runs(tmp_path) == []
