"""Trees: what belongs to one, and that a machine has all of it or nothing, whatever is cut."""

import dataclasses
import errno
import hashlib
import os
import shutil
import subprocess
import sys
import threading
import zlib
from pathlib import Path

import pytest
from onboard_machine import OwnMachine, snapshot

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.launch import flown_copy
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.onboard import installed
from cosmos_cli.onboard import trees as onboard_trees
from cosmos_cli.onboard.request_loop import VERBS, VerbRequest
from cosmos_cli.provision import tree_rules, trees
from cosmos_cli.provision.environment import ask_installed, installed_request
from cosmos_cli.provision.tree_rules import is_folder_of_tree
from cosmos_cli.provision.trees import (
    TreeFile,
    runtime_tree,
    scenario_tree,
    send_tree,
    tree_of,
)
from madns_runtime import __version__

pytestmark = pytest.mark.process

SCENARIO = """
name: small
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {mode: realtime, duration_s: 1}
"""


@pytest.fixture
def machine(tmp_path):
    return OwnMachine(tmp_path / "root")


@pytest.fixture
def folder(tmp_path):
    """A scenario's folder with a plug-in beside it."""
    folder = tmp_path / "scenario"
    (folder / "data").mkdir(parents=True)
    (folder / "small.yaml").write_text(SCENARIO)
    (folder / "flight.py").write_text("gain = 1\n")
    (folder / "data/orbits.csv").write_text("1,2\n")
    return folder


def the_tree(folder):
    return scenario_tree(load_scenario(folder / "small.yaml"))


def paths(tree):
    return [file.path for file in tree.files]


def made_tree(**contents):
    return tree_of(
        "made",
        [
            TreeFile(
                path=path,
                sha256=hashlib.sha256(content).hexdigest(),
                mode=0o444,
                size_bytes=len(content),
                source=content,
            )
            for path, content in contents.items()
        ],
    )


def on_machine(machine, tree):
    """Return the files of a tree as they are there."""
    top = Path(machine.layout.tree(tree.hash))
    return {
        path.relative_to(top).as_posix(): path.read_bytes()
        for path in top.rglob("*")
        if path.is_file() and path.name != ".complete"
    }


def is_whole(machine, tree):
    with machine.board() as board:
        request = installed_request(machine.layout, trees=[tree.hash], environments=[])
        return ask_installed(board, request).trees[tree.hash]


def sent_blobs(machine):
    return [blob for verb, given, _ in machine.calls if verb == "blobs" for blob in given["blobs"]]


def test_tree_holds_the_scenarios_files_and_no_more(folder):
    for path in (
        ".git/config",
        "__pycache__/flight.cpython-311.pyc",
        "venv/pyvenv.cfg",
        "venv/bin/python",
        "0007-small/plan.json",
        "0007-small/run.json",
        "0007-small.tar.zst",
        "flight.egg-info/PKG-INFO",
    ):
        (folder / path).parent.mkdir(exist_ok=True, parents=True)
        (folder / path).write_text("x")
    (folder / "empty").mkdir()

    assert paths(the_tree(folder)) == ["data/orbits.csv", "flight.py", "small.yaml"]


def test_what_this_computer_keeps_of_its_own_belongs_to_no_tree(folder, monkeypatch):
    before = the_tree(folder)
    monkeypatch.setenv("COSMOS_STATE_DIR", str(folder / "state"))
    monkeypatch.setenv("COSMOS_CACHE", str(folder / "data/cache"))
    for path in ("state/processes/1-2-3.json", "state/runs/a.json", "data/cache/wheels/a.whl"):
        (folder / path).parent.mkdir(parents=True)
        (folder / path).write_text("x")

    assert the_tree(folder).hash == before.hash
    monkeypatch.setenv("COSMOS_STATE_DIR", str(folder))  # no folder of its own: the register alone
    (folder / "processes").mkdir()
    (folder / "processes/1-2-3.json").write_text("x")
    assert "processes/1-2-3.json" not in paths(the_tree(folder))
    assert "state/runs/a.json" in paths(the_tree(folder))


@pytest.mark.parametrize(
    ("name", "lacks", "belongs"),
    [
        ("copy of a run", (), False),
        ("copy of a run", ("plan.json",), True),  # whatever it is
        ("0007-small", ("plan.json",), False),
        ("0007-small", ("host", "agents"), False),
        ("0007-small", ("plan.json", "host"), True),
        ("flight", ("host", "agents"), True),
    ],
)
def test_runs_belong_to_no_tree_whatever_they_are_called_and_lack(tmp_path, name, lacks, belongs):
    for part in {"plan.json", "host", "agents"}.difference(lacks):
        (tmp_path / name / part).mkdir(parents=True)

    assert is_folder_of_tree(tmp_path / name) == belongs


