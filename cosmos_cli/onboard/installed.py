"""
State of what is installed on a machine: is it whole, does anybody still need it?

Asked at every `up` and every run, so it imports little and changes nothing.
"""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import time
from collections.abc import Mapping, Sequence

from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.request_loop import PlainValue, VerbRequest, sha256, verb

CACHE = "__pycache__"
NEWEST_KEPT = 2
"""Of the trees of one label, and of the environments, that nobody asks for."""
BLOCK_BYTES = 512
"""Unit of `st_blocks`, whatever the file system's own is."""
ORPHAN_S = 3600.0
"""A wheel that belongs to no environment after so long belongs to nobody."""


@verb("installed")
def installed(request: VerbRequest) -> dict[str, PlainValue]:
    """
    Tell which trees and environments are there, and really what they should be.

    With "touch", those are also remembered as wanted now. With "is_strict", a file that was added to an environment
    counts as damage. No lock is needed: what another command removes meanwhile is not there.
    """
    asked = request.arguments
    folders = {kind: content_store.expand(path) for kind, path in asked["folders"].items()}
    wanted = {"trees": asked["trees"], "environments": asked["environments"]}
    is_strict = bool(asked.get("is_strict"))

    def is_whole(kind: str, path: str) -> bool:
        if kind == "trees":
            return is_tree_whole(path)
        return is_environment_whole(path, is_strict=is_strict)

    told: dict[str, PlainValue] = {"folders": folders}
    for kind, names in wanted.items():
        told[kind] = {name: is_whole(kind, os.path.join(folders[kind], name)) for name in names}
        for name in names if asked.get("touch") else ():
            told[kind][name] = told[kind][name] and _touch(os.path.join(folders[kind], name))
    going = prunable(folders, wanted)
    is_any_missing = not all(told["environments"].values())
    told["wheels"] = wheels_there(folders["wheels"], going["wheels"]) if is_any_missing else []
    is_any_missing = not all(told["trees"].values())
    told["blobs"] = blobs_there(folders["trees"], going["trees"]) if is_any_missing else []
    paths = [os.path.join(folders[kind], name) for kind, names in going.items() for name in names]
    return {**told, "prunable": going, "prunable_bytes": freed_bytes(paths)}


def _touch(path: str) -> bool:
    """Remember what is whole as wanted now; False if it has gone."""
    try:
        os.utime(os.path.join(path, content_store.MARK))
    except FileNotFoundError:
        return False
    return True


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
    return sha256("".join(lines).encode())


def is_environment_whole(path: str, *, is_strict: bool) -> bool:
    """
    Tell whether an environment is whole and nobody touched it since it was built.

    Its hundreds of files are looked at, not read again: whoever changes a byte or a mode leaves a trace. What was added
    breaks it only when *is_strict*, and not under a living run: a package may keep something beside its code. What Python
    compiles is nobody's. One that is removed meanwhile is not whole.
    """
    with contextlib.suppress(FileNotFoundError):
        return _is_environment_whole(path, is_strict=is_strict)
    return False


def _is_environment_whole(path: str, *, is_strict: bool) -> bool:
    mark = content_store.read_mark(path)
    if mark is None or not os.access(os.path.join(path, "bin/python"), os.X_OK):
        return False
    files = mark.get("files", {"": []})
    if not content_store.is_untouched(path, files):
        return False
    if not is_strict or all(name in files for name in content_store.files_below(path, CACHE)):
        return True
    return bool(content_store.used([path]))


def interpreter_path() -> str:
    """
    Return the interpreter that an environment links to: this one, or what stands behind it.

    Its full name, such as /usr/bin/python3.11: an upgrade of the system must not put another Python under
    packages that were made for this one.
    """
    return os.path.realpath(getattr(sys, "_base_executable", None) or sys.executable)


def site_folder(python: Sequence[int]) -> str:
    """Return where an environment of a version of Python has its packages."""
    return f"lib/python{'.'.join(map(str, python))}/site-packages"


def prunable(folders: Mapping[str, str], wanted: Mapping[str, PlainValue]) -> dict[str, list[str]]:
    """Return what no living run uses, nobody asks for, and is not among the newest; what was left half made as well."""
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
    return {kind: names + content_store.left_overs(folders[kind]) for kind, names in found.items()}


def wheels_there(folder: str, going: Sequence[str]) -> list[str]:
    """Return the names of the dist-info folders of whole wheels that stay: an environment takes no room for them."""
    names = (name for name in content_store.names_in(folder) if name not in going)
    marks = (content_store.read_mark(os.path.join(folder, name)) or {} for name in names)
    return sorted({str(mark["info"]) for mark in marks if mark.get("info")})


def blobs_there(folder: str, going: Sequence[str]) -> list[str]:
    """Return the hashes of files that were sent and stay: a tree of them takes no room for these."""
    if content_store.BLOBS in going:
        return []
    return content_store.names_in(os.path.join(folder, content_store.BLOBS))


def freed_bytes(paths: Sequence[str]) -> int:
    """
    Return what the disk gets back at least when all of these are removed.

    A file of an environment is a wheel's as well, by a hard link: it is counted once, and only if its last name goes.
    """
    names_left: dict[tuple[int, int], int] = {}
    found_bytes = 0
    for path in paths:
        with contextlib.suppress(OSError):  # what goes meanwhile frees its room by itself
            is_folder = os.path.isdir(path) and not os.path.islink(path)
            for name in content_store.files_below(path, "") if is_folder else ("",):
                status = os.lstat(os.path.join(path, name) if name else path)
                inode = status.st_dev, status.st_ino
                names_left[inode] = names_left.get(inode, status.st_nlink) - 1
                if not names_left[inode]:
                    found_bytes += status.st_blocks * BLOCK_BYTES
    return found_bytes


def _newest(paths: list[str]) -> set[str]:
    """Return the newest of each label; half-made ones are nobody's."""
    by_label: dict[str, list[tuple[float, str]]] = {}
    for path in paths:
        mark = content_store.read_mark(path)
        when_s = _changed_s(os.path.join(path, content_store.MARK))
        if mark is not None and when_s is not None:
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
        and (name in going or _is_older(os.path.join(folders["wheels"], name), now_s - ORPHAN_S))
    ]


def _is_older(path: str, than_s: float) -> bool:
    changed_s = _changed_s(path)
    return changed_s is not None and changed_s < than_s


def _changed_s(path: str) -> float | None:
    """Return when a path was changed last, s since 1970; None of one that has gone."""
    with contextlib.suppress(FileNotFoundError):
        return os.stat(path).st_mtime
    return None
