"""
State of what is installed on a machine: is it whole, does it run, does anybody still need it?

Asked at every `up` and every run, so it imports little and changes nothing.
"""

from __future__ import annotations

import _socket  # what `socket` is made of: enough here, and a look is short of milliseconds
import contextlib
import hashlib
import os
import stat
import time
from collections.abc import Mapping

from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.request_loop import HelperRefusal, PlainValue, VerbRequest, last_words, verb

CACHE = "__pycache__"
NEWEST_KEPT = 2
"""Of the trees of one label, and of the environments, that nobody asks for."""
ORPHAN_S = 3600.0
"""A wheel that belongs to no environment after so long belongs to nobody."""
ECHO_TRIES = 3
ECHO_WAIT_S = 0.3
ECHO_BYTES_MAX = 256
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYTHONNOUSERSITE": "1"}
"""Variables of a run's programs: one thread per process, and nothing of the user's own packages."""

LIGHT = """
import sys
import madns_runtime
missing = [name for name in {modules!r} if not any(
    finder.find_spec(name) for finder in sys.meta_path)]
if missing:
    sys.exit("no module named " + ", ".join(missing))
print(madns_runtime.__version__)
"""
FULL = """
import importlib
import madns_runtime
import madns_runtime.agent
for name in {modules!r}:
    importlib.import_module(name)
if {simulation!r}:
    from pathlib import Path
    from madns_runtime.plugin.registry import load_half, resolve
    base = Path({base!r})
    load_half(resolve({simulation!r}, base), "agent", base)
print(madns_runtime.__version__)
"""


@verb("installed")
def installed(request: VerbRequest) -> dict[str, PlainValue]:
    """
    Tell which trees and environments are there, and really what they should be.

    With "touch", those are also remembered as wanted now.
    """
    asked = request.arguments
    folders = {kind: content_store.expand(path) for kind, path in asked["folders"].items()}
    wanted = {"trees": asked["trees"], "environments": asked["environments"]}
    checks = {"trees": is_tree_whole, "environments": is_environment_whole}
    told: dict[str, PlainValue] = {"folders": folders}
    for kind, names in wanted.items():
        told[kind] = {name: checks[kind](os.path.join(folders[kind], name)) for name in names}
        for name in names if asked.get("touch") else ():
            if told[kind][name]:
                os.utime(os.path.join(folders[kind], name, content_store.MARK))
    return {**told, "prunable": prunable(folders, wanted)}


def is_tree_whole(path: str) -> bool:
    """
    Tell whether a tree is what its name says.

    A tree that nobody has touched since it was read back is looked at; one that shows a trace is read again.
    One that is removed meanwhile is not whole.
    """
    with contextlib.suppress(FileNotFoundError):
        return _is_tree_whole(path)
    return False


def _is_tree_whole(path: str) -> bool:
    mark = content_store.read_mark(path)
    if mark is None:
        return False
    traces = traces_of_tree(path)
    if traces and traces == mark.get("traces"):
        return True
    tree_hash = os.path.basename(path)
    found = files_of_tree(path)
    if hash_of_tree(path, found) == tree_hash:
        return True
    # Flight software that writes beside its code must not make its own run's tree look broken.
    known = [file for file in found if file[0] in mark.get("files", {})]
    return (
        len(known) < len(found)
        and hash_of_tree(path, known) == tree_hash
        and bool(content_store.used([path]))
    )


def files_of_tree(path: str) -> list[tuple[str, bool]]:
    """Return the path of every file of a tree, and whether it is a program, in the order of the paths."""
    return sorted((name, bool(mode)) for name, (_, _, mode) in traces_of_tree(path).items())


def traces_of_tree(path: str) -> dict[str, list[int]]:
    """
    Return every file of a tree with its size, its time of change and whether it is a program.

    Nobody can set a time of change: whoever writes to a file, or to its mode, leaves a trace.
    """
    found: dict[str, list[int]] = {}
    waiting = [""]
    while waiting:
        inner = waiting.pop()
        for entry in os.scandir(os.path.join(path, inner)):
            name = f"{inner}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                if entry.name != CACHE:
                    waiting.append(f"{name}/")
            elif name != content_store.MARK:
                status = entry.stat(follow_symlinks=False)
                is_program = int(bool(status.st_mode & stat.S_IXUSR))
                found[name] = [status.st_size, status.st_ctime_ns, is_program]
    return found


def hash_of_tree(path: str, files: list[tuple[str, bool]]) -> str:
    """Return the hash of these files as `cosmos_cli.provision.trees.tree_of` makes it."""
    try:
        lines = [
            f"{'x' if is_program else '-'} {content_store.hash_of(f'{path}/{name}')} {name}\n"
            for name, is_program in files
        ]
    except OSError:
        return ""
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def is_environment_whole(path: str) -> bool:
    """
    Tell whether an environment is whole and nobody touched it since it was built.

    Its thousands of files are looked at, not read again: a byte that somebody changes leaves a trace in the
    time of its file. What was added, such as a package's own caches, does no harm.
    """
    mark = content_store.read_mark(path)
    if mark is None or not os.access(os.path.join(path, "bin/python"), os.X_OK):
        return False
    return content_store.is_untouched(path, mark.get("files", {"": []}))