def test_hash_is_of_names_contents_and_execute_bits_alone(folder, tmp_path):
    first = the_tree(folder)
    copy = tmp_path / "elsewhere"
    subprocess.run(["cp", "-r", folder, copy], check=True)
    os.utime(copy / "flight.py", (1, 1))
    (copy / "flight.py").chmod(0o600)

    assert first.hash == the_tree(copy).hash
    (copy / "flight.py").chmod(0o700)
    executable = the_tree(copy).hash
    (copy / "flight.py").write_text("gain = 2\n")
    assert len({first.hash, executable, the_tree(copy).hash}) == 3


def test_links_within_are_sent_as_what_they_lead_to(folder, machine):
    (folder / "alias.csv").symlink_to("data/orbits.csv")
    (folder / "more").symlink_to("data")
    (folder / "data/loop").symlink_to("..")

    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)

    assert "alias.csv" in paths(tree) and "more/orbits.csv" in paths(tree)
    assert on_machine(machine, tree)["alias.csv"] == b"1,2\n"


@pytest.mark.parametrize(
    ("name", "target", "files"),
    [
        ("runs", "runs", ()),
        ("results", "big", ("0007-small/plan.json", "0008-small.tar.zst", ".index")),
        ("0007-small", "moved", ("host/x", "agents/x")),
        ("last", "0007-small", ("plan.json",)),
        ("env", "env", ("pyvenv.cfg", "bin/python")),
        ("node_modules", "modules", ("x.js",)),
    ],
)
def test_links_to_what_is_left_out_are_left_out_wherever_it_lies(folder, name, target, files):
    before = the_tree(folder)
    for path in (folder.parent / "disk" / target / file for file in files):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    (folder.parent / "disk" / target).mkdir(parents=True, exist_ok=True)
    (folder / name).symlink_to(folder.parent / "disk" / target)

    assert the_tree(folder).hash == before.hash
    assert set(flown_copy.names_in(folder)) == set(paths(before))
    assert flown_copy._found(folder, left_out := []) and not left_out


def test_link_to_the_folder_of_all_runs_is_left_out_whatever_else_is_there(folder, monkeypatch):
    before = the_tree(folder)
    disk = folder.parent / "disk"
    disk.mkdir()
    (disk / "notes.txt").write_text("x")
    (folder / "results").symlink_to(disk)
    with pytest.raises(InputError, match=r"results: a link that leads out"):
        the_tree(folder)

    monkeypatch.setenv("COSMOS_RUNS", str(disk))

    assert the_tree(folder).hash == before.hash


def test_links_to_folders_with_links_end_with_a_word(folder, monkeypatch):
    """Each level doubles the ways to the last one."""
    monkeypatch.setattr(tree_rules, "FOLDERS_MAX", 100)
    for level in range(30):
        inner = folder / f"level{level}"
        inner.mkdir()
        for name in ("a", "b"):
            (inner / name).symlink_to(f"../level{level + 1}")
    (folder / "level30").mkdir()

    with pytest.raises(InputError, match=r"at most 100 folders, found more; do links lead"):
        the_tree(folder)


@pytest.mark.parametrize("target", ["/etc/hostname", "../outside.txt", "gone.txt"])
def test_links_that_lead_outside_or_nowhere_are_refused_by_name(folder, target):
    (folder.parent / "outside.txt").write_text("x")
    (folder / "link").symlink_to(target)

    with pytest.raises(InputError, match=r"link: a link that leads"):
        the_tree(folder)


def test_link_to_itself_is_refused_by_name(folder):
    (folder / "link").symlink_to("link")

    with pytest.raises(InputError, match=r"link: cannot be read: Too many levels"):
        the_tree(folder)


def test_too_large_a_folder_is_refused_with_what_makes_it_large(folder, monkeypatch):
    monkeypatch.setattr(trees, "TREE_BYTES_MAX", 1000)
    (folder / "huge.bin").write_bytes(bytes(1001))

    with pytest.raises(InputError, match=r"huge.bin \(0.0 MB\)"):
        the_tree(folder)


def test_too_many_files_are_refused(folder, monkeypatch):
    monkeypatch.setattr(trees, "FILES_MAX", 2)

    with pytest.raises(InputError, match="at most 2 files"):
        the_tree(folder)


