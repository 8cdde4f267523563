"""
Records of a run on this machine: listed with hashes, sent in pieces, deleted once their copy is verified.

Nothing of a run is touched while something of it lives: neither what the register of processes names
nor anything that holds one of its files open for writing.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import stat
import time
import zlib
from collections.abc import Generator, Iterator

from cosmos_cli.onboard.processes import find_living, path_of, wait_for_end
from cosmos_cli.onboard.request_loop import (
    AnswerPiece,
    HelperRefusal,
    PlainValue,
    VerbRequest,
    no_links,
    sync_folder,
    verb,
)

PIECE_BYTES = 262_144
FILES_MAX = 100_000
BATCH_FILES = 500
BATCH_S = 1.0
"""So often a long manifest gives a sign of life."""
READ_BYTES = 1_048_576
LEVEL = 1
"""Of zlib: a board compresses as fast as its network card takes it, or nearly."""
PACKED_SHARE_MAX = 0.9
"""Share above which packed bytes are sent unpacked."""
LISTINGS_MAX = 8
DELETE_TRIES_MAX = 100
"""Each ends where somebody else had deleted something first."""
RELEASED_PREFIX = ".released-"
"""Begins the name of a folder that may go: its copy is verified."""

Entry = dict[str, PlainValue]
Stamp = tuple[int, ...]
"""Marks that change when a file does: kind, inode, size, and both times to the nanosecond."""


_listings: dict[tuple[str, str], dict[str, Stamp]] = {}
"""Directories as they were when this process made a manifest of them: by path and by the manifest's hash."""


@verb("sizes")
def sizes(request: VerbRequest) -> Iterator[AnswerPiece]:
    """List every file below a directory with its size, in batches: nothing of it is read."""
    directory, state = path_of(request, "directory"), path_of(request, "state")
    wait_for_end(directory, state, float(request.arguments.get("patience_s", 0.0)))
    if not is_folder(directory):
        yield AnswerPiece(value={"gone": True})
        return
    batch: list[list[PlainValue]] = []
    for path, (mode, _, size_bytes, _, _) in walk(directory, unread={}):
        batch.append([path, size_bytes if stat.S_ISREG(mode) else 0])
        if len(batch) >= BATCH_FILES:
            yield AnswerPiece(value={"sizes": batch})
            batch = []
    yield AnswerPiece(value={"sizes": batch})


@verb("manifest")
def manifest(request: VerbRequest) -> Iterator[AnswerPiece]:
    """
    List every file below a directory, hashed, in batches; at last the hash of the list itself.

    What cannot be read, such as a folder on a failing card, is listed with the reason, a folder with a slash
    behind its name.

    Refuses with `busy` when something of the run still lives after `patience_s`, and with `data` what is
    more than `bytes_max` together.
    """
    directory, state = path_of(request, "directory"), path_of(request, "state")
    wait_for_end(directory, state, float(request.arguments.get("patience_s", 0.0)))
    if not is_folder(directory):
        sweep(directory)
        yield AnswerPiece(value={"gone": True})
        return
    left_bytes = int(request.arguments["bytes_max"])
    digest = hashlib.sha256()
    stamps: dict[str, Stamp] = {}
    unread: dict[str, str] = {}
    batch: list[Entry] = []
    sent_s = time.monotonic()
    for path, stamp in walk(directory, unread=unread):
        left_bytes -= stamp[2] if stat.S_ISREG(stamp[0]) else 0
        if left_bytes < 0:
            text = f"{directory} holds more than {request.arguments['bytes_max']} bytes"
            raise HelperRefusal("data", text, "look at it there")
        entry = yield from _described(directory, path, stamp)
        stamps[path] = stamp
        digest.update(entry_line(entry))
        batch.append(entry)
        if len(batch) >= BATCH_FILES or time.monotonic() - sent_s > BATCH_S:
            yield AnswerPiece(value={"files": batch})
            batch, sent_s = [], time.monotonic()
    for path, reason in unread.items():
        batch.append({"path": path, "bytes": 0, "mtime_s": 0, "error": reason})
        digest.update(entry_line(batch[-1]))
    name = digest.hexdigest()
    while len(_listings) >= LISTINGS_MAX:
        del _listings[next(iter(_listings))]
    _listings[directory, name] = stamps
    yield AnswerPiece(value={"files": batch, "sha256": name})


def entry_line(entry: Entry) -> bytes:
    """Return the bytes of an entry that go into the hash of a manifest."""
    return json.dumps(entry, sort_keys=True, separators=(",", ":")).encode() + b"\n"


