"""`cosmos collect` of runs that recorded on machines: all there, partly there, cut off, still alive."""

import contextlib
import dataclasses
import json
import sys

import pytest
from harness import full_disk
from harness.split_run import SplitRun, hashes

from cosmos_cli import app
from cosmos_cli.collect import finish, retrieve
from cosmos_cli.collect.finish import collect_run
from cosmos_cli.evidence.run_directory import alone, write_json
from cosmos_cli.evidence.run_documents import Problem
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection

pytestmark = pytest.mark.process


class Network:
    """Which machines answer."""

    def __init__(self):
        self.off = set()
        self.asked = []
        self.pythons = {}

    def connect(self, target, _options):
        self.asked.append(target.name)
        if target.name in self.off:
            raise MachineFailure(FailureKind.UNREACHABLE, "no route to host", "is it switched on?")
        python = self.pythons.get(target.name, target.python)
        return LocalConnection(dataclasses.replace(target, python=python))


@pytest.fixture(autouse=True)
def network(own_places, monkeypatch):
    network = Network()
    monkeypatch.setattr(retrieve, "_connect", network.connect)
    return network


@pytest.fixture
def split(tmp_path):
    """A run that is over: the host here left its result, the records lie on two machines."""
    split = SplitRun(tmp_path)
    split.leave_result()
    return split


def document(split):
    return json.loads(split.run.run_json.read_bytes())


def named(split):
    return {line.split(":")[0] for line in document(split)["data"]["missing"]}


def test_records_of_all_machines_come_and_the_run_is_judged(split, capsys):
    before = {path: digest for name in split.names for path, digest in split.there(name).items()}

    code = app.run(["collect"])

    out, err = capsys.readouterr()
    assert code == 0, err
    assert out == f"PASSED: 11 checks hold | {split.run.path}\n"
    assert "pi01  7 of 7 files" in err
    assert before.items() <= hashes(split.run.path).items()
    files = json.loads(split.run.manifest_json.read_bytes())["files"]
    assert {"machines/pi01/manifest.json", "machines/pi02/health.jsonl"} <= set(files)
    assert split.run.bundle.exists()
    assert f"packed: {split.run.bundle}" in err


def test_machine_with_another_address_by_now_is_asked_where_an_inventory_has_it(
    split, network, monkeypatch, tmp_path, capsys
):
    inventory = tmp_path / "moved.yaml"
    inventory.write_text("all: {hosts: {pi01: {ansible_host: 192.0.2.9}}}\n")
    network.off.add("pi01")

    def listed(target, options):
        moved = options.listed.get(target.name)
        if moved is not None:
            network.off.discard(target.name)
            assert moved.address == "192.0.2.9"
        return network.connect(target, options)

    monkeypatch.setattr(retrieve, "_connect", listed)

    assert app.run(["collect"]) == 5
    assert f"at another address by now? cosmos collect {split.run.path} -i FILE" in (
        capsys.readouterr().err
    )
    assert app.run(["collect", "-i", str(inventory)]) == 0


def test_package_that_was_not_written_is_not_said_to_be_there(split, monkeypatch, capsys):
    monkeypatch.setattr(finish, "pack_run", full_disk.refuse)

    assert app.run(["collect"]) == 5

    err = capsys.readouterr().err
    assert f"{split.run.bundle.name}: not written: No space left on device" in err
    assert "packed:" not in err


def test_second_time_is_the_same_and_asks_nobody(split, network):
    app.run(["collect"])
    first, files, package = document(split), hashes(split.run.path), split.run.bundle.read_bytes()
    network.asked.clear()

    assert app.run(["collect"]) == 0

    assert network.asked == []
    assert document(split) == first
    assert hashes(split.run.path) == files
    assert split.run.bundle.read_bytes() == package