def test_runtime_alone_finds_its_simulations_by_name(machine):
    tree = runtime_tree()
    with machine.board() as board:
        assert send_tree(board, machine.layout, tree)
    program = (
        "import importlib.metadata as m, madns_runtime\n"
        "print(m.version('cosmos-madns'), madns_runtime.__file__)\n"
        "print(sorted(e.value for e in m.entry_points(group='madns.simulations')))\n"
    )
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"import sys\nsys.path[:0] = sys.argv[1:]\n{program}"]
        + [machine.layout.tree(tree.hash)],
        capture_output=True,
        text=True,
        check=True,
    )

    version, entries = done.stdout.splitlines()
    assert f"{__version__} {machine.layout.tree(tree.hash)}/madns_runtime/__init__.py" == version
    assert "madns_runtime.simulations.counter:simulation" in entries
    assert not any("cosmos_cli" in path or "__pycache__" in path for path in paths(tree))


def test_tree_arrives_as_it_is_and_read_only(folder, machine):
    (folder / "tool.sh").write_text("#!/bin/sh\n")
    (folder / "tool.sh").chmod(0o755)
    (folder / "empty.txt").touch()
    tree = the_tree(folder)

    with machine.board() as board:
        assert send_tree(board, machine.layout, tree)

    assert on_machine(machine, tree) == {
        file.path: (folder / file.path).read_bytes() for file in tree.files
    }
    top = Path(machine.layout.tree(tree.hash))
    assert (top / "tool.sh").stat().st_mode & 0o777 == 0o555
    assert (top / "flight.py").stat().st_mode & 0o777 == 0o444


def test_second_time_nothing_is_sent_and_nothing_touched(folder, machine):
    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
        before = snapshot(machine.root)
        machine.calls.clear()

        assert not send_tree(board, machine.layout, tree)

    assert [verb for verb, _, _ in machine.calls] == ["tree"]
    assert before == snapshot(machine.root)


def test_one_edited_file_is_one_file_sent(folder, machine):
    with machine.board() as board:
        send_tree(board, machine.layout, the_tree(folder))
        (folder / "flight.py").write_text("gain = 2\n")
        machine.calls.clear()
        edited = the_tree(folder)
        assert send_tree(board, machine.layout, edited)

    assert [[hashlib.sha256(b"gain = 2\n").hexdigest(), 9]] == sent_blobs(machine)
    assert on_machine(machine, edited)["flight.py"] == b"gain = 2\n"


def test_what_is_there_twice_is_sent_once(machine):
    tree = made_tree(a=b"same", b=b"same", c=b"")
    with machine.board() as board:
        send_tree(board, machine.layout, tree)

    assert len(sent_blobs(machine)) == 2
    assert on_machine(machine, tree) == {"a": b"same", "b": b"same", "c": b""}


def test_large_trees_come_in_batches(machine, monkeypatch):
    monkeypatch.setattr(trees, "BATCH_BYTES", 1000)
    tree = made_tree(**{f"f{index}": os.urandom(400) for index in range(7)})
    told = []
    with machine.board() as board:
        send_tree(board, machine.layout, tree, lambda what, share: told.append(share))

    assert [len(g["blobs"]) for verb, g, _ in machine.calls if verb == "blobs"] == [2, 2, 2, 1]
    assert told == sorted(told) and told[-1] == 1.0
    assert is_whole(machine, tree)


def test_large_file_comes_in_pieces(machine, monkeypatch):
    monkeypatch.setattr(trees, "BATCH_BYTES", 1000)
    tree = made_tree(exact=os.urandom(1000), large=os.urandom(2500), other=os.urandom(1001))
    told = []
    with machine.board() as board:
        send_tree(board, machine.layout, tree, lambda what, share: told.append(share))

    pieces = [g for verb, g, _ in machine.calls if verb == "blob"]
    assert [(g["offset"], g["length"]) for g in pieces] == [
        (0, 1000),
        (1000, 1000),
        (2000, 500),
        (0, 1000),
        (1000, 1),
    ]
    assert told == sorted(told) and told[-1] == 1.0
    assert on_machine(machine, tree) == tree_files(tree)


