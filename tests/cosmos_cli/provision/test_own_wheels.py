"""Requirements that are paths: what stands for them, when it is built anew, and what is said of those that will not do."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from harness.waiting import wait_until
from made_wheels import make_wheel

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.provision import wheels
from cosmos_cli.provision.wheels import (
    UNUSED_S_MAX,
    own_wheel,
    remove_unused,
    with_own_wheels,
)
from cosmos_cli.system import ownership

SCENARIO = "name: a\nsimulation: counter\nagents: {count: 1}\nrequirements: ["


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a scenario's folder with sources that count how often they are built."""
    (tmp_path / "a/cars").mkdir(parents=True)
    (tmp_path / "a/cars/pyproject.toml").write_text("[project]\nname = 'cars'\n")
    (tmp_path / "a/cars/cars.py").write_text("x = 1\n")

    def build(source: Path, made: Path, text: str) -> Path:
        builds.append(text)
        content = (source / "cars.py").read_bytes()
        return make_wheel(made, "cars", "0.1", files={"cars/x.py": content})

    builds.clear()
    monkeypatch.setattr(wheels, "_built", build)
    return tmp_path / "a"


builds: list[str] = []


def test_other_requirements_are_left_as_they_are(folder):
    assert with_own_wheels(["numpy>=1.24", "pyserial"], folder) == ("numpy>=1.24", "pyserial")


def test_a_wheel_is_kept_under_its_hash(folder):
    wheel = make_wheel(folder / "dist", "motor", "0.2")
    (text,) = with_own_wheels(["./dist/motor-0.2-py3-none-any.whl"], folder)
    locked, path = own_wheel(text)

    assert text.startswith("motor @ file:///")
    assert (locked.name, locked.version, locked.filename) == ("motor", "0.2", wheel.name)
    assert locked.size_bytes == wheel.stat().st_size
    assert path.read_bytes() == wheel.read_bytes()


def test_a_wheel_of_which_nobody_knows_what_it_needs_is_refused(folder):
    wheel = make_wheel(folder / "dist", "motor", "0.2", requires=["a b c"])

    with pytest.raises(InputError, match="requirements: ./dist/motor.*METADATA"):
        with_own_wheels([f"./dist/{wheel.name}"], folder)


def test_a_folder_is_built_once_until_it_changes(folder):
    first = with_own_wheels(["./cars"], folder)
    os.utime(folder / "cars/cars.py")
    (folder / "cars/__pycache__").mkdir()

    assert with_own_wheels(["./cars"], folder) == first
    assert len(builds) == 1

    (folder / "cars/cars.py").write_text("x = 2\n")

    assert with_own_wheels(["./cars"], folder) != first
    assert len(builds) == 2


def test_programs_of_a_folder_are_built_as_programs(folder, monkeypatch):
    (folder / "cars/tool").write_text("#!/bin/sh\n")
    (folder / "cars/tool").chmod(0o755)
    modes = {}
    build = wheels._built

    def look(source: Path, made: Path, text: str) -> Path:
        modes.update({path.name: path.stat().st_mode & 0o777 for path in source.iterdir()})
        return build(source, made, text)

    monkeypatch.setattr(wheels, "_built", look)
    with_own_wheels(["./cars"], folder)

    assert modes["tool"] == 0o755
    assert not modes["cars.py"] & 0o111


def test_a_wheel_that_left_the_cache_is_built_again(folder):
    (text,) = with_own_wheels(["./cars"], folder)
    own_wheel(text)[1].unlink()
    with_own_wheels(["./cars"], folder)

    assert len(builds) == 2
    assert own_wheel(text)[1].is_file()


def test_note_of_another_user_of_what_was_built_is_not_believed(folder, cache, monkeypatch):
    uid = folder.stat().st_uid
    with_own_wheels(["./cars"], folder)
    monkeypatch.setattr(ownership, "ROOT", uid + 1)
    monkeypatch.setattr(os, "geteuid", lambda: uid + 2)

    with_own_wheels(["./cars"], folder)

    assert builds == ["./cars", "./cars"]


def test_note_of_what_was_built_goes_when_nobody_wanted_it_for_long(folder, cache):
    with_own_wheels(["./cars"], folder)
    (note,) = (cache / "built").iterdir()
    os.utime(note, (1000.0, 1000.0))

    with_own_wheels(["./cars"], folder)
    remove_unused(cache, now_s=note.stat().st_mtime + UNUSED_S_MAX)
    assert note.exists(), "it was just used"

    remove_unused(cache, now_s=note.stat().st_mtime + UNUSED_S_MAX + 1.0)
    assert not note.exists()