def test_only_one_command_collects_a_run_from_its_first_machine_to_its_package(
    split, network, monkeypatch, capsys
):
    codes = []
    pack = finish.pack_run
    monkeypatch.setattr(
        finish,
        "pack_run",
        lambda *of, **more: (codes.append(app.run(["collect"])), pack(*of, **more)),
    )

    with alone(split.run):
        assert app.run(["collect"]) == 2
    assert "another command is collecting it" in capsys.readouterr().err
    assert network.asked == []

    assert app.run(["collect"]) == 0
    assert codes == [2]


FAILING_CARD = """\
#!{python}
import errno, os, sys

def failing(call, name):
    def act(path, *arguments, **more):
        if os.fspath(path).endswith(name):
            raise OSError(errno.EBADMSG, "Bad message", path)
        return call(path, *arguments, **more)
    return act

os.scandir = failing(os.scandir, {name!r})
os.lstat = failing(os.lstat, {name!r})
code = sys.argv[sys.argv.index("-c") + 1]
del sys.argv[1:sys.argv.index(code) + 1]
sys.argv[0] = "-c"
exec(compile(code, "boot", "exec"))
"""
"""A Python on a machine whose card does not give what a path of this ending holds."""


@pytest.fixture
def notes(split):
    """Leave a folder of the agent's own on pi02."""
    own = split.directory("pi02") / "agents/agent-02/own"
    own.mkdir()
    (own / "notes.csv").write_text("1,2\n")


@pytest.fixture
def let_card_fail(split, tmp_path, network):
    """Return a function that lets pi02's card give nothing that lies at paths of an ending."""

    def act(ending):
        python = tmp_path / "python"
        python.write_text(FAILING_CARD.format(python=sys.executable, name=ending))
        python.chmod(0o755)
        network.pythons["pi02"] = str(python)

    return act


@pytest.mark.usefixtures("notes")
@pytest.mark.parametrize(
    ("ending", "told"),
    [
        ("agents/agent-02/own", "agents/agent-02/own/: cannot be read there: Bad message"),
        ("agent-02/own/notes.csv", "agents/agent-02/own/notes.csv: cannot be read there: Bad"),
        ("/RUN", "./: cannot be read there: Bad message"),
    ],
    ids=["folder", "file", "all"],
)
def test_what_a_failing_card_does_not_give_is_data_that_are_missing_and_all_else_comes(
    split, let_card_fail, capsys, ending, told
):
    ending = ending.replace("RUN", split.directory("pi02").name)
    let_card_fail(ending)
    before = split.there("pi02")

    code = app.run(["collect"])

    assert code == 5, capsys.readouterr().err
    assert document(split)["exit_code"] == 5
    assert document(split)["verdict"].startswith("DATA INCOMPLETE: ")
    assert told in " ".join(document(split)["data"]["missing"])
    lost = {path for path in before if ending in f"{split.directory('pi02')}/{path}"}
    came = {path for path in before if path not in lost}
    assert came <= hashes(split.run.path).keys()
    assert split.there("pi02") == before
    assert not split.directory("pi01").exists()


def test_machine_that_is_gone_is_named_and_collected_later(split, network, capsys):
    network.off.add("pi02")

    code = app.run(["collect"])

    err = capsys.readouterr().err
    assert code == 5
    assert named(split) == {"pi02", "agent-02"}
    assert "pi02  failed: no route to host; is it switched on?" in err
    assert "warning: agent-02: not retrieved from pi02: no records" in err
    assert document(split)["exit_code"] == 3
    assert document(split)["verdict"].startswith("MACHINES FAILED: pi02: no route to host")
    assert split.run.bundle.exists()

    network.off.clear()

    assert app.run(["collect"]) == 0
    assert document(split)["exit_code"] == 0
    assert document(split)["problems"] == []
    assert document(split)["data"] == {"complete": True, "missing": []}


def test_machine_whose_other_files_did_not_come_is_named_although_its_streams_are_here(
    split, capsys
):
    (split.directory("pi02") / "run.json").write_text("{}")

    assert app.run(["collect"]) == 5

    assert named(split) == {"pi02"}
    line = document(split)["data"]["missing"][0]
    assert line.endswith("not all of its records are here")
    assert "run.json: this name is the operator's" in line


