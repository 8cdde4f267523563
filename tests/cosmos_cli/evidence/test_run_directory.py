import os
import pwd
import shutil
import subprocess
import sys
import threading

import orjson
import pytest
from harness import full_disk
from harness.registered import registered
from harness.synthetic_run import make_config

from cosmos_cli.errors import InputError, RunFailedError
from cosmos_cli.evidence.run_directory import (
    RESERVE_BYTES,
    alone,
    begin_run,
    create_run,
    list_runs,
    runs_root,
)
from cosmos_cli.evidence.run_search import find_run
from madns_runtime.partial_file import write_whole


def test_runs_are_numbered_on(tmp_path):
    names = [create_run(tmp_path, name).name for name in ("iridium10", "counter", "iridium10")]

    assert names == ["0001-iridium10", "0002-counter", "0003-iridium10"]


def test_number_of_a_packed_run_whose_directory_is_gone_is_not_used_again(tmp_path):
    (tmp_path / "0006-old.tar.zst").touch()

    assert create_run(tmp_path, "new").name == "0007-new"


def test_number_has_more_digits_when_four_do_not_suffice(tmp_path):
    (tmp_path / "9999-last").mkdir()

    assert create_run(tmp_path, "x").name == "10000-x"


def test_runs_that_start_at_once_each_get_a_number(tmp_path):
    names = []
    start = threading.Barrier(8)

    def create(index):
        start.wait()
        names.append(create_run(tmp_path, f"scenario{index}").name)

    threads = [threading.Thread(target=create, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    # A number that two gave up at once may be nobody's.
    assert len({int(name[:4]) for name in names}) == 8


@pytest.mark.process
def test_processes_that_start_runs_at_once_each_get_a_number(tmp_path):
    code = "import sys; from cosmos_cli.evidence.run_directory import create_run; from pathlib import Path\n"
    code += "[create_run(Path(sys.argv[1]), 'p') for _ in range(10)]"
    children = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]

    assert [child.wait(60) for child in children] == [0, 0, 0]
    assert len({run.number for run in list_runs(tmp_path)}) == len(list_runs(tmp_path)) == 30


def test_scenario_name_cannot_leave_the_folder(tmp_path):
    run = create_run(tmp_path / "runs", "../../etc/pass wd")

    assert run.path.parent == (tmp_path / "runs").resolve()
    assert run.name == "0001-etc-pass-wd"


def test_new_run_holds_its_reserve(tmp_path):
    run = create_run(tmp_path, "x")

    assert run.reserve.stat().st_size == RESERVE_BYTES
    assert run.reserve.stat().st_blocks * 512 >= RESERVE_BYTES
    run.free_reserve()
    run.free_reserve()
    assert not run.reserve.exists()


@pytest.mark.parametrize("which", ["2", "0002", "0002-b", "PATH", "last"])
def test_run_is_found_by(tmp_path, which):
    create_run(tmp_path, "a")
    run = create_run(tmp_path, "b")

    assert find_run(tmp_path, str(run.path) if which == "PATH" else which) == run


@pytest.mark.parametrize("which", ["3", "nobody", "./nowhere", "../nowhere/x"])
def test_run_that_is_not_there_is_bad_input_and_the_message_lists_the_last(tmp_path, which):
    create_run(tmp_path, "a")

    with pytest.raises(InputError, match=r"no such run"):
        find_run(tmp_path, which)


@pytest.mark.parametrize("name", ["plan.json", "agents"])
def test_folder_that_is_no_run_is_refused_and_one_that_lost_something_is_not(tmp_path, name):
    (tmp_path / "photos" / "host").mkdir(parents=True)
    run = create_run(tmp_path, "x")
    begin_run(run, make_config(1), {})
    path = run.path / name
    path.rmdir() if path.is_dir() else path.unlink()

    assert find_run(tmp_path, str(run.path)) == run
    with pytest.raises(InputError, match="no run directory"):
        find_run(tmp_path, str(tmp_path / "photos"))


def test_link_is_no_run_unless_its_path_is_named(tmp_path):
    victim = create_run(tmp_path / "elsewhere", "x")
    run = create_run(tmp_path / "runs", "a")
    link = tmp_path / "runs" / "0099-evil"
    link.symlink_to(victim.path)
    (tmp_path / "runs" / "0098-packed.tar.zst").symlink_to(victim.reserve)

    assert list_runs(tmp_path / "runs") == [run]
    assert find_run(tmp_path / "runs", "last") == run
    for which in ("99", "0099-evil"):
        with pytest.raises(InputError, match=f"not followed.*{victim.path}"):
            find_run(tmp_path / "runs", which)
    assert find_run(tmp_path / "runs", str(link)) == victim


def test_folder_that_only_bears_a_runs_name_is_not_found(tmp_path):
    run = create_run(tmp_path, "a")
    (tmp_path / "0099-photos" / "host").mkdir(parents=True)

    assert find_run(tmp_path, "last") == run
    for which in ("99", "0099-photos"):
        with pytest.raises(InputError, match=r"no run directory: expected plan\.json"):
            find_run(tmp_path, which)


@pytest.mark.parametrize("which", ["9" * 5000, "x" * 5000, f"./{'x' * 5000}"])
def test_name_that_no_run_can_have_is_bad_input(tmp_path, which):
    create_run(tmp_path, "a")

    with pytest.raises(InputError, match="no such run"):
        find_run(tmp_path, which)


def test_folder_of_runs_that_is_a_file_is_bad_input(tmp_path):
    (tmp_path / "file").touch()

    for ask in (list_runs, lambda root: find_run(root, "last")):
        with pytest.raises(InputError, match="file: expected the folder of all runs.*--runs"):
            ask(tmp_path / "file")


def test_a_run_in_this_folder_that_is_named_without_its_path_is_pointed_at(tmp_path, monkeypatch):
    create_run(tmp_path / "unpacked", "x")
    monkeypatch.chdir(tmp_path / "unpacked")

    with pytest.raises(InputError, match="if the folder here is meant, name it ./0001-x"):
        find_run(tmp_path / "runs", "0001-x")


def test_run_of_another_user_is_not_written_into_but_by_root(tmp_path, monkeypatch):
    run = create_run(tmp_path, "x")
    owner = pwd.getpwuid(os.getuid()).pw_name
    also = owner if os.getuid() == 0 else f"{owner} or root"
    monkeypatch.setattr("cosmos_cli.system.ownership.os.geteuid", lambda: os.getuid() + 1)

    with pytest.raises(InputError, match=f"belongs to {owner}.*; let {also} repeat"), alone(run):
        pass
    with alone(run, must_own=False):
        pass
    monkeypatch.setattr("cosmos_cli.system.ownership.os.geteuid", lambda: 0)
    with alone(run):
        pass


def test_run_that_was_deleted_before_its_end_is_told_in_words(tmp_path):
    run = create_run(tmp_path, "x")
    shutil.rmtree(run.path)

    with pytest.raises(RunFailedError, match="was the run deleted"), alone(run):
        pass


def test_unwritable_root_says_which_option_helps(tmp_path):
    (tmp_path / "file").touch()

    with pytest.raises(InputError, match="--runs or COSMOS_RUNS"):
        create_run(tmp_path / "file", "x")


def test_root_is_the_option_then_the_variable_then_runs(monkeypatch):
    monkeypatch.setenv("COSMOS_RUNS", "/elsewhere")
    assert str(runs_root("here")) == "here"
    assert str(runs_root()) == "/elsewhere"
    monkeypatch.delenv("COSMOS_RUNS")
    assert str(runs_root()) == "runs"


def test_run_json_says_running_from_the_start(tmp_path):
    run = create_run(tmp_path, "x")

    begin_run(run, make_config(3), {"machines": {"loopback": ["agent-01"]}})

    document = run.read_json(run.run_json)
    assert (document["status"], document["exit_code"]) == ("running", None)
    assert document["seed"] == 7
    assert document["versions"]["cosmos-madns"]
    assert run.read_config() == make_config(3)


def test_failed_replacement_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch):
    path = tmp_path / "run.json"
    write_whole(path, b"old")

    monkeypatch.setattr("madns_runtime.partial_file.os.fsync", full_disk.refuse)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new")

    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.json"]