def test_piece_that_does_not_follow_is_refused(machine):
    how = {"folder": machine.layout.trees, "sha256": "0" * 64, "size": 9, "length": 4}
    with machine.board() as board:
        board.call("blob", {**how, "offset": 0}, body=zlib.compress(b"text"))
        with pytest.raises(MachineFailure, match="expected 5 B, has 4 B"):
            board.call("blob", {**how, "offset": 5}, body=zlib.compress(b"text"))
        board.call("blob", {**how, "offset": 0}, body=zlib.compress(b"text"))  # begun anew
        with pytest.raises(MachineFailure, match="not what was announced"):
            board.call("blob", {**how, "offset": 4, "length": 5}, body=zlib.compress(b"wrong"))

    assert [p for p in Path(machine.layout.trees).rglob("*") if p.is_file()] == []


def test_piece_keeps_what_was_sent_young(tmp_path):
    """A large file over a slow link takes longer than what nobody has touched is kept."""
    how = {"folder": str(tmp_path), "sha256": "0" * 64, "size": 9, "length": 4}
    for offset in (0, 4):
        given = VerbRequest(arguments={**how, "offset": offset}, body=zlib.compress(b"text"))
        onboard_trees.blob(given)
        assert (tmp_path / ".blobs").stat().st_mtime > 1
        os.utime(tmp_path / ".blobs", (1, 1))


def test_large_file_that_changes_while_it_is_sent_is_told(folder, machine, monkeypatch):
    monkeypatch.setattr(trees, "BATCH_BYTES", 1000)
    (folder / "data.bin").write_bytes(os.urandom(2500))
    tree = the_tree(folder)
    with machine.board() as board, pytest.raises(MachineFailure, match=r"data.bin was changed"):
        send_tree(
            board,
            machine.layout,
            tree,
            lambda *_: (folder / "data.bin").write_bytes(os.urandom(2500)),
        )


def test_what_does_not_get_smaller_is_not_compressed():
    dense, text = os.urandom(200_000), b"gain = 1\n" * 20_000

    assert len(dense) < len(trees._packed(dense)) < len(dense) + 100
    assert len(trees._packed(text)) < len(text) / 10
    assert [zlib.decompress(trees._packed(each)) for each in (dense, text, b"")] == [
        dense,
        text,
        b"",
    ]


def test_tree_takes_the_room_of_its_files_once(machine):
    """What was sent is moved into the tree, so that a disk needs not hold both."""
    contents = {f"f{index}": os.urandom(3000) for index in range(5)}
    tree = made_tree(**contents, again=contents["f0"])
    files = [[file.path, file.sha256, file.mode] for file in tree.files]
    asked = {"folder": machine.layout.trees, "hash": tree.hash, "label": "made", "files": files}
    sent = Path(machine.layout.trees, ".blobs")
    with machine.board() as board:
        board.call("tree", asked)
        board.call(
            "blobs",
            {
                "folder": machine.layout.trees,
                "blobs": [[hashlib.sha256(c).hexdigest(), len(c)] for c in contents.values()],
            },
            body=zlib.compress(b"".join(contents.values())),
        )
        inodes = {path.stat().st_ino for path in sent.iterdir()}
        assert board.call("tree", asked).value == {"changed": True, "missing": []}

    assert on_machine(machine, tree) == tree_files(tree)
    assert list(sent.iterdir()) == []
    there = {path.stat().st_ino for path in Path(machine.layout.tree(tree.hash)).glob("[fa]*")}
    assert inodes < there and len(there) == len(inodes) + 1


def test_one_content_with_two_modes_keeps_both(machine):
    tree = made_tree(a=b"same", b=b"same")
    program = dataclasses.replace(tree.files[0], mode=0o555)
    tree = tree_of("made", [program, tree.files[1]])
    with machine.board() as board:
        send_tree(board, machine.layout, tree)

    top = Path(machine.layout.tree(tree.hash))
    assert [(top / name).stat().st_mode & 0o777 for name in "ab"] == [0o555, 0o444]
    assert is_whole(machine, tree)


