"""What is installed is told without a lock: another command may remove it at any moment."""

import os
import shutil

import pytest

from cosmos_cli.onboard import content_changes, content_store, environment
from cosmos_cli.onboard import installed as module
from cosmos_cli.onboard.installed import installed
from cosmos_cli.onboard.request_loop import VerbRequest

KINDS = ("trees", "environments", "wheels")


@pytest.fixture
def folders(tmp_path):
    """Everything that is there is called `one`, and is whole."""
    for kind in KINDS:
        program = tmp_path / kind / "one" / "bin" / "python"
        program.parent.mkdir(parents=True)
        program.write_text("")
        program.chmod(0o755)
        top = str(tmp_path / kind / "one")
        traces = content_store.trace(top, ["bin/python"])
        content_changes.mark_complete(top, {"files": traces, "label": "one", "wheels": []})
    return {kind: str(tmp_path / kind) for kind in KINDS}


def ask(folders, *environments):
    asked = {"folders": folders, "trees": [], "environments": environments}
    return installed(VerbRequest(arguments={**asked, "touch": True, "is_strict": True}))


def removing(monkeypatch, module, name, kind, folders):
    """Let another command remove what is there of a kind as soon as a function has answered about it."""
    function = getattr(module, name)

    def answer(*arguments, **named):
        answered = function(*arguments, **named)
        if arguments[0].startswith(folders[kind]):
            shutil.rmtree(os.path.join(folders[kind], "one"), ignore_errors=True)
        return answered

    monkeypatch.setattr(module, name, answer)


def test_environment_that_is_there_is_told(folders):
    assert ask(folders, "one")["environments"] == {"one": True}


@pytest.mark.parametrize(
    ("place", "name"),
    [
        (content_store, "read_mark"),
        (content_store, "is_untouched"),
        (module, "is_environment_whole"),
    ],
)
def test_environment_that_is_removed_meanwhile_is_not_there(folders, monkeypatch, place, name):
    removing(monkeypatch, place, name, "environments", folders)

    assert ask(folders, "one")["environments"] == {"one": False}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["read_mark", "names_in"])
def test_what_nobody_asks_for_and_is_removed_meanwhile_is_no_error(
    folders, monkeypatch, kind, name
):
    removing(monkeypatch, content_store, name, kind, folders)

    told = ask(folders)

    assert told["prunable"]["wheels"] == []


def test_wheels_are_told_where_an_environment_is_to_be_built(folders):
    mark = content_store.read_mark(f"{folders['wheels']}/one") | {"info": "numpy-2.0.0.dist-info"}
    content_changes.mark_complete(f"{folders['wheels']}/one", mark)
    os.mkdir(f"{folders['wheels']}/half")

    assert ask(folders, "one")["wheels"] == []
    assert ask(folders, "other")["wheels"] == ["numpy-2.0.0.dist-info"]


def test_room_of_what_is_prunable_is_that_of_files_whose_last_name_goes(tmp_path):
    one, other, kept = (tmp_path / name for name in ("one", "other", "kept"))
    for folder in (one, other, kept):
        folder.mkdir()
    (one / "a").write_bytes(b"x" * 100_000)
    (one / "b").write_bytes(b"x" * 1_000_000)
    os.link(one / "a", other / "a")
    os.link(one / "b", kept / "b")
    room = (one / "a").stat().st_blocks * module.BLOCK_BYTES

    assert module.freed_bytes([str(one)]) == 0
    assert module.freed_bytes([str(one), str(other), str(tmp_path / "gone")]) == room >= 100_000


@pytest.mark.parametrize("step_s", [86_400 * 365, -7200])
def test_clock_that_is_set_makes_nothing_old(tmp_path, monkeypatch, step_s):
    """As by the first answer of a time service, on a board without a clock of its own or with one that is ahead."""
    sent, left = tmp_path / ".blobs", tmp_path / ".left"
    sent.mkdir()
    left.mkdir()
    now_s = sent.stat().st_mtime
    made_s = now_s + min(0, step_s)  # since the clock was set back, or before it was set forward
    os.utime(sent, (made_s, made_s))
    long_ago_s = made_s - content_store.LEFT_OVER_S - 60
    os.utime(left, (long_ago_s, long_ago_s))
    step_clock(monkeypatch, step_s)

    content_changes.remove_left_overs(str(tmp_path))

    assert os.listdir(tmp_path) == [".blobs"]


def test_left_over_of_a_time_to_come_grows_old_from_now_on(tmp_path, monkeypatch):
    left, young = tmp_path / ".left", tmp_path / ".young"
    left.mkdir()
    young.mkdir()
    os.utime(left, (4e9, 4e9))
    before = young.stat().st_mtime_ns

    content_changes.remove_left_overs(str(tmp_path))
    assert {".left", ".young"} == set(os.listdir(tmp_path))
    assert young.stat().st_mtime_ns == before
    step_clock(monkeypatch, 2 * content_store.LEFT_OVER_S, content_store.time.CLOCK_BOOTTIME)
    step_clock(monkeypatch, 2 * content_store.LEFT_OVER_S)
    content_changes.remove_left_overs(str(tmp_path))

    assert os.listdir(tmp_path) == []


def step_clock(monkeypatch, step_s, which=content_store.time.CLOCK_REALTIME):
    """Set a clock of this process forward, or back."""
    true_clock = content_store.time.clock_gettime
    monkeypatch.setattr(
        content_store.time,
        "clock_gettime",
        lambda clock: true_clock(clock) + (step_s if clock == which else 0),
    )


def test_what_was_left_half_made_is_prunable_and_its_room_is_counted(folders, tmp_path):
    sent = tmp_path / "trees" / ".blobs"
    part = tmp_path / "wheels" / ".ab.part"
    sent.mkdir()
    (sent / "cd").write_bytes(b"x" * 100_000)
    part.write_bytes(b"x" * 100_000)
    room = 2 * part.stat().st_blocks * module.BLOCK_BYTES

    young = ask_for_tree(folders)
    for path in (sent, part):
        os.utime(path, (1, 1))
    old = ask_for_tree(folders)

    assert young["prunable"]["trees"] == young["prunable"]["wheels"] == []
    assert young["blobs"] == ["cd"]
    assert old["prunable"]["trees"] == [".blobs"] and old["prunable"]["wheels"] == [".ab.part"]
    assert old["prunable_bytes"] == room
    assert old["blobs"] == []  # the next tree removes them first
    environment.prune_installed(
        VerbRequest(arguments={**question(folders), "compiled": str(tmp_path / "compiled")})
    )
    assert not sent.exists() and not part.exists()


def question(folders):
    return {"folders": folders, "trees": ["wanted"], "environments": []}


def ask_for_tree(folders):
    return installed(VerbRequest(arguments=question(folders)))