def test_damaged_note_of_what_was_built_is_written_anew(folder, cache):
    first = with_own_wheels(["./cars"], folder)
    (note,) = (cache / "built").iterdir()
    note.write_bytes(b"\xff\xfe")

    assert with_own_wheels(["./cars"], folder) == first
    assert note.read_bytes() != b"\xff\xfe"


@pytest.mark.process
def test_sources_that_cannot_be_built_are_told_with_pips_last_words(tmp_path):
    (tmp_path / "cars").mkdir()
    (tmp_path / "cars/pyproject.toml").write_text(
        "[build-system]\nrequires = []\nbuild-backend = 'nowhere'\nbackend-path = ['.']\n"
    )
    with pytest.raises(InputError, match=r"requirements: \./cars: no wheel can be built of it: .+"):
        with_own_wheels(["./cars"], tmp_path)


def test_cache_that_takes_no_wheel_is_told_with_the_requirement(folder, cache):
    make_wheel(folder / "dist", "motor", "0.2")
    cache.touch()

    with pytest.raises(InputError, match=r"requirements: ./dist/motor-.*COSMOS_CACHE"):
        with_own_wheels(["./dist/motor-0.2-py3-none-any.whl"], folder)


HANGING = """
import os, subprocess, sys, time
def build_wheel(*everything, **more):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(300)"])
    with open({place!r}, "w") as file:
        file.write(f"{{os.getpid()}} {{child.pid}}")
    time.sleep(300)
"""


@pytest.mark.process
def test_a_build_that_hangs_is_ended_with_all_that_it_started(tmp_path, monkeypatch):
    place = tmp_path / "pids"
    (tmp_path / "cars").mkdir()
    (tmp_path / "cars/pyproject.toml").write_text(
        "[build-system]\nrequires = []\nbuild-backend = 'hanging'\nbackend-path = ['.']\n"
    )
    (tmp_path / "cars/hanging.py").write_text(HANGING.format(place=str(place)))
    monkeypatch.setattr(wheels, "BUILD_TIMEOUT_S", 0.5)

    class Begun(subprocess.Popen):
        """A program whose time begins with the build: what pip takes until then is its own."""

        def communicate(self, input: str | None = None, timeout: float | None = None):
            wait_until(lambda: place.exists() and place.read_text(), "build", process=self)
            return super().communicate(input, timeout)

    monkeypatch.setattr(subprocess, "Popen", Begun)
    said: list[str] = []
    start_s = time.monotonic()

    with pytest.raises(InputError, match=r"within 0.5 s; see what it waits for with: pip wheel"):
        with_own_wheels(["./cars"], tmp_path, said.append)

    assert time.monotonic() - start_s < 200  # its children sleep for longer
    assert said == ["building a wheel of ./cars"]
    for pid in place.read_text().split():
        wait_until_gone(int(pid))


def wait_until_gone(pid: int) -> None:
    until_s = time.monotonic() + 60
    while time.monotonic() < until_s:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return
        except OSError:
            return
        time.sleep(0.05)
    os.kill(pid, signal.SIGKILL)
    raise AssertionError(f"process {pid} of the build lives still")


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("./none.whl", "no such file or folder"),
        ("./cars", "cars is not installed on this computer; install it here as well"),
        ("./empty", "expected a folder with pyproject.toml or setup.py"),
        ("./notes.txt", "expected a wheel such as cars-0.1-py3-none-any.whl, or a folder"),
        ("./pipe", "expected a file, got a pipe"),
        ("./pytest-0.0.1-py3-none-any.whl", "on this computer, and boards would get 0.0.1"),
        ("/etc/passwd", "expected a Python requirement such as numpy"),
    ],
)
def test_validate_says_what_to_do(folder, name, told):
    (folder / "empty").mkdir()
    (folder / "notes.txt").touch()
    (folder / "pytest-0.0.1-py3-none-any.whl").touch()
    os.mkfifo(folder / "pipe")
    (folder / "a.yaml").write_text(f"{SCENARIO}{name}]\n")
    with pytest.raises(InputError) as caught:
        load_scenario(folder / "a.yaml")

    assert "a.yaml:4:16: requirements[0]: " in str(caught.value)
    assert told in str(caught.value)


def test_a_wheel_for_boards_alone_need_not_be_here(folder):
    make_wheel(folder, "servo", "1.0", tag="cp311-cp311-manylinux_2_17_aarch64")
    name = "servo-1.0-cp311-cp311-manylinux_2_17_aarch64.whl"
    (folder / "a.yaml").write_text(f"{SCENARIO}./{name}]\n")

    assert load_scenario(folder / "a.yaml").scenario.requirements == (f"./{name}",)