@pytest.mark.parametrize("verb", ["blobs", "blob", "tree"])
def test_full_disk_keeps_nothing_of_what_was_sent(tmp_path, monkeypatch, verb):
    """Else what came before takes the room of every later try."""
    sent = tmp_path / ".blobs"
    sent.mkdir()
    (sent / hashlib.sha256(b"same").hexdigest()).write_bytes(b"same")
    (sent / ("0" * 64)).write_bytes(bytes(1000))

    def refuse(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    tree = made_tree(a=b"same", b=b"same")
    monkeypatch.setattr(onboard_trees.content_changes, "write_whole", refuse)
    monkeypatch.setattr(onboard_trees.shutil, "copyfile", refuse)
    monkeypatch.setattr(onboard_trees.os, "replace", refuse)
    files = [[file.path, file.sha256, file.mode] for file in tree.files]
    asked = {
        "blobs": {"blobs": [[tree.files[0].sha256, 4]]},
        "blob": {"sha256": tree.files[0].sha256, "size": 4, "offset": 0, "length": 4},
        "tree": {"hash": tree.hash, "label": "made", "files": files},
    }[verb]
    request = VerbRequest(arguments={"folder": str(tmp_path), **asked}, body=zlib.compress(b"same"))

    with pytest.raises(OSError, match="No space left"):
        VERBS[verb](request)

    assert os.listdir(tmp_path) == []


def test_connection_cut_at_every_frame_is_repaired_by_the_next_call(machine, monkeypatch):
    monkeypatch.setattr(trees, "BATCH_BYTES", 1000)
    cuts = 0
    for steps in range(100):
        tree = made_tree(**{f"d/f{index}": os.urandom(400) for index in range(5)})
        try:
            with machine.board(cut_after=steps) as board:
                send_tree(board, machine.layout, tree)
            break
        except MachineFailure as failure:
            assert FailureKind.LOST is failure.kind
        cuts += 1
        if Path(machine.layout.tree(tree.hash)).exists():
            assert is_whole(machine, tree)
        with machine.board() as board:
            send_tree(board, machine.layout, tree)
        assert tree_files(tree) == on_machine(machine, tree)

    assert cuts >= 10  # two questions and three batches, and the answer to each


def tree_files(tree):
    return {file.path: file.source for file in tree.files}


def test_resumed_transfer_sends_only_what_had_not_come(machine, monkeypatch):
    monkeypatch.setattr(trees, "BATCH_BYTES", 1000)
    tree = made_tree(**{f"f{index}": os.urandom(600) for index in range(6)})
    with pytest.raises(MachineFailure), machine.board(cut_after=7) as board:
        send_tree(board, machine.layout, tree)
    machine.calls.clear()

    with machine.board() as board:
        send_tree(board, machine.layout, tree)

    assert 0 < len(sent_blobs(machine)) < 6
    assert is_whole(machine, tree)


@pytest.mark.parametrize("harm", ["byte", "gone", "added", "mode", "mark"])
def test_any_change_on_the_machine_is_noticed_and_repaired(folder, machine, harm):
    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    assert is_whole(machine, tree)
    file = Path(machine.layout.tree(tree.hash)) / "flight.py"
    times = file.stat()
    file.chmod(0o644)
    match harm:
        case "byte":
            file.write_text("gain = 9\n")
            os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))
        case "gone":
            file.unlink()
        case "added":
            (file.parent / "random.py").write_text("")
        case "mode":
            file.chmod(0o755)
        case "mark":
            (file.parent / ".complete").unlink()

    assert not is_whole(machine, tree)
    with machine.board() as board:
        assert send_tree(board, machine.layout, tree)
    assert is_whole(machine, tree)
    assert {file.path for file in tree.files} == set(on_machine(machine, tree))


def test_tree_that_shows_no_trace_of_a_change_is_not_read_again(folder, machine, monkeypatch):
    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    path = machine.layout.tree(tree.hash)
    read = []
    monkeypatch.setattr(installed, "hash_of_tree", lambda *_: read.append(1) or tree.hash)

    assert installed.is_tree_whole(path)
    assert not read
    (Path(path) / "flight.py").touch()  # the same content, but somebody was there
    assert installed.is_tree_whole(path)
    assert read


def test_caches_of_imported_modules_are_no_change(folder, machine):
    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    top = machine.layout.tree(tree.hash)
    subprocess.run([sys.executable, "-c", "import flight"], env={"PYTHONPATH": top}, check=True)

    assert (Path(top) / "__pycache__").is_dir()
    assert is_whole(machine, tree)


