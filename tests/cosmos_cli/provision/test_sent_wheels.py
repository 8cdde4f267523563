"""Wheels as machines are sent them: fewer files, compiled modules, the same content."""

import base64
import csv
import dataclasses
import hashlib
import io
import json
import os
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

import pytest
from made_wheels import make_wheel

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision import sent_wheels
from cosmos_cli.provision.lock import Locked
from cosmos_cli.provision.platform import Platform
from cosmos_cli.provision.sent_wheels import SentWheel, sent_wheel
from cosmos_cli.system import file_lock, ownership

HERE = Platform(python=sys.version_info[:2], machine="x86_64", libc_version=(2, 36))
OTHER = dataclasses.replace(HERE, python=(3, 99))
TAG = sys.implementation.cache_tag


@pytest.fixture
def made(tmp_path):
    """Return a function that makes a wheel with tests and a stub, and tells what it is."""

    def make(name, **changes):
        files = {
            f"{name}/tests/test_it.py": b"import pytest",
            f"{name}/core.py": b"x = 1",
            f"{name}/core.pyi": b"x: int",
            f"{name}/template.py": b"{{no python}}",
            "tests/of_nobody.py": b"",
        }
        path = make_wheel(tmp_path / "made", name, files=files, **changes)
        content = path.read_bytes()
        return path, Locked(
            name=name,
            version="99.0",
            sha256=hashlib.sha256(content).hexdigest(),
            filename=path.name,
            size_bytes=len(content),
        )

    return make


def names_in(sent):
    with zipfile.ZipFile(sent.path) as wheel:
        return set(wheel.namelist())


def test_tests_and_stubs_of_what_the_runtime_requires_stay_here(made):
    names = names_in(sent_wheel(*made("numpy"), OTHER))

    assert names == {
        "numpy/__init__.py",
        "numpy/core.py",
        "numpy/template.py",
        "tests/of_nobody.py",
        *(f"numpy-99.0.dist-info/{name}" for name in ("METADATA", "WHEEL", "RECORD")),
    }


def test_nothing_is_left_out_of_what_a_scenario_requires(made):
    path, locked = made("navlib")
    with zipfile.ZipFile(path) as wheel:
        whole = set(wheel.namelist())

    assert names_in(sent_wheel(path, locked, OTHER)) == whole


def test_modules_are_compiled_for_a_python_like_this_one(made):
    path, locked = made("navlib")
    more = names_in(sent_wheel(path, locked, HERE)) - names_in(sent_wheel(path, locked, OTHER))

    assert more == {
        f"navlib/__pycache__/__init__.{TAG}.pyc",
        f"navlib/__pycache__/core.{TAG}.pyc",
        f"navlib/tests/__pycache__/test_it.{TAG}.pyc",
        f"tests/__pycache__/of_nobody.{TAG}.pyc",
    }


def test_record_lists_what_is_sent_with_its_hashes(made):
    sent = sent_wheel(*made("numpy"), HERE)

    with zipfile.ZipFile(sent.path) as wheel:
        record = wheel.read("numpy-99.0.dist-info/RECORD").decode()
        rows = {name: said for name, said, _ in csv.reader(io.StringIO(record))}
        found = {name: hashlib.sha256(wheel.read(name)).digest() for name in names_in(sent)}
    assert rows.pop("numpy-99.0.dist-info/RECORD") == ""
    found.pop("numpy-99.0.dist-info/RECORD")
    assert rows == {
        name: f"sha256={base64.urlsafe_b64encode(digest).rstrip(b'=').decode()}"
        for name, digest in found.items()
    }


def test_it_is_made_once_and_again_when_it_is_gone(made):
    path, locked = made("numpy")
    first = sent_wheel(path, locked, HERE)
    when_ns = first.path.stat().st_mtime_ns
    second = sent_wheel(path, locked, HERE)
    unchanged_ns = second.path.stat().st_mtime_ns
    second.path.unlink()
    third = sent_wheel(path, locked, HERE)

    assert first == second == third
    assert when_ns == unchanged_ns
    assert hashlib.sha256(third.path.read_bytes()).hexdigest() == third.locked.sha256
    assert third.is_verified


def test_wheel_that_another_user_packed_is_not_believed(made, monkeypatch):
    path, locked = made("numpy")
    packed = sent_wheel(path, locked, OTHER)
    forged = b"forged"
    packed.path.write_bytes(forged)
    (packed.path.parent / sent_wheels.NOTE).write_text(
        json.dumps({"sha256": hashlib.sha256(forged).hexdigest(), "size_bytes": len(forged)})
    )
    uid = path.stat().st_uid
    monkeypatch.setattr(ownership, "ROOT", uid + 1)
    monkeypatch.setattr(os, "geteuid", lambda: uid + 2)

    assert sent_wheel(path, locked, OTHER).path.read_bytes() != forged


