"""
Trees on a machine: assembled from files that are there and files that were sent, verified, never changed.

A tree's name is the hash of its content, so that what is there proves itself.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import time
import zlib
from collections.abc import Iterable, Mapping

from cosmos_cli.fleet.onboard import store
from cosmos_cli.fleet.onboard.core import Refusal, Request, verb

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    from typing import Any

BLOBS = ".blobs"
"""Files that were sent and belong to no tree yet, by their hash."""
CACHE = "__pycache__"
MANIFEST_SCHEMA = 1


@verb("blobs")
def blobs(request: Request) -> None:
    """Keep files that were sent; a tree will be made of them."""
    folder = os.path.join(store.expand(request.arguments["folder"]), BLOBS)
    os.makedirs(folder, exist_ok=True)
    content = memoryview(_unpacked(request))
    for sha256, size in request.arguments["blobs"]:
        blob, content = content[:size], content[size:]
        if hashlib.sha256(blob).hexdigest() != sha256:
            raise Refusal("data", "a file that was sent is not what was announced", "repeat")
        store.write_whole(os.path.join(folder, sha256), bytes(blob), is_durable=False)


@verb("tree")
def tree(request: Request) -> dict[str, Any]:
    """
    See that a tree is there.

    Returns whether anything changed, and the hashes of files that must be sent first.
    """
    asked = request.arguments
    folder = store.expand(asked["folder"])
    if is_whole(folder, asked["hash"]):
        return {"changed": False, "missing": []}
    os.makedirs(folder, exist_ok=True)
    store.remove_left_overs(folder, time.clock_gettime(time.CLOCK_REALTIME))
    new = store.beside(folder, asked["hash"])
    try:
        missing = _assemble(new, folder, asked["files"])
        if missing:
            return {"changed": False, "missing": missing}
        _settle(new, folder, asked)
    finally:
        with contextlib.suppress(FileNotFoundError):
            store.remove(new)
    return {"changed": True, "missing": []}


def is_whole(folder: str, tree_hash: str) -> bool:
    """Read every file of a tree again, and tell whether it is what its name says."""
    path = os.path.join(folder, tree_hash)
    if store.read_mark(path) is None:
        return False
    found = list(_files(path))
    if _hash_of_tree(path, found) == tree_hash:
        return True
    # Flight software that writes beside its code must not make its own run's tree look broken.
    manifest = _manifest(path)
    known = [file for file in found if file[0] in manifest]
    return (
        len(known) < len(found)
        and _hash_of_tree(path, known) == tree_hash
        and bool(store.used([path]))
    )


def _hash_of_tree(path: str, files: list[tuple[str, bool]]) -> str:
    """Return the hash of these files as `cosmos_cli.provision.trees.tree_of` makes it."""
    digest = hashlib.sha256()
    try:
        for name, is_program in files:
            content = store.hash_of(os.path.join(path, name))
            digest.update(f"{'x' if is_program else '-'} {content} {name}\n".encode())
    except OSError:
        return ""
    return digest.hexdigest()


def _files(top: str) -> list[tuple[str, bool]]:
    """Return the path of every file of a tree, and whether it is a program, in the order of the paths."""
    found: list[tuple[str, bool]] = []
    waiting = [""]
    while waiting:
        inner = waiting.pop()
        for entry in os.scandir(os.path.join(top, inner)):
            name = f"{inner}{entry.name}"
            if entry.is_dir(follow_symlinks=False):
                if entry.name != CACHE:
                    waiting.append(f"{name}/")
            elif name != store.MARK:
                mode = entry.stat(follow_symlinks=False).st_mode
                found.append((name, bool(mode & stat.S_IXUSR)))
    return sorted(found)


def _manifest(path: str) -> dict[str, str]:
    """Return the hash of each file of a tree, as its mark tells."""
    mark = store.read_mark(path) or {}
    files = mark.get("files")
    return files if isinstance(files, dict) else {}


def _assemble(new: str, folder: str, files: list[list[Any]]) -> list[str]:
    """Make a folder of files that are somewhere here; return the hashes of those that are not."""
    sources = _sources(folder)
    missing: dict[str, None] = {}
    os.mkdir(new)
    for name, sha256, mode in files:
        if sha256 in missing:
            continue
        content = _content(sha256, sources.get(sha256, ()))
        if content is None:
            missing[sha256] = None
        elif not missing:
            _put(new, name, mode, content)
    return list(missing)


def _sources(folder: str) -> dict[str, list[str]]:
    """Return where each content is: in what was sent, or in another tree."""
    sources: dict[str, list[str]] = {}
    sent = os.path.join(folder, BLOBS)
    for sha256 in store.names_in(sent):
        sources.setdefault(sha256, []).append(os.path.join(sent, sha256))
    for tree_hash in store.names_in(folder):
        path = os.path.join(folder, tree_hash)
        for name, sha256 in _manifest(path).items():
            sources.setdefault(sha256, []).append(os.path.join(path, name))
    return sources


def _content(sha256: str, paths: Iterable[str]) -> bytes | None:
    for path in paths:
        with contextlib.suppress(OSError), open(path, "rb") as file:
            content = file.read()
            if hashlib.sha256(content).hexdigest() == sha256:
                return content
    return None


def _put(top: str, name: str, mode: int, content: bytes) -> None:
    parts = name.split("/")
    if os.path.isabs(name) or not all(parts) or {".", ".."} & set(parts):
        raise Refusal("data", f"{name!r}: expected a path within the tree")
    path = os.path.join(top, name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with open(descriptor, "wb") as file:
        os.fchmod(descriptor, mode)  # whatever the umask is here
        file.write(content)


def _settle(new: str, folder: str, asked: Mapping[str, Any]) -> None:
    """Give an assembled tree its name; what stands there and is broken makes room."""
    files = {name: sha256 for name, sha256, _ in asked["files"]}
    if _hash_of_tree(new, _files(new)) != asked["hash"]:
        raise Refusal(
            "data",
            f"{asked['label']}: what was written is not what is read back",
            "check the disk there",
        )
    store.sync(new)
    store.mark_complete(new, {"schema": MANIFEST_SCHEMA, "label": asked["label"], "files": files})
    path = os.path.join(folder, asked["hash"])
    store.remove(path)
    try:
        os.rename(new, path)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise
        if not is_whole(folder, asked["hash"]):  # else another operator was quicker
            text = f"{asked['label']}: another command works on it"
            raise Refusal("busy", text, "repeat") from None
    store.sync_names(folder)
    for sha256 in set(files.values()):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(os.path.join(folder, BLOBS, sha256))


def _unpacked(request: Request) -> bytes:
    size = sum(size for _, size in request.arguments["blobs"])
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(request.body, size + 1)
    except zlib.error as error:
        raise Refusal("data", f"what was sent cannot be unpacked: {error}", "repeat") from None
    if len(content) != size:
        raise Refusal("data", f"expected {size} bytes of files, got {len(content)}", "repeat")
    return content
