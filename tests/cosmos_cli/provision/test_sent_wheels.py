"""Wheels as machines are sent them: fewer files, compiled modules, the same content."""

import base64
import csv
import dataclasses
import hashlib
import io
import sys
import zipfile

import pytest
from made_wheels import make_wheel

from cosmos_cli.provision.lock import Locked
from cosmos_cli.provision.platform import Platform
from cosmos_cli.provision.sent_wheels import sent_wheel

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


def test_wheel_that_record_contradicts_is_sent_as_it_came(made):
    path, locked = made("numpy", record={"numpy/core.py": "sha256=AAAA"})

    sent = sent_wheel(path, locked, HERE)

    assert (sent.path, sent.locked, sent.is_verified) == (path, locked, False)