def test_files_that_a_living_run_adds_do_not_break_its_tree(folder, machine):
    tree = the_tree(folder)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    top = machine.layout.tree(tree.hash)
    with subprocess.Popen(
        [sys.executable, "-c", "input('begun')"],
        env={"COSMOS_BASE_DIRECTORY": top},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        # From now on the kernel tells what it runs.
        assert process.stdout.read(len("begun")) == b"begun"
        (Path(top) / "notes.txt").write_text("x")
        assert is_whole(machine, tree)
        (Path(top) / "flight.py").unlink()
        assert not is_whole(machine, tree)
        process.communicate(b"\n", timeout=120)


def test_many_operators_at_once_end_with_one_whole_tree(machine):
    tree = made_tree(**{f"f{index}": os.urandom(2000) for index in range(30)})
    failures = []

    def send():
        try:
            with OwnMachine(machine.root).board() as board:
                send_tree(board, machine.layout, tree)
        except MachineFailure as failure:
            failures.append(failure)

    threads = [threading.Thread(target=send) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)

    kinds = {failure.kind: str(failure) for failure in failures}
    assert kinds.keys() <= {FailureKind.DATA, FailureKind.BUSY}, kinds
    assert len(failures) < 6
    assert is_whole(machine, tree)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    assert tree_files(tree) == on_machine(machine, tree)


def test_tree_that_another_operator_brought_first_stays_where_it_is(machine):
    tree = made_tree(**{"flight.py": b"gain = 1\n"})
    top = Path(machine.layout.tree(tree.hash))
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    first = top.stat().st_ino
    half_made = top.parent / ".second"
    shutil.copytree(top, half_made)

    onboard_trees._take_place(str(half_made), str(top), "flight")

    assert top.stat().st_ino == first


def test_tree_that_is_removed_while_it_is_read_is_not_whole(machine, monkeypatch):
    tree = made_tree(**{"flight.py": b"gain = 1\n"})
    top = machine.layout.tree(tree.hash)
    with machine.board() as board:
        send_tree(board, machine.layout, tree)
    scandir = os.scandir

    def list_and_remove(path):
        monkeypatch.undo()  # removing lists, too
        entries = list(scandir(path))
        shutil.rmtree(path)
        return entries

    monkeypatch.setattr(installed.os, "scandir", list_and_remove)

    assert installed.is_tree_whole(top) is False
    assert not os.path.exists(top)


@pytest.mark.parametrize(
    "harm",
    [
        lambda file: file.write_text("gain = 3\n"),
        lambda file: file.write_text("longer " * 1000),
        lambda file: file.unlink(),
    ],
    ids=["changed", "grown", "gone"],
)
def test_file_that_changes_while_it_is_sent_is_told(folder, machine, harm):
    tree = the_tree(folder)
    harm(folder / "flight.py")

    with machine.board() as board, pytest.raises(MachineFailure, match="flight.py was changed"):
        send_tree(board, machine.layout, tree)
    assert not Path(machine.layout.tree(tree.hash)).exists()


@pytest.mark.parametrize("path", ["../evil", "/evil", "a/../../evil", "", "a//b", "."])
def test_no_path_leads_out_of_a_tree(machine, path):
    with machine.board() as board, pytest.raises(MachineFailure, match="path within the tree"):
        send_tree(board, machine.layout, made_tree(**{path: b"x"}))


@pytest.mark.parametrize(
    ("sizes", "body"),
    [
        ([["0" * 64, 4]], zlib.compress(b"text")),
        ([[hashlib.sha256(b"text").hexdigest(), 3]], zlib.compress(b"text")),
        ([[hashlib.sha256(b"text").hexdigest(), 4]], b"no zlib"),
        ([[hashlib.sha256(b"text").hexdigest(), 4]], zlib.compress(b"text")[:-6]),
    ],
)
def test_blobs_that_are_not_what_they_claim_are_refused(machine, sizes, body):
    with machine.board() as board, pytest.raises(MachineFailure) as caught:
        board.call("blobs", {"folder": machine.layout.trees, "blobs": sizes}, body=body)

    assert FailureKind.DATA is caught.value.kind
    assert [p for p in Path(machine.layout.trees).rglob("*") if p.is_file()] == []


def test_leftovers_of_makers_that_are_gone_are_removed(machine):
    half_made = Path(machine.layout.trees, ".abc.1-2")
    half_made.mkdir(parents=True)
    (half_made / "file").write_text("x")
    os.utime(half_made, (1, 1))
    fresh = Path(machine.layout.trees, ".def.1-2")
    fresh.mkdir()

    with machine.board() as board:
        send_tree(board, machine.layout, made_tree(a=b"x"))

    assert not half_made.exists()
    assert fresh.exists()


def test_of_a_scenario_with_a_root_above_it_all_of_the_root_is_sent(folder):
    (folder / "base.yaml").write_text(SCENARIO)
    (folder / "few").mkdir()
    (folder / "few/few.yaml").write_text("extends: ../base.yaml\nroot: ..\nname: few\n")

    tree = scenario_tree(load_scenario(folder / "few/few.yaml"))

    assert {"base.yaml", "few/few.yaml"} <= set(paths(tree))
    assert tree.hash == scenario_tree(load_scenario(folder / "base.yaml")).hash