def test_wheel_that_record_contradicts_is_sent_as_it_came(made):
    path, locked = made("numpy", record={"numpy/core.py": "sha256=AAAA"})

    sent = sent_wheel(path, locked, HERE)

    assert (sent.path, sent.locked, sent.is_verified) == (path, locked, False)


@pytest.mark.parametrize("fault", ["stream", "record"])
def test_damaged_wheel_is_sent_as_it_came(made, fault):
    path, locked = made("numpy")
    with zipfile.ZipFile(path) as wheel:
        content = {entry.filename: wheel.read(entry) for entry in wheel.infolist()}
    if fault == "record":
        content["numpy-99.0.dist-info/RECORD"] = b"numpy/__init__.py\n"  # neither hash nor size
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as wheel:
        for name, data in content.items():
            wheel.writestr(name, data)
    if fault == "stream":
        head, name, rest = path.read_bytes().partition(b"numpy/core.py")
        path.write_bytes(head + name + b"\xff" * 4 + rest[4:])

    assert sent_wheel(path, locked, HERE) == SentWheel(locked=locked, path=path, is_verified=False)


PACK = """
import json, os, sys, time
from pathlib import Path
from cosmos_cli.provision import sent_wheels
from cosmos_cli.provision.lock import Locked
from cosmos_cli.provision.platform import Platform

path, known, meeting = Path(sys.argv[1]), json.loads(sys.argv[2]), Path(sys.argv[3])
dumps, noted = sent_wheels.marshal.dumps, sent_wheels._noted
sent_wheels.marshal.dumps = lambda code: dumps(code) + str(os.getpid()).encode()  # as other memory would

def noted_by_both(*arguments):
    found = noted(*arguments)
    (meeting / str(os.getpid())).touch()
    until_s = time.monotonic() + 60.0
    while len(list(meeting.iterdir())) < 2 and time.monotonic() < until_s:
        time.sleep(0.01)
    return found

sent_wheels._noted = noted_by_both
here = Platform(python=sys.version_info[:2], machine="x86_64", libc_version=(2, 36))
sent = sent_wheels.sent_wheel(path, Locked(**known), here)
print(json.dumps([str(sent.path), sent.locked.sha256]))
"""
"""Packs a wheel once both commands have seen that nobody has packed it."""


@pytest.mark.process
def test_two_commands_that_pack_the_same_wheel_send_the_same(made, tmp_path):
    path, locked = made("navlib")
    meeting = tmp_path / "meeting"
    meeting.mkdir()
    command = [sys.executable, "-c", PACK, path, json.dumps(dataclasses.asdict(locked)), meeting]
    commands = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(2)]
    told = [json.loads(each.communicate(timeout=120.0)[0]) for each in commands]

    assert told[0] == told[1]
    sent_path, sha256 = told[0]
    assert hashlib.sha256(Path(sent_path).read_bytes()).hexdigest() == sha256


def test_wheels_that_are_packed_at_once_take_turns_with_the_filters_of_warnings(
    made, tmp_path, monkeypatch
):
    """As for machines of two kinds; each is made of code that Python warns of."""
    inside, most = [], []
    catch = sent_wheels.warnings.catch_warnings

    class Caught(catch):
        def __enter__(self):
            inside.append(self)
            most.append(len(inside))
            time.sleep(0.05)
            return super().__enter__()

        def __exit__(self, *what):
            super().__exit__(*what)
            inside.remove(self)

    monkeypatch.setattr(sent_wheels.warnings, "catch_warnings", Caught)
    threads = []
    for name in ("one", "two"):
        path, locked = made(name)
        (tmp_path / name).mkdir()
        path = path.rename(tmp_path / name / path.name)
        threads.append(threading.Thread(target=sent_wheel, args=(path, locked, HERE)))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)

    assert len(most) >= 4
    assert max(most) == 1


def test_packed_wheel_that_lost_its_note_is_packed_anew(made):
    path, locked = made("navlib")
    sent = sent_wheel(path, locked, OTHER)
    (sent.path.parent / "sent.json").unlink()

    assert sent_wheel(path, locked, OTHER) == sent


def test_wheel_that_another_command_packs_without_end_is_told_with_who_it_is(made, monkeypatch):
    monkeypatch.setattr(sent_wheels, "LOCK_TIMEOUT_S", 0.0)
    path, locked = made("navlib")
    with (
        file_lock.locked(path.parent / "sent.lock", timeout_s=1.0),
        pytest.raises(
            MachineFailure, match=f"packs {locked.filename}.*pid {os.getpid()}"
        ) as failed,
    ):
        sent_wheel(path, locked, OTHER)

    assert failed.value.kind is FailureKind.BUSY
