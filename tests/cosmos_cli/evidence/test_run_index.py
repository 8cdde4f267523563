"""Runs are found from any folder, by what was remembered of them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import create_run
from cosmos_cli.evidence.run_index import index_directory, remember_run, remembered_runs
from cosmos_cli.evidence.run_search import find_run


@pytest.fixture(autouse=True)
def own_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")


@pytest.mark.parametrize("which", ["1", "0001", "0001-x"])
def test_run_is_found_from_another_folder(tmp_path: Path, which: str) -> None:
    run = create_run(tmp_path / "runs", "x")

    assert find_run(Path("runs"), which) == run


def test_a_run_that_cannot_be_looked_at_is_passed_over_and_not_forgotten(tmp_path: Path) -> None:
    run = create_run(tmp_path / "runs", "x")
    remember_run("0002-x", tmp_path / ("a" * 300))  # which no file system tells of

    assert remembered_runs() == [run.path]
    assert len(list(index_directory().iterdir())) == 2


def test_folder_that_was_named_is_meant_alone(tmp_path: Path) -> None:
    create_run(tmp_path / "runs", "x")

    with pytest.raises(InputError, match="no such run"):
        find_run(tmp_path / "others", "1")


def test_run_in_the_folder_here_comes_before_all_others(tmp_path: Path) -> None:
    create_run(tmp_path / "runs", "x")
    here = create_run(Path("runs"), "y")

    assert find_run(Path("runs"), "1") == here


def test_number_that_fits_runs_in_two_other_folders_asks_for_the_path(tmp_path: Path) -> None:
    first = create_run(tmp_path / "a", "x")
    second = create_run(tmp_path / "b", "x")

    with pytest.raises(InputError, match="several elsewhere; give the path") as refused:
        find_run(Path("runs"), "1")

    assert str(first.path) in str(refused.value)
    assert str(second.path) in str(refused.value)
    assert find_run(Path("runs"), str(second.path)) == second


def test_unpacked_run_here_is_not_passed_over_for_one_of_its_name_elsewhere(tmp_path: Path) -> None:
    first = create_run(tmp_path / "runs", "x")
    shutil.copytree(first.path, "0001-x")

    with pytest.raises(InputError, match="give the path") as refused:
        find_run(Path("runs"), "0001-x")

    assert str(refused.value).endswith(f"./0001-x, {first.path}")
    assert find_run(Path("runs"), "./0001-x").path == Path("0001-x").resolve()
    assert find_run(first.path.parent, "0001-x") == first


def test_run_whose_directory_is_gone_is_forgotten(tmp_path: Path) -> None:
    gone, kept = create_run(tmp_path / "a", "x"), create_run(tmp_path / "b", "y")
    shutil.rmtree(gone.path)

    names = remembered_runs()

    assert names == [kept.path]
    assert len(list(index_directory().iterdir())) == 1


def test_damaged_entry_and_unwritable_index_do_no_harm(tmp_path: Path) -> None:
    index_directory().mkdir(parents=True)
    (index_directory() / "0001-x@0.json").write_text("[")
    assert remembered_runs() == []
    index_directory().rmdir()
    index_directory().write_text("a file")

    remember_run("0002-y", tmp_path)

    assert remembered_runs() == []


def leave_package_alone(root: Path, name: str) -> None:
    run = create_run(root, name)
    shutil.rmtree(run.path)
    run.bundle.write_bytes(b"")


@pytest.mark.parametrize("which", ["1", "0001-x", "0001-x.tar.zst", "last"])
def test_packed_run_here_is_not_passed_over_for_one_elsewhere(tmp_path: Path, which: str) -> None:
    create_run(tmp_path / "runs", "x")
    leave_package_alone(Path("runs"), "x")

    with pytest.raises(InputError, match="0001-x: packed, its folder is gone; unpack it with"):
        find_run(Path("runs"), which)


def test_last_run_that_is_packed_is_not_passed_over_for_an_older_one() -> None:
    older = create_run(Path("runs"), "x")
    leave_package_alone(Path("runs"), "y")

    with pytest.raises(InputError, match="0002-y: packed"):
        find_run(Path("runs"), "last")
    assert find_run(Path("runs"), "1") == older


def test_number_that_a_packed_run_shares_asks_for_the_full_name() -> None:
    whole = create_run(Path("runs"), "x")
    leave_package_alone(Path("runs"), "y")
    Path("runs/0002-y.tar.zst").rename("runs/0001-y.tar.zst")

    with pytest.raises(InputError, match="0001-x, 0001-y match"):
        find_run(Path("runs"), "1")
    assert find_run(Path("runs"), "0001-x") == whole