@verb("fetch")
def fetch(request: VerbRequest) -> Iterator[AnswerPiece]:
    """Send files, each as [path, first byte, end], in pieces; one that cannot be read does not stop the others."""
    directory, pace = path_of(request, "directory"), PackingTrial()
    for index, (path, offset, end) in enumerate(request.arguments["files"]):
        try:
            whole = os.path.join(directory, path)
            yield from _pieces(index, whole, pace, offset=int(offset), end=int(end))
        except OSError as error:
            yield AnswerPiece(value={"file": index, "error": error.strerror or str(error)})


@verb("release")
def release(request: VerbRequest) -> dict[str, bool]:
    """Delete a directory, if it is still what the manifest of this hash says and nothing of the run lives."""
    directory, state = path_of(request, "directory"), path_of(request, "state")
    listed = _listings.get((directory, str(request.arguments["manifest_sha256"])))
    if listed is None:
        raise HelperRefusal("data", f"{directory}: asked to release what was not listed")
    wait_for_end(directory, state, 0.0)
    if not is_folder(directory):
        return {"released": False}
    now = dict(walk(directory))
    if now != listed:
        differing = sorted(
            path for path in now.keys() | listed.keys() if now.get(path) != listed.get(path)
        )
        raise HelperRefusal(
            "data",
            f"{directory}: {len(differing)} files changed since they were listed, such as {differing[0]!r}",
            "repeat the command",
        )
    remove(directory)
    return {"released": True}


@verb("inventory_runs")
def inventory_runs(request: VerbRequest) -> list[Entry]:
    """Return what lies in the folder of all runs: name, bytes, files, newest change, and what of it lives."""
    folder, state = path_of(request, "runs"), path_of(request, "state")
    if not is_folder(folder):
        return []
    found = []
    for name in sorted(os.listdir(folder)):
        directory = os.path.join(folder, name)
        with contextlib.suppress(FileNotFoundError):  # another operator has just collected it
            if stat.S_ISDIR(os.lstat(directory).st_mode):
                living = find_living(directory, state)
                found.append({"name": name, **measured(directory), "living": living})
    return found


def measured(directory: str) -> Entry:
    """
    Return how much a directory holds, and when it was last changed, s since 1970.

    Others may delete from it meanwhile: what is gone counts no more.

    Raises:
        FileNotFoundError: It is gone itself.
    """
    stamps = [stamp for _, stamp in walk(directory, passes_gone=True)]
    itself_ns = os.stat(directory).st_mtime_ns
    newest_ns = max((stamp[3] for stamp in stamps), default=itself_ns)
    return {
        "bytes": sum(stamp[2] for stamp in stamps),
        "files": len(stamps),
        "newest_s": newest_ns // 1_000_000_000,
    }


def is_folder(path: str) -> bool:
    """
    Tell whether *path* is a directory itself, and no link to one; one that cannot be read counts as one.

    Raises:
        Refusal: It is something else.
    """
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return False
    except OSError:
        return True
    if stat.S_ISDIR(mode):
        return True
    raise HelperRefusal(
        "data", f"{path}: expected a directory, found {kind_of(mode)}", "look at it there"
    )


def walk(
    directory: str, *, unread: dict[str, str] | None = None, passes_gone: bool = False
) -> Iterator[tuple[str, Stamp]]:
    """
    Yield whatever is no directory below one, in the order of names, and its stamp.

    Sockets, at which processes wait for their operator, hold nothing and are passed over: a power cut leaves them.

    Args:
        directory: Where to begin.
        unread: Takes what cannot be read, with the reason; None: such an error is raised.
        passes_gone: Whether what has gone since its folder was read is passed over, and no error.
    """

    def skip(error: OSError, mark: str = "/") -> None:
        if passes_gone and isinstance(error, FileNotFoundError):
            return
        if unread is None:
            raise error
        path = os.path.relpath(error.filename or directory, directory)
        unread[path + mark] = error.strerror or str(error)

    count = 0
    for folder, folders, names in os.walk(directory, onerror=skip):
        folders.sort()
        links = [name for name in folders if os.path.islink(os.path.join(folder, name))]
        for name in sorted([*names, *links]):
            path = os.path.join(folder, name)
            count += 1
            if count + len(unread or ()) > FILES_MAX:
                raise HelperRefusal("data", f"{directory}: expected at most {FILES_MAX} files")
            try:
                found = os.lstat(path)
            except OSError as error:
                skip(error, "")
                continue
            if stat.S_ISSOCK(found.st_mode):
                continue
            yield os.path.relpath(path, directory), _stamp(found)


