"""
Trees on a machine: assembled from files that are there and files that were sent, verified, never changed.

A tree's name is the hash of its content, so that what is there proves itself.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping

from cosmos_cli.onboard import content_changes, content_store
from cosmos_cli.onboard.installed import files_of_tree, hash_of_tree, is_tree_whole, traces_of_tree
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    no_links,
    sync_folder,
    verb,
)

MARK_SCHEMA = 1
PART = ".part"


@verb("blobs")
def blobs(request: VerbRequest) -> None:
    """Keep files that were sent; a tree will be made of them."""
    asked = request.arguments
    content = memoryview(_unpacked(request.body, sum(size for _, size in asked["blobs"])))
    with _blobs_folder(asked["folder"]) as folder:
        for sha256, size in asked["blobs"]:
            blob, content = content[:size], content[size:]
            if hashlib.sha256(blob).hexdigest() != sha256:
                raise _not_announced()
            content_changes.write_whole(os.path.join(folder, sha256), bytes(blob), is_durable=False)


@verb("blob")
def blob(request: VerbRequest) -> None:
    """Keep a piece of a large file that is sent; with the last one it is verified and gets its name."""
    asked = request.arguments
    piece = _unpacked(request.body, asked["length"])
    with _blobs_folder(asked["folder"]) as folder:
        partial = os.path.join(folder, f"{content_store.HIDDEN}{asked['sha256']}{PART}")
        with open(partial, "ab" if asked["offset"] else "wb", opener=no_links) as file:
            if file.tell() != asked["offset"]:
                text = f"{partial}: expected {asked['offset']} B, has {file.tell()} B"
                raise HelperRefusal("data", text, "repeat")
            file.write(piece)
        if asked["offset"] + len(piece) < asked["size"]:
            return
        if content_store.hash_of(partial) != asked["sha256"]:
            os.unlink(partial)
            raise _not_announced()
        os.replace(partial, os.path.join(folder, asked["sha256"]))


@contextlib.contextmanager
def _blobs_folder(trees_folder: str) -> Iterator[str]:
    """Give the folder of what was sent; it goes when it cannot be written: a full disk needs the room more."""
    folder = os.path.join(content_store.expand(trees_folder), content_store.BLOBS)
    try:
        os.makedirs(folder, exist_ok=True)
        os.utime(folder)  # pieces of one file alone would leave it as old as the first
        yield folder
    except OSError:
        _drop(folder)
        raise


def _drop(blobs_folder: str) -> None:
    with contextlib.suppress(OSError):
        content_changes.remove(blobs_folder)


def _not_announced() -> HelperRefusal:
    return HelperRefusal("data", "a file that was sent is not what was announced", "repeat")


@verb("tree")
def tree(request: VerbRequest) -> dict[str, PlainValue]:
    """
    See that a tree is there.

    Returns whether anything changed, and the hashes of files that must be sent first.
    """
    asked = request.arguments
    folder = content_store.expand(asked["folder"])
    path = os.path.join(folder, asked["hash"])
    if is_tree_whole(path):
        return {"changed": False, "missing": []}
    os.makedirs(folder, exist_ok=True)
    with _alone_in(folder):
        if is_tree_whole(path):  # another operator was quicker
            return {"changed": False, "missing": []}
        content_changes.remove_left_overs(folder)
        sources = _verified(folder, [sha256 for _, sha256, _ in asked["files"]])
        if None in sources.values():
            missing = [sha256 for sha256, source in sources.items() if source is None]
            return {"changed": False, "missing": missing}
        new = content_changes.beside(folder, asked["hash"])
        try:
            _assemble(new, asked["files"], sources)
            _settle(new, folder, asked)
        except OSError:
            _drop(os.path.join(folder, content_store.BLOBS))
            raise
        finally:
            with contextlib.suppress(FileNotFoundError):
                content_changes.remove(new)
    return {"changed": True, "missing": []}


@contextlib.contextmanager
def _alone_in(folder: str) -> Iterator[None]:
    """Wait until nobody else assembles a tree here: what was sent is moved into one, and may be in another as well."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _verified(folder: str, wanted: list[str]) -> dict[str, str | None]:
    """Return where each wanted content is: in what was sent, or in another tree; None of one that is not here."""
    places: dict[str, list[str]] = {sha256: [] for sha256 in wanted}
    sent = os.path.join(folder, content_store.BLOBS)
    for sha256 in places.keys() & content_store.names_in(sent):
        places[sha256].append(os.path.join(sent, sha256))
    for tree_hash in content_store.names_in(folder):
        path = os.path.join(folder, tree_hash)
        mark = content_store.read_mark(path) or {}
        for name, sha256 in mark.get("files", {}).items():
            if sha256 in places:
                places[sha256].append(os.path.join(path, name))
    return {sha256: _first_whole(sha256, paths) for sha256, paths in places.items()}


def _first_whole(sha256: str, paths: list[str]) -> str | None:
    for path in paths:
        with contextlib.suppress(OSError):
            if content_store.hash_of(path) == sha256:
                return path
    return None


def _assemble(new: str, files: list[list[PlainValue]], sources: Mapping[str, str | None]) -> None:
    """
    Make a folder of files that are here.

    What was sent is moved, so that a tree never needs twice its room. What another tree has is copied: a second name
    would change the time of a file there, by which both would be read again at every look.
    """
    sent = os.path.join(os.path.dirname(new), content_store.BLOBS)
    os.mkdir(new)
    moved: dict[str, str] = {}
    for name, sha256, mode in files:
        path = _path_within(new, name)
        os.makedirs(os.path.dirname(path), exist_ok=True)
        source = moved.get(sha256) or str(sources[sha256])
        if os.path.dirname(source) == sent:
            os.rename(source, path)
            moved[sha256] = path
        else:
            shutil.copyfile(source, path)
        os.chmod(path, mode)  # whatever the umask is here


def _path_within(top: str, name: str) -> str:
    parts = name.split("/")
    if not all(parts) or {".", ".."} & set(parts):
        raise HelperRefusal("data", f"{name!r}: expected a path within the tree")
    return os.path.join(top, name)


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


def _unpacked(body: bytes, size: int) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(body, size + 1)
    except zlib.error as error:
        raise HelperRefusal(
            "data", f"what was sent cannot be unpacked: {error}", "repeat"
        ) from None
    if len(content) != size:
        raise HelperRefusal("data", f"expected {size} bytes of files, got {len(content)}", "repeat")
    return content