def test_run_that_still_lives_on_a_machine_is_refused_and_nothing_is_touched(split, capsys):
    before = hashes(split.run.path)
    with split.living("pi02", "agent", "agent-02") as pid:
        code = app.run(["collect"])

        err = capsys.readouterr().err
        assert code == 2
        assert (
            f"{split.run.name} is still running on pi02: agent agent-02 (pid {pid}); wait for"
            in err
        )
        assert hashes(split.run.path) == before
        assert split.there("pi01")

    assert app.run(["collect"]) == 0


def test_a_refusal_leaves_no_helper_behind(split, capsys, monkeypatch):
    opened = []
    open_stream = LocalConnection.open
    monkeypatch.setattr(
        LocalConnection,
        "open",
        lambda self, command: opened.append(open_stream(self, command)) or opened[-1],
    )
    with split.living("pi02", "agent", "agent-02"):
        assert app.run(["collect"]) == 2

    assert "is still running on pi02" in capsys.readouterr().err
    assert len(opened) == 2
    assert None not in [stream._process.returncode for stream in opened]


def test_run_that_lives_in_many_processes_is_refused_in_one_short_line(split, capsys):
    with contextlib.ExitStack() as living:
        for number in range(3):
            living.enter_context(split.living("pi01", "agent", f"agent-{number}"))
            living.enter_context(split.living("pi02", "agent", f"agent-{number}"))
        code = app.run(["collect"])

    [line] = [line for line in capsys.readouterr().err.splitlines() if "still running" in line]
    assert code == 2
    assert " on pi01, pi02: 6 processes, such as " in line
    assert line.count("(pid ") == 3
    assert line.endswith(f"end it with: cosmos down {split.run.name}")


def test_machines_are_left_alone_when_asked_to(split, network, capsys):
    code = app.run(["collect", "--no-retrieve"])

    assert code == 5
    assert network.asked == []
    assert named(split) == {"pi01", "pi02", "agent-01", "agent-02"}
    assert "as --no-retrieve says" in capsys.readouterr().err
    assert app.run(["collect"]) == 0