def remove(directory: str) -> None:
    """
    Delete a directory so that it is there in full or not at all under its name, also after a power cut.

    One that is gone already, as by another operator's wiping, is no error.
    """
    parent, name = os.path.split(directory.rstrip("/"))
    away = os.path.join(parent, f"{RELEASED_PREFIX}{name}-{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        os.rename(directory, away)
    sync_folder(parent)
    sweep(directory)


def sweep(directory: str) -> None:
    """Delete what was on its way out when an earlier deletion of this directory was cut."""
    parent, name = os.path.split(directory.rstrip("/"))
    for left in os.listdir(parent) if os.path.isdir(parent) else ():
        if left.startswith(f"{RELEASED_PREFIX}{name}-"):
            _delete(os.path.join(parent, left))


def _delete(path: str) -> None:
    """Delete a folder, from which somebody else may delete as well."""
    for tries_left in reversed(range(DELETE_TRIES_MAX)):
        try:
            shutil.rmtree(path)
        except FileNotFoundError:
            if tries_left == 0 and os.path.lexists(path):
                raise
        if not os.path.lexists(path):
            return


def kind_of(mode: int) -> str:
    """Return what a file that is none is."""
    kinds = {
        stat.S_IFLNK: "a link",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFDIR: "a directory",
    }
    return kinds.get(stat.S_IFMT(mode), "a file" if stat.S_ISREG(mode) else "a device")


def _described(directory: str, path: str, stamp: Stamp) -> Generator[AnswerPiece, None, Entry]:
    """Return the entry of a file; of a large one, signs of life on the way."""
    mode, _, size_bytes, mtime_ns, _ = stamp
    entry: Entry = {"path": path, "bytes": size_bytes, "mtime_s": mtime_ns // 1_000_000_000}
    if not stat.S_ISREG(mode):
        return {**entry, "bytes": 0, "kind": kind_of(mode)}
    whole = os.path.join(directory, path)
    digest, sent_s = hashlib.sha256(), time.monotonic()
    try:
        with open(whole, "rb", buffering=0, opener=no_links) as file:
            left_bytes = size_bytes
            while left_bytes > 0 and (data := file.read(min(READ_BYTES, left_bytes))):
                digest.update(data)
                left_bytes -= len(data)
                if time.monotonic() - sent_s > BATCH_S:
                    yield AnswerPiece(value={"reading": path})
                    sent_s = time.monotonic()
            after = _stamp(os.fstat(file.fileno()))
    except OSError as error:
        return {**entry, "error": error.strerror or str(error)}
    if after != stamp:
        raise HelperRefusal(
            "busy", f"{whole} changed while it was read", "something writes there; see what it is"
        )
    return {**entry, "sha256": digest.hexdigest()}


class PackingTrial:
    """
    Finds out whether packing speeds a transfer up, by trying both ways in turn for some pieces each.

    It does over a slow link, or when many machines send at once. It does not on a board whose processor
    is slower than its network.
    """

    TRIED_PIECES = 16
    """More than the buffers on the way hold, which would hide a way's true cost."""
    SETTLED_PIECES = 160
    """After so many both are tried anew."""

    def __init__(self) -> None:
        self.packs = True
        self._spent_s = {True: 0.0, False: 0.0}
        self._pieces = 0

    def sent(self, duration_s: float) -> None:
        """Take how long a piece took, from when it was wanted to when the next one was."""
        self._pieces += 1
        if self._pieces <= 2 * self.TRIED_PIECES:
            self._spent_s[self.packs] += duration_s
        if self._pieces == self.TRIED_PIECES:
            self.packs = False
        elif self._pieces == 2 * self.TRIED_PIECES:
            self.packs = self._spent_s[True] < self._spent_s[False]
        elif self._pieces == self.SETTLED_PIECES:
            self.packs, self._pieces = True, 0
            self._spent_s = {True: 0.0, False: 0.0}


def _pieces(
    index: int, path: str, pace: PackingTrial, *, offset: int, end: int
) -> Iterator[AnswerPiece]:
    is_packable = True
    with open(path, "rb", buffering=0, opener=no_links) as file:
        file.seek(offset)
        while offset < end:
            start_s = time.monotonic()
            data = file.read(min(PIECE_BYTES, end - offset))
            if not data:
                text = f"it ends at byte {offset}, expected {end}"
                yield AnswerPiece(value={"file": index, "error": text})
                return
            body, packed = data, False
            if is_packable and pace.packs:
                body, packed = zlib.compress(data, LEVEL), True
                if len(body) > PACKED_SHARE_MAX * len(data):
                    is_packable, packed, body = False, False, data
            value = {"file": index, "offset": offset, "bytes": len(data), "packed": packed}
            yield AnswerPiece(value=value, body=body)
            offset += len(data)
            if is_packable:
                pace.sent(time.monotonic() - start_s)


def _stamp(found: os.stat_result) -> Stamp:
    return (found.st_mode, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