def prunable(folders: Mapping[str, str], wanted: Mapping[str, PlainValue]) -> dict[str, list[str]]:
    """Return what no living run uses, nobody asks for, and is not among the newest."""
    found: dict[str, list[str]] = {}
    for kind, names in wanted.items():
        rest = [
            os.path.join(folders[kind], name)
            for name in content_store.names_in(folders[kind])
            if name not in names
        ]
        # Beside what is wanted: an `up` must leave the next one nothing to prune.
        spared = _newest(rest)
        rest = [path for path in rest if path not in spared]
        in_use = content_store.used(rest)
        found[kind] = [os.path.basename(path) for path in rest if path not in in_use]
    found["wheels"] = _orphans(folders, found["environments"])
    return found


def _newest(paths: list[str]) -> set[str]:
    """Return the newest of each label; half-made ones are nobody's."""
    by_label: dict[str, list[tuple[float, str]]] = {}
    for path in paths:
        mark = content_store.read_mark(path)
        if mark is not None:
            when_s = os.stat(os.path.join(path, content_store.MARK)).st_mtime
            by_label.setdefault(str(mark.get("label", "")), []).append((when_s, path))
    return {
        path for found in by_label.values() for _, path in sorted(found, reverse=True)[:NEWEST_KEPT]
    }


def _orphans(folders: Mapping[str, str], gone: list[str]) -> list[str]:
    """Return the wheels that no environment has, or that only those have that will be *gone*."""
    needed: set[str] = set()
    going: set[str] = set()
    for key in content_store.names_in(folders["environments"]):
        mark = content_store.read_mark(os.path.join(folders["environments"], key)) or {}
        (going if key in gone else needed).update(mark.get("wheels", ()))
    now_s = time.clock_gettime(time.CLOCK_REALTIME)
    return [
        name
        for name in content_store.names_in(folders["wheels"])
        if name not in needed
        and (
            name in going
            or now_s - os.stat(os.path.join(folders["wheels"], name)).st_mtime > ORPHAN_S
        )
    ]


@verb("check_runtime")
def check_runtime(request: VerbRequest) -> dict[str, PlainValue]:
    """See that the runtime starts here as an agent will, and that datagrams come and go."""
    import subprocess  # a look at what is installed starts no process

    asked = request.arguments
    code = (FULL if asked["is_full"] else LIGHT).format(
        modules=asked["modules"],
        simulation=asked.get("simulation", ""),
        base=content_store.expand(asked["base"]) if asked.get("base") else "/",
    )
    python = content_store.expand(asked["python"])
    path = os.pathsep.join(content_store.expand(folder) for folder in asked["path"])
    started_s = time.monotonic()
    try:
        done = subprocess.run(
            [python, "-P", "-c", code],
            capture_output=True,
            timeout=asked["timeout_s"],
            env={**os.environ, **VARIABLES, "PYTHONPATH": path},
            check=False,
        )
    except FileNotFoundError:
        raise HelperRefusal("step", f"{python}: no such program", "repeat `cosmos up`") from None
    except subprocess.TimeoutExpired:
        raise HelperRefusal(
            "timeout", f"the runtime did not start in {asked['timeout_s']} s"
        ) from None
    start_s = time.monotonic() - started_s
    if done.returncode:
        said = last_words(done.stderr) or f"exit status {done.returncode}"
        raise HelperRefusal("step", f"the runtime does not start there: {said}")
    version = done.stdout.decode(errors="replace").split()[-1:]
    udp = asked.get("udp")
    return {
        "runtime": version[0] if version else "",
        "start_ms": round(start_s * 1000, 1),
        "round_trip_ms": round_trip_ms(udp) if udp else None,
    }


def round_trip_ms(udp: Mapping[str, PlainValue]) -> float:
    """Send a nonce to the operator until it comes back."""
    nonce = bytes.fromhex(udp["nonce_hex"])
    address, port = str(udp["address"]), int(udp["port"])
    said = ""
    try:
        family, _, _, _, where = _socket.getaddrinfo(address, port, 0, _socket.SOCK_DGRAM)[0]
        with contextlib.closing(_socket.socket(family, _socket.SOCK_DGRAM)) as link:
            for attempt in range(ECHO_TRIES):
                sent_s = time.monotonic()
                link.sendto(nonce + bytes([attempt]), where)
                if _comes_back(link, nonce, sent_s + ECHO_WAIT_S):
                    return round((time.monotonic() - sent_s) * 1000, 3)
    except OSError as error:
        said = f" ({error.strerror or error})"
    raise HelperRefusal(
        "step",
        f"no UDP from here to {address}:{port}{said}",
        "is a firewall closing it? let UDP in on the operator's computer, or name the address by which"
        " this machine reaches it with cosmos_host_address",
    )


def _comes_back(link: _socket.socket, nonce: bytes, until_s: float) -> bool:
    while (left_s := until_s - time.monotonic()) > 0:
        link.settimeout(left_s)
        try:
            answer = link.recv(ECHO_BYTES_MAX)
        except (TimeoutError, ConnectionRefusedError):
            continue
        if answer[: len(nonce)] == nonce:
            return True
    return False
