import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from madns_runtime import processes
from madns_runtime.processes import (
    end_process,
    is_running,
    list_processes,
    read_start_ticks,
    register,
    state_directory,
)


@pytest.fixture(autouse=True)
def register_directory(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state/processes"


@pytest.fixture
def child():
    """A process that does nothing, and can be killed."""
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as process:
        yield process
        process.kill()


def enter(directory, **changes):
    """Write this process's entry with changes, as another process or an earlier boot would have left it."""
    with register("0001-test", "agent", "a-1", "/runs/1") as registration:
        entry = dataclasses.replace(registration.entry, **changes)
    path = directory / f"{entry.pid}-{entry.start_ticks}-77.json"
    path.write_text(json.dumps(dataclasses.asdict(entry)))
    return entry, path


def test_registered_process_is_listed_until_it_is_removed(register_directory):
    registration = register("0007-iridium10", "host", "host", "/runs/0007-iridium10")

    assert registration.problem is None
    assert list_processes() == [registration.entry]
    assert registration.entry.pid == os.getpid()
    assert registration.entry.run_directory == "/runs/0007-iridium10"
    assert is_running(registration.entry)
    registration.remove()
    registration.remove()
    assert list_processes() == []
    assert list(register_directory.iterdir()) == []


def test_registration_ends_with_its_block():
    with register("r", "supervisor", "pi07", "/runs/1") as registration:
        assert [entry.name for entry in list_processes()] == ["pi07"]

    assert registration.problem is None
    assert list_processes() == []


def test_one_process_may_hold_many_entries_in_order_of_their_names():
    with register("r", "agent", "b", "/"), register("r", "agent", "a", "/"):
        assert [entry.name for entry in list_processes()] == ["a", "b"]


def test_process_of_many_agents_is_listed_by_its_first_and_last():
    names = [f"agent-{number:04d}" for number in range(1, 1501)]
    with register("r", "agent", ",".join(names), "/runs/1"):
        listed = [entry.name for entry in list_processes()]

    assert listed == ["agent-0001 ... agent-1500 (1500)"]


def test_process_of_an_agent_with_an_endless_name_is_still_listed():
    with register("r", "agent", "ä" * 20_000, "/runs/1"):
        listed = [entry.name for entry in list_processes()]

    assert len(listed) == 1
    assert listed[0].endswith("ä ...")


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"COSMOS_STATE_DIR": "/x"}, "/x/processes"),
        ({"COSMOS_STATE_DIR": "~/x", "HOME": "/home/pi"}, "/home/pi/x/processes"),
        ({"XDG_STATE_HOME": "/y"}, "/y/cosmos/processes"),
        ({"HOME": "/home/pi"}, "/home/pi/.local/state/cosmos/processes"),
    ],
)
def test_register_is_where_the_environment_says(monkeypatch, variables, expected):
    for name in ("COSMOS_STATE_DIR", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)

    assert str(state_directory()) == expected


def test_register_of_who_has_no_home_is_at_none_of_the_present_folder(monkeypatch):
    """As of a number that a container is given for a user: ~ would be a folder of that name."""
    for name in ("COSMOS_STATE_DIR", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)

    assert str(state_directory()) == "/.local/state/cosmos/processes"


def test_entry_of_an_earlier_boot_is_removed(register_directory):
    entry, path = enter(register_directory, boot_id="00000000-0000-0000-0000-000000000000")

    assert not is_running(entry)
    assert list_processes() == []
    assert not path.exists()


def test_no_entry_is_removed_by_a_process_that_cannot_see_who_lives(
    register_directory, monkeypatch
):
    entry, path = enter(register_directory)
    monkeypatch.setattr(processes, "read_start_ticks", lambda pid: None)

    assert list_processes() == [entry]
    assert path.exists()


SHORTAGES = [errno.EMFILE, errno.ENFILE, errno.ENOMEM]


@pytest.fixture(params=SHORTAGES, ids=lambda number: errno.errorcode[number])
def shortage(request, monkeypatch):
    """What nobody can read while descriptors or memory have run out, by the end of its path."""
    missed = []

    def answers(function):
        def call(path, *arguments, **settings):
            if any(str(path).endswith(end) for end in missed):
                raise OSError(request.param, os.strerror(request.param), str(path))
            return function(path, *arguments, **settings)

        return call

    for name in ("read_bytes", "read_text", "iterdir"):
        monkeypatch.setattr(Path, name, answers(getattr(Path, name)))
    monkeypatch.setattr(os, "open", answers(os.open))
    return missed


@pytest.mark.process
@pytest.mark.parametrize("what", ["/stat", "/boot_id"])
def test_process_that_cannot_be_asked_about_has_not_ended(
    register_directory, child, shortage, what
):
    entry, path = enter(register_directory, pid=child.pid, start_ticks=read_start_ticks(child.pid))
    shortage.append(f"{child.pid}{what}" if what == "/stat" else what)

    for ask in (is_running, lambda entry: end_process(entry, signal.SIGKILL)):
        with pytest.raises(OSError, match="Too many|Cannot allocate"):
            ask(entry)
    with pytest.raises(OSError, match="Too many|Cannot allocate"):
        list_processes()
    assert path.exists()
    assert child.poll() is None
    shortage.clear()
    assert list_processes() == [entry]


