"""`cosmos wipe` deletes what was collected, asks before, and keeps everything else."""

import json
import os
import shutil
import sys

import pytest
import yaml
from harness.split_run import SplitRun

from cosmos_cli import app
from cosmos_cli.collect.wipe import Findings, RunThere, make_order
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def off(tmp_path, monkeypatch):
    """Machines that do not answer, by name; the others are folders here."""
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("COSMOS_RUNS", str(tmp_path / "runs"))
    machines = set()

    def connect(target, _options):
        if target.name in machines:
            raise MachineFailure(FailureKind.UNREACHABLE, "no route to host", "is it switched on?")
        return LocalConnection(target)

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    return machines


@pytest.fixture
def split(tmp_path):
    split = SplitRun(tmp_path)
    hosts = {
        name: {
            "ansible_host": target.address,
            "ansible_python_interpreter": sys.executable,
            "cosmos_root": target.root,
        }
        for name, target in split.targets.items()
    }
    hosts["laptop"] = {"ansible_connection": "local"}
    (tmp_path / "tower.yaml").write_text(yaml.safe_dump({"all": {"hosts": hosts}}, sort_keys=False))
    return split


@pytest.fixture
def wipe(tmp_path, capsys):
    def run(*options):
        code = app.run(["wipe", "-i", str(tmp_path / "tower.yaml"), *options])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def collected_but_there(split, tmp_path):
    """Collect a run and put back what lay on its machines, as if nothing had been released."""
    copies = {name: tmp_path / f"copy-{name}" for name in split.names}
    for name, copy in copies.items():
        shutil.copytree(split.directory(name), copy)
    split.retrieve()
    for name, copy in copies.items():
        copy.rename(split.directory(name))


def test_what_was_never_collected_is_kept(split, wipe):
    before = {name: split.there(name) for name in split.names}

    code, out, err = wipe("--yes")

    assert code == 0, err
    assert out.splitlines()[-1] == "3 machines: 0 runs deleted (0 B), 2 kept, 0 failed"
    assert "not collected" in out
    assert {name: split.there(name) for name in split.names} == before


def test_what_was_collected_is_deleted(split, wipe, tmp_path):
    collected_but_there(split, tmp_path)

    code, out, err = wipe("--yes")

    assert code == 0, err
    assert out.splitlines()[-1].startswith("3 machines: 2 runs deleted (")
    assert not any(split.directory(name).exists() for name in split.names)


@pytest.mark.parametrize("harm", ["there", "here", "note"])
def test_what_is_no_longer_what_was_collected_is_kept(split, wipe, tmp_path, harm):
    collected_but_there(split, tmp_path)
    if harm == "there":
        (split.directory("pi01") / "agents/agent-01/late.jsonl").touch()
    elif harm == "here":
        path = split.run.path / "agents/agent-01/ticks.jsonl"
        path.write_bytes(path.read_bytes() + b"x")
    else:
        (split.run.path / "machines/pi01/retrieved.json").unlink()

    code, out, _ = wipe("--yes")

    assert code == 0
    assert "1 run deleted" in out
    assert split.directory("pi01").exists()
    assert not split.directory("pi02").exists()


def test_uncollected_runs_go_when_that_is_asked_for(split, wipe):
    code, out, _ = wipe("--yes", "--uncollected")

    assert code == 0
    assert "2 runs deleted" in out
    assert not split.directory("pi01").exists()


def test_only_chosen_machines_are_wiped(split, wipe):
    wipe("--yes", "--uncollected", "--limit", "pi02")

    assert split.directory("pi01").exists()
    assert not split.directory("pi02").exists()


def test_without_a_terminal_it_must_be_agreed_to_beforehand(split, wipe):
    code, _, err = wipe("--uncollected")

    assert code == 2
    assert "delete 2 runs (" in err
    assert "2 of them NEVER COLLECTED) on 2 machines? there is no terminal to ask at" in err
    assert split.directory("pi01").exists()


@pytest.mark.parametrize(("answer", "is_gone"), [("y", True), ("n", False), ("", False)])
def test_on_a_terminal_it_asks(split, wipe, monkeypatch, answer, is_gone):
    class Terminal:
        def isatty(self):
            return True

        def readline(self):
            return f"{answer}\n"

    monkeypatch.setattr(sys, "stdin", Terminal())

    code, _, err = wipe("--uncollected")

    assert code == 0
    assert "[y/N]" in err
    assert split.directory("pi01").exists() is not is_gone
    assert ("nothing was deleted" in err) is not is_gone


def test_living_run_is_kept_whatever_is_asked(split, wipe):
    with split.living("pi02", "supervisor", "pi02") as pid:
        code, out, _ = wipe("--yes", "--uncollected")

        assert code == 0
        assert f"running: supervisor pi02 (pid {pid})" in out
        assert split.directory("pi02").exists()
        code, _, err = wipe("--yes", "--all", "--uncollected")
        assert code == 3
        assert f"pi02: failed: still running there: supervisor pi02 (pid {pid})" in err
    assert split.directory("pi02").exists()
    assert not os.path.exists(split.targets["pi01"].root)


