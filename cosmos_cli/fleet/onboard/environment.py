"""
Virtual environments on a machine: built from wheels that were sent, under their final names, marked when whole.

An environment is a folder with a link to the interpreter and `pyvenv.cfg` (PEP 405): neither venv, ensurepip,
pip nor uv is needed there.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping

from cosmos_cli.fleet.onboard import store
from cosmos_cli.fleet.onboard.core import Refusal, Request, last_words, verb

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    from typing import Any

MARK_SCHEMA = 1
PART = ".part"
VERSIONS_TIMEOUT_S = 60.0
VERSIONS = """
import importlib.metadata, json, sys
found = {}
for name in sys.argv[1:]:
    try:
        found[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        found[name] = None
print(json.dumps(found))
"""


@verb("versions")
def versions(request: Request) -> dict[str, str | None]:
    """Tell which versions of Python packages the distribution's interpreter finds; None for what it does not."""
    names = [str(name) for name in request.arguments["names"]]
    done = subprocess.run(
        [_interpreter(), "-s", "-c", VERSIONS, *names],
        capture_output=True,
        timeout=VERSIONS_TIMEOUT_S,
        cwd="/",
        check=False,
    )
    if done.returncode:
        raise Refusal("step", f"{_interpreter()}: {last_words(done.stderr)}")
    found: dict[str, str | None] = json.loads(done.stdout)
    return found


@verb("wheel")
def wheel(request: Request) -> None:
    """Keep a piece of a wheel; with the last piece the whole is verified and gets its name."""
    asked = request.arguments
    folder = os.path.join(store.expand(asked["folder"]), asked["sha256"])
    os.makedirs(folder, exist_ok=True)
    path = os.path.join(folder, os.path.basename(asked["filename"]))
    partial = path + PART
    with open(partial, "ab") as file:
        if file.tell() != asked["offset"]:
            raise Refusal("data", f"{path}: expected {asked['offset']} bytes, has {file.tell()}")
        try:
            file.write(request.body)
            file.flush()
        except OSError:
            os.unlink(partial)  # a full disk needs the room more than the next try needs the piece
            raise
        if file.tell() < asked["size"]:
            return
        os.fsync(file.fileno())
    if store.hash_of(partial) != asked["sha256"]:
        os.unlink(partial)
        raise Refusal("data", f"{asked['filename']}: what came is not what was announced", "repeat")
    os.replace(partial, path)
    store.sync_names(folder)


@verb("environment")
def environment(request: Request) -> dict[str, Any]:
    """
    See that an environment is there.

    Returns whether anything changed, and which wheels must be sent first, each with how much is there of it.
    """
    asked = request.arguments
    folder = store.expand(asked["folder"])
    path = os.path.join(folder, asked["key"])
    if is_whole(path):
        return {"changed": False, "missing": []}
    if list(sys.version_info[:2]) != asked["python"]:
        found = ".".join(map(str, sys.version_info[:2]))
        raise Refusal("data", f"expected Python {asked['python']}, found {found}", "repeat")
    wheels = store.expand(asked["wheels_folder"])
    missing = _missing(wheels, asked["wheels"])
    if missing:
        return {"changed": False, "missing": missing}
    if os.path.isdir(path) and store.used([path]):
        raise Refusal(
            "busy",
            f"the environment {path} is damaged, and a run uses it",
            "end that run (`cosmos ps`, `cosmos down`), then repeat",
        )
    store.remove(path)
    store.remove_left_overs(folder, time.clock_gettime(time.CLOCK_REALTIME))
    try:
        _build(path, wheels, asked)
    except OSError:
        with contextlib.suppress(OSError):
            store.remove(path)  # most of all when the disk is full
        raise
    return {"changed": True, "missing": []}


def is_whole(path: str) -> bool:
    """
    Tell whether an environment is whole and nobody touched it since it was built.

    Its thousands of files are looked at, not read again: a byte that somebody changes leaves a trace in the
    times of its file. What was added, such as a package's own caches, does no harm.
    """
    mark = store.read_mark(path)
    if mark is None or not os.access(os.path.join(path, "bin/python"), os.X_OK):
        return False
    try:
        for name, (size, mtime_ns) in mark["files"].items():
            found = os.lstat(os.path.join(path, name))
            if (found.st_size, found.st_mtime_ns) != (size, mtime_ns):
                return False
    except (OSError, KeyError, ValueError):
        return False
    return True


def _missing(folder: str, wheels: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the wheels that are not there, or not what they were, and how much has come of each."""
    missing = []
    for wanted in wheels:
        path = os.path.join(folder, wanted["sha256"], wanted["filename"])
        try:
            if store.hash_of(path) == wanted["sha256"]:
                continue
            os.unlink(path)
        except FileNotFoundError:
            pass
        have = 0
        with contextlib.suppress(FileNotFoundError):
            have = os.stat(path + PART).st_size
        if have >= wanted["size"]:
            os.unlink(path + PART)
            have = 0
        missing.append({"sha256": wanted["sha256"], "have": have})
    return missing


def _build(path: str, wheels: str, asked: Mapping[str, Any]) -> None:
    from cosmos_cli.fleet.onboard.wheels import Place, Wheel

    version = ".".join(map(str, asked["python"]))
    place = Place(top=path, python=os.path.join(path, "bin/python"), python_version=version)
    for folder in (path, os.path.join(path, "bin")):
        os.makedirs(folder, exist_ok=True)
    os.makedirs(place.site)
    interpreter = _interpreter()
    for name in ("python", "python3", f"python{version}"):
        os.symlink(interpreter if name == "python" else "python", os.path.join(path, "bin", name))
    lines = {
        "home": os.path.dirname(interpreter),
        "include-system-site-packages": "true" if asked["sees_system"] else "false",
        "version": ".".join(map(str, sys.version_info[:3])),
    }
    text = "".join(f"{key} = {value}\n" for key, value in lines.items())
    with open(os.path.join(path, "pyvenv.cfg"), "x", encoding="utf-8") as file:
        file.write(text)
    written = ["pyvenv.cfg"]
    for wanted in asked["wheels"]:
        wheel_ = Wheel(os.path.join(wheels, wanted["sha256"], wanted["filename"]))
        try:
            written += wheel_.install(place)
        finally:
            wheel_.close()
    _finish(path, written, asked)


def _finish(path: str, written: list[str], asked: Mapping[str, Any]) -> None:
    """Wait until all of it is on the disk, then say that it is whole."""
    store.sync(path)
    files = {}
    for name in written:
        found = os.lstat(os.path.join(path, name))
        files[name] = [found.st_size, found.st_mtime_ns]
    document = {
        "schema": MARK_SCHEMA,
        "key": asked["key"],
        "wheels": [wanted["sha256"] for wanted in asked["wheels"]],
        "files": files,
    }
    store.mark_complete(path, document)
    store.sync_names(os.path.dirname(path))


def _interpreter() -> str:
    """
    Return the interpreter that an environment links to: this one, or what stands behind it.

    Its full name, such as /usr/bin/python3.11: an upgrade of the system must not put another Python under
    packages that were made for this one.
    """
    return os.path.realpath(getattr(sys, "_base_executable", None) or sys.executable)