def test_unreadable_json_is_none(tmp_path):
    run = create_run(tmp_path, "x")
    run.run_json.write_bytes(b'{"schema": 1,')

    assert run.read_json(run.run_json) is None
    run.run_json.write_bytes(orjson.dumps([1]))
    assert run.read_json(run.run_json) is None


@pytest.mark.parametrize("what", ["_allocate", "remember_run"])
def test_run_that_could_not_be_made_is_not_there_to_be_collected(tmp_path, monkeypatch, what):
    create_run(tmp_path, "a")

    monkeypatch.setattr(f"cosmos_cli.evidence.run_directory.{what}", full_disk.refuse)
    with pytest.raises(InputError, match="No space"):
        create_run(tmp_path, "b")

    assert [run.name for run in list_runs(tmp_path)] == ["0001-a"]


@pytest.mark.process
@pytest.mark.parametrize("folder", ["", "host"])
def test_number_of_a_living_run_is_not_given_again_when_its_folder_is_deleted(tmp_path, folder):
    first = create_run(tmp_path / "runs", "a")
    places = {"directory": first.path / folder, "state": os.environ["COSMOS_STATE_DIR"]}
    with registered(first.name, "host", "host", **places):
        shutil.rmtree(tmp_path / "runs")

        assert create_run(tmp_path / "runs", "a").name == "0002-a"
        assert create_run(tmp_path / "elsewhere", "a").name == "0001-a"
    assert create_run(tmp_path / "third", "a").name == "0001-a"


def test_folder_of_all_runs_may_be_said_from_the_home(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("COSMOS_RUNS", "~/of-a-variable")

    assert runs_root() == tmp_path / "of-a-variable"
    assert runs_root("~/of-an-option") == tmp_path / "of-an-option"