def test_machine_that_does_not_answer_does_not_keep_the_others(split, wipe, off):
    off.add("pi01")

    code, out, err = wipe("--yes", "--uncollected", "--json")

    document = json.loads(out)
    assert code == document["exit_code"] == 3
    assert "pi01: failed: no route to host; is it switched on?" in err
    first, second, laptop = document["machines"]
    assert (first["ok"], first["failure"]["kind"]) == (False, "unreachable")
    assert second["deleted"] == [split.directory("pi02").name]
    assert (laptop["ok"], laptop["found"]) == (True, [])
    assert not split.directory("pi02").exists()


def installed(split, name):
    root = split.directory(name).parents[1]
    for folder in ("trees/ab12", "environments/cd34/bin", "wheels/ef56"):
        (root / folder).mkdir(parents=True)
        (root / folder / "file").write_bytes(b"x" * 1000)
    (root / "state").mkdir(exist_ok=True)
    return root


def test_all_of_it_goes(split, wipe):
    root = installed(split, "pi01")

    code, out, err = wipe("--yes", "--all", "--uncollected", "--limit", "pi01")

    assert code == 0, err
    assert "environments, trees, wheels" in out
    assert not root.exists()


def test_all_of_it_goes_but_what_was_not_collected_and_the_memory_of_settings(split, wipe):
    root = installed(split, "pi01")
    memory = {"schema": 1, "settings": {"receive_buffer_bytes": {"values": {"a": "b"}}}}
    (root / "state/settings.json").write_text(json.dumps(memory))

    code, _, err = wipe("--yes", "--all", "--limit", "pi01")

    assert code == 0
    assert sorted(os.listdir(root)) == ["runs", "state"]
    assert os.listdir(root / "state") == ["settings.json"]
    assert split.there("pi01")
    assert f"kept runs/{split.directory('pi01').name}, which was not collected" in err
    assert "kept state/settings.json, which remembers what settings were before" in err


def test_folder_that_is_not_cosmos_alone_is_never_deleted(split, wipe):
    root = installed(split, "pi01")
    (root / "thesis.tex").write_text("mine")

    code, _, err = wipe("--yes", "--all", "--uncollected", "--limit", "pi01")

    assert code == 3
    assert "holds what is not COSMoS's: thesis.tex" in err
    assert (root / "trees/ab12/file").exists()
    assert split.directory("pi01").exists()


def test_what_began_to_change_after_it_was_shown_is_kept(split, wipe, monkeypatch):
    from cosmos_cli.commands import wipe as command

    def change_then_agree(_question, *, is_sure):
        (split.directory("pi01") / "new.jsonl").write_text("1\n")
        return True

    monkeypatch.setattr(command, "confirm", change_then_agree)

    code, _, err = wipe("--uncollected")

    assert code == 3
    assert "has changed since it was listed" in err
    assert split.directory("pi01").exists()
    assert not split.directory("pi02").exists()


def test_what_went_before_a_machine_failed_is_counted(split, wipe, monkeypatch):
    from cosmos_cli.commands import wipe as command

    old = split.directory("pi01").with_name("0000-old-00112233")
    old.mkdir()
    (old / "ticks.jsonl").write_text("1\n")

    def change_then_agree(_question, *, is_sure):
        (split.directory("pi01") / "new.jsonl").write_text("1\n")
        return True

    monkeypatch.setattr(command, "confirm", change_then_agree)

    code, out, err = wipe("--uncollected", "--limit", "pi01", "--json")

    told = json.loads(out)["machines"][0]
    assert (code, told["ok"], old.exists(), split.directory("pi01").exists()) == (
        3,
        False,
        False,
        True,
    )
    assert (told["deleted"], told["deleted_bytes"]) == ([old.name], 2)
    assert f"pi01: deleted before it failed: {old.name}" in err


def test_machine_where_another_command_works_is_left_alone(split, wipe):
    import fcntl

    state = split.state("pi01")
    state.mkdir(parents=True)
    with (state / "lock").open("w") as lock:
        lock.write("cosmos up by ann")
        lock.flush()
        fcntl.flock(lock, fcntl.LOCK_EX)

        code, _, err = wipe("--yes", "--uncollected")

    assert code == 3
    assert "pi01: failed: another command works there" in err
    assert split.directory("pi01").exists()


def test_nothing_there_is_nothing_to_ask(split, wipe, tmp_path):
    shutil.rmtree(tmp_path / "boards")

    code, out, _ = wipe()

    assert code == 0
    assert out == "3 machines: 0 runs deleted (0 B), 0 kept, 0 failed\n"
    assert not (tmp_path / "boards").exists()


def run_there(state, living=()):
    return RunThere(name=state, state=state, files=1, bytes=10, newest_s=0, living=living)


STATES = ("collected", "not collected", "running", "left over")


@pytest.mark.parametrize(
    ("with_uncollected", "gone"),
    [(False, {"collected", "left over"}), (True, {"collected", "left over", "not collected"})],
)
def test_order_takes_what_was_collected_and_never_what_runs(with_uncollected, gone):
    findings = Findings(runs=tuple(map(run_there, STATES)))

    order = make_order(findings, is_all=False, with_uncollected=with_uncollected)

    assert {run.state for run in order.runs} == gone
    assert {run.state for run in order.kept} == set(STATES) - gone
    assert not order.is_root