def test_run_that_a_power_failure_cut_off_is_packaged_with_every_cut_counted(split, capsys):
    split.run.left_result_json.unlink()
    cut = split.directory("pi01") / "agents/agent-01/ticks.jsonl"
    split.made.cut(cut, cut.stat().st_size // 2)
    lost = split.directory("pi02") / "agents/agent-02/clock.jsonl"
    split.made.cut(lost, 0)
    whole_lines = cut.read_bytes().count(b"\n") - 1

    code = app.run(["collect"])

    assert code == 5
    lines = {line.split(":")[0]: line for line in document(split)["data"]["missing"]}
    assert set(lines) == {"host", "agent-01", "agent-02"}
    assert f"ticks cut after {whole_lines} records" in lines["agent-01"]
    assert "clock empty file: nothing reached the disk" in lines["agent-02"]
    files = json.loads(split.run.manifest_json.read_bytes())["files"]
    entry = files["agents/agent-01/ticks.jsonl"]
    assert (entry["records"], entry["truncated"]) == (whole_lines, True)
    assert not split.directory("pi01").exists()
    assert split.run.bundle.exists()
    assert "agent-01: ticks cut" in capsys.readouterr().err
    assert app.run(["collect"]) == 5


def test_host_on_a_machine_brings_its_result(split, tmp_path):
    plan = json.loads(split.run.plan_json.read_bytes())
    machine = plan["machines"]["pi02"]
    plan["host"] = {"name": "pi02", "target": machine["target"], "directory": machine["directory"]}
    split.run.plan_json.write_text(json.dumps(plan))
    (split.run.path / "host").rename(split.directory("pi02") / "host")

    assert app.run(["collect"]) == 0

    assert split.run.left_result_json.exists()


def test_result_that_did_not_come_from_the_hosts_machine_is_explained(split, network):
    plan = json.loads(split.run.plan_json.read_bytes())
    plan["host"] = {"name": "pi02", "target": plan["machines"]["pi02"]["target"]}
    split.run.plan_json.write_text(json.dumps(plan))
    (split.run.path / "host").rename(split.directory("pi02") / "host")
    network.off.add("pi02")

    assert app.run(["collect"]) == 5

    lines = document(split)["data"]["missing"]
    assert lines[0].startswith("host: not retrieved from pi02: no result")


@pytest.mark.parametrize(
    ("machine", "blame"),
    [("pi02", "machine pi02 is lost: no sign of life"), ("pi01", "it ended without a result")],
)
def test_host_that_went_with_its_machine_is_not_said_to_have_been_killed(split, machine, blame):
    plan = json.loads(split.run.plan_json.read_bytes())
    plan["host"] = {"name": "pi02", "target": plan["machines"]["pi02"]["target"]}
    split.run.plan_json.write_text(json.dumps(plan))
    split.run.left_result_json.unlink()
    problem = Problem(machine=machine, text=f"machine {machine} is lost: no sign of life")

    summary = collect_run(split.run, problems=(problem,))

    assert summary.verdict.text.startswith(f"FAILED: host: {blame}")
    assert summary.exit_code == (3 if machine == "pi02" else 1)


def test_file_that_is_damaged_here_after_it_came_is_named_every_time(split):
    split.retrieve()
    path = split.run.path / "agents/agent-01/ticks.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"\n[1,", b"\n[7,", 1))

    for _ in range(2):
        assert app.run(["collect"]) == 5
        assert document(split)["data"]["missing"] == [
            "agents/agent-01/ticks.jsonl: changed since the run was collected"
        ]
    path.write_bytes(whole)
    assert app.run(["collect"]) == 0


def test_file_that_went_on_growing_on_the_machine_is_no_damage(split, network):
    path = split.directory("pi01") / "agents/agent-01/log.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    held = split.directory("pi01") / "run.json"  # keeps the directory from being released
    held.touch()
    assert app.run(["collect"]) == 5
    path.write_bytes(whole)
    held.unlink()

    assert app.run(["collect"]) == 0, document(split)["data"]["missing"]


def test_streams_in_folders_of_a_plug_ins_own_are_not_taken_for_missing(split):
    own = split.directory("pi01") / "agents/agent-01/own"
    own.mkdir()
    (own / "series.jsonl").write_text('{"a": 1}\n')

    assert app.run(["collect"]) == 0
    assert app.run(["collect"]) == 0

    (split.run.path / "agents/agent-01/own/series.jsonl").unlink()
    assert app.run(["collect"]) == 5


def test_problem_of_the_run_outranks_data_that_are_missing(split):
    """3 before 5: what is missing is the consequence, the machine is what has to be looked after."""
    split.retrieve()
    (split.run.path / "agents/agent-01/clock.jsonl").unlink()
    lost = Problem(machine="pi01", text="machine pi01 is lost")

    summary = collect_run(split.run, problems=[lost], processes=lambda: [])

    assert summary.exit_code == 3
    assert summary.missing


@pytest.mark.parametrize(
    ("who", "lost", "machine", "code"),
    [
        ("agent-01", ["agent-01"], "pi01", 3),
        ("agent-02, agent-01", ["agent-01", "agent-02"], "pi01", 3),
        ("agent-02", ["agent-01", "agent-02"], "pi01", 1),  # its own machine is well
        ("agent-01", [], "pi01", 1),  # its plug-in raised; the machine was lost later
        ("host", ["agent-01"], "pi01", 1),
    ],
)
def test_run_that_a_lost_machine_ended_ends_with_3(split, who, lost, machine, code):
    split.retrieve()
    ended = {"status": "failed", "who": who, "reason": "silent for 2.5 s", "lost": lost}
    write_json(split.run.left_result_json, split.made.result(**ended))
    problem = Problem(machine=machine, text=f"machine {machine} is lost: no sign of life")

    summary = collect_run(split.run, problems=[problem], processes=lambda: [])

    assert summary.exit_code == code
    assert summary.document["status"] == "failed"