@pytest.mark.parametrize("what", ["state/processes", "-77.json"])
def test_register_that_cannot_be_read_for_now_is_not_taken_for_empty(
    register_directory, shortage, what
):
    entry, _ = enter(register_directory)
    shortage.append(what)

    with pytest.raises(OSError, match="Too many|Cannot allocate"):
        list_processes()
    shortage.clear()
    assert list_processes() == [entry]


def test_process_that_cannot_see_its_own_start_is_not_entered_as_a_dead_one(
    register_directory, shortage
):
    shortage.append(f"/proc/{os.getpid()}/stat")

    with register("r", "agent", "a-1", "/runs/1") as registration:
        assert "cannot note process" in registration.problem
        assert not register_directory.exists()


@pytest.mark.process
def test_entry_whose_pid_was_given_out_again_is_removed_and_not_signalled(
    register_directory, child
):
    entry, path = enter(
        register_directory, pid=child.pid, start_ticks=read_start_ticks(child.pid) - 1
    )

    assert not end_process(entry, signal.SIGKILL)
    assert list_processes() == []
    assert not path.exists()
    assert child.poll() is None


@pytest.mark.process
def test_entry_of_a_dead_process_is_removed(register_directory, child):
    entry, path = enter(register_directory, pid=child.pid, start_ticks=read_start_ticks(child.pid))
    assert list_processes() == [entry]
    child.kill()
    child.wait()

    assert not end_process(entry)
    assert list_processes() == []
    assert not path.exists()


@pytest.mark.process
def test_zombie_has_ended(register_directory, child):
    entry, _ = enter(register_directory, pid=child.pid, start_ticks=read_start_ticks(child.pid))
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)

    assert not is_running(entry)
    assert list_processes() == []


@pytest.mark.process
@pytest.mark.parametrize("has_descriptors", [True, False], ids=["pidfd", "old kernel"])
def test_process_is_ended_by_its_entry(register_directory, child, monkeypatch, has_descriptors):
    if not has_descriptors:
        monkeypatch.delattr(os, "pidfd_open")
    entry, _ = enter(register_directory, pid=child.pid, start_ticks=read_start_ticks(child.pid))

    assert end_process(entry, signal.SIGTERM)
    assert child.wait(60) == -signal.SIGTERM
    assert not end_process(entry, signal.SIGTERM)


def test_entry_of_another_machine_is_neither_listed_nor_removed(register_directory):
    _, path = enter(register_directory, node="another-board", start_ticks=1)

    assert list_processes() == []
    assert path.exists()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"pid": 1}'])
def test_unreadable_entry_of_a_dead_process_is_removed(register_directory, text):
    _, path = enter(register_directory, start_ticks=1)
    path.write_text(text)

    assert list_processes() == []
    assert not path.exists()


def test_draft_that_a_killed_process_left_is_removed(register_directory):
    _, path = enter(register_directory, start_ticks=1)
    draft = path.rename(path.with_name(f".{path.name}"))

    assert list_processes() == []
    assert not draft.exists()


def test_files_that_are_no_entries_are_left_alone(register_directory):
    register_directory.mkdir(parents=True)
    (register_directory / "notes.txt").write_text("mine")

    assert list_processes() == []
    assert (register_directory / "notes.txt").read_text() == "mine"


@pytest.mark.process
def test_entry_of_a_pid_that_is_not_its_file_names_is_not_believed(register_directory, child):
    entry, path = enter(register_directory)
    other = {"pid": child.pid, "start_ticks": read_start_ticks(child.pid)}
    path.write_text(json.dumps({**dataclasses.asdict(entry), **other}))

    assert list_processes() == []


def test_register_that_cannot_be_written_is_a_problem_and_no_failure(register_directory):
    register_directory.parent.write_text("a file where a folder should be")
    with register("r", "agent", "a-1", "/runs/1") as registration:
        assert "cannot note process" in registration.problem
        assert "agent a-1" in registration.problem
        assert list_processes() == []


@pytest.mark.process
def test_forked_process_does_not_remove_its_parents_entry():
    with register("r", "supervisor", "pi07", "/runs/1"):
        pid = os.fork()
        if not pid:
            with register("r", "agent", "a-1", "/runs/1") as own:
                own_pids = {entry.pid for entry in list_processes()}
            os._exit(0 if own_pids == {os.getpid(), os.getppid()} and own.problem is None else 1)
        _, status = os.waitpid(pid, 0)

        assert os.waitstatus_to_exitcode(status) == 0
        assert [entry.name for entry in list_processes()] == ["pi07"]


@pytest.mark.process
def test_forked_process_leaves_its_parents_block_alone():
    registration = register("r", "supervisor", "pi07", "/runs/1")
    pid = os.fork()
    if not pid:
        registration.remove()
        os._exit(0)
    os.waitpid(pid, 0)

    assert [entry.name for entry in list_processes()] == ["pi07"]


def test_start_is_read_behind_any_process_name(monkeypatch, tmp_path):
    fields = " ".join(str(number) for number in range(4, 53))
    (tmp_path / "stat").write_text(f"42 (a) b (c) S {fields}\n")
    monkeypatch.setattr(processes, "Path", lambda _: tmp_path / "stat")

    assert read_start_ticks(42) == 22


@pytest.mark.process
def test_age_is_that_of_the_process_and_not_of_what_started_it():
    code = "import time; from madns_runtime.processes import own_age_s; time.sleep(0.5); print(own_age_s())"
    start_s = time.monotonic()
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lasted_s = time.monotonic() - start_s

    assert 0.5 <= float(said.stdout) <= lasted_s + 0.02  # clock ticks are 0.01 s
