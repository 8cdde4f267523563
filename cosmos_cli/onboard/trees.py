"""
Trees on a machine: assembled from files that are there and files that were sent, verified, never changed.

A tree's name is the hash of its content, so that what is there proves itself.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import zlib
from collections.abc import Iterable, Mapping

from cosmos_cli.onboard import content_changes, content_store
from cosmos_cli.onboard.installed import files_of_tree, hash_of_tree, is_tree_whole, traces_of_tree
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    sync_folder,
    verb,
)

BLOBS = ".blobs"
"""Files that were sent and belong to no tree yet, by their hash."""
MARK_SCHEMA = 1


@verb("blobs")
def blobs(request: VerbRequest) -> None:
    """Keep files that were sent; a tree will be made of them."""
    folder = os.path.join(content_store.expand(request.arguments["folder"]), BLOBS)
    os.makedirs(folder, exist_ok=True)
    content = memoryview(_unpacked(request))
    for sha256, size in request.arguments["blobs"]:
        blob, content = content[:size], content[size:]
        if hashlib.sha256(blob).hexdigest() != sha256:
            raise HelperRefusal("data", "a file that was sent is not what was announced", "repeat")
        content_changes.write_whole(os.path.join(folder, sha256), bytes(blob), is_durable=False)


@verb("tree")
def tree(request: VerbRequest) -> dict[str, PlainValue]:
    """
    See that a tree is there.

    Returns whether anything changed, and the hashes of files that must be sent first.
    """
    asked = request.arguments
    folder = content_store.expand(asked["folder"])
    if is_tree_whole(os.path.join(folder, asked["hash"])):
        return {"changed": False, "missing": []}
    os.makedirs(folder, exist_ok=True)
    content_changes.remove_left_overs(folder)
    new = content_changes.beside(folder, asked["hash"])
    try:
        missing = _assemble(new, folder, asked["files"])
        if missing:
            return {"changed": False, "missing": missing}
        _settle(new, folder, asked)
    finally:
        with contextlib.suppress(FileNotFoundError):
            content_changes.remove(new)
    return {"changed": True, "missing": []}


def _assemble(new: str, folder: str, files: list[list[PlainValue]]) -> list[str]:
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
    for sha256 in content_store.names_in(sent):
        sources.setdefault(sha256, []).append(os.path.join(sent, sha256))
    for tree_hash in content_store.names_in(folder):
        path = os.path.join(folder, tree_hash)
        mark = content_store.read_mark(path) or {}
        for name, sha256 in mark.get("files", {}).items():
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
    if not all(parts) or {".", ".."} & set(parts):
        raise HelperRefusal("data", f"{name!r}: expected a path within the tree")
    path = os.path.join(top, name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    content_changes.write_new(path, content, mode)
    os.chmod(path, mode)  # whatever the umask is here


def _settle(new: str, folder: str, asked: Mapping[str, PlainValue]) -> None:
    """Give an assembled tree its name; what stands there and is broken makes room."""
    if hash_of_tree(new, files_of_tree(new)) != asked["hash"]:
        raise HelperRefusal(
            "data",
            f"{asked['label']}: what was written is not what is read back",
            "check the disk there",
        )
    content_changes.sync(new)
    files = {name: sha256 for name, sha256, _ in asked["files"]}
    mark = {"schema": MARK_SCHEMA, "label": asked["label"], "files": files}
    content_changes.mark_complete(new, {**mark, "traces": traces_of_tree(new)})
    _take_place(new, os.path.join(folder, asked["hash"]), asked["label"])
    sync_folder(folder)
    for sha256 in set(files.values()):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(os.path.join(folder, BLOBS, sha256))


def _take_place(new: str, path: str, label: str) -> None:
    """Give an assembled tree its name, unless another operator was quicker: somebody may run from that one."""
    if is_tree_whole(path):
        return
    content_changes.remove(path)
    try:
        os.rename(new, path)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTEMPTY):
            raise
        if not is_tree_whole(path):
            raise HelperRefusal("busy", f"{label}: another command works on it", "repeat") from None


def _unpacked(request: VerbRequest) -> bytes:
    size = sum(size for _, size in request.arguments["blobs"])
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(request.body, size + 1)
    except zlib.error as error:
        raise HelperRefusal(
            "data", f"what was sent cannot be unpacked: {error}", "repeat"
        ) from None
    if len(content) != size:
        raise HelperRefusal("data", f"expected {size} bytes of files, got {len(content)}", "repeat")
    return content
