"""
Code and scenario files as trees: known by the hash of their content, sent once, never changed there.

A tree on a machine is a folder named after the hash of what is in it. Of a tree that is not there yet
only those files are sent whose content no tree there has: one edited file is one file sent.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import io
import os
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import madns_runtime
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.provision.tree_rules import walk
from madns_runtime.bounded_files import open_regular_file, read_regular_file

if TYPE_CHECKING:  # importing the scenario's model takes longer than all that is done with it here
    from cosmos_cli.models.loading import ScenarioFile

DISTRIBUTION = "cosmos-madns"
FILES_MAX = 5_000
TREE_BYTES_MAX = 256 * 1024 * 1024
BATCH_BYTES = 4 * 1024 * 1024
"""Bytes of content per frame: what is in it is compressed as one, and a larger file comes in several."""
COMPRESSION_LEVEL = 6
SAMPLE_BYTES = 65_536
DENSE_SHARE = 0.9
"""Share of its size that content keeps when it is sent as it is: each machine's copy costs processor time here."""
ROUNDS_MAX = 3
"""Another operator who assembles the same tree at the same time may take what was just sent."""
ASSEMBLE_TIMEOUT_S = 120.0
LARGEST_SHOWN = 3
FILE_MODE, PROGRAM_MODE = 0o444, 0o555

Progress = Callable[[str, float], None]
"""Takes what is being done and how far it is, from 0 to 1."""


def no_progress(_what: str, _share: float) -> None:
    """Tell nobody."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TreeFile:
    """One file of a tree."""

    path: str
    """Within the tree, with slashes."""
    sha256: str
    mode: int
    """0o555 for a program, 0o444 for any other file: nobody changes a tree."""
    size_bytes: int
    source: Path | bytes = field(repr=False)
    """Path of its content here, or the content itself."""

    def read(self) -> bytes:
        """
        Return its content.

        Raises:
            MachineFailure: It is no longer what it was when the tree was made.
        """
        return b"".join(self.pieces(BATCH_BYTES))

    def pieces(self, bytes_max: int) -> Iterator[bytes]:
        """
        Yield its content in pieces, the last one when all of it is known to be right.

        Raises:
            MachineFailure: As `read`.
        """
        digest, left_bytes = hashlib.sha256(), self.size_bytes
        try:
            with self._opened() as stream:
                while piece := stream.read(min(left_bytes, bytes_max)):
                    left_bytes -= len(piece)
                    digest.update(piece)
                    if not left_bytes:
                        break
                    yield piece
                is_right = not stream.read(1) and digest.hexdigest() == self.sha256
        except OSError:  # it is gone, or a pipe has taken its place
            is_right = False
        if not is_right:
            raise MachineFailure(
                FailureKind.DATA,
                f"{self.source!s} was changed or removed while it was sent",
                "repeat",
            )
        yield piece

    def _opened(self) -> BinaryIO:
        if isinstance(self.source, bytes):
            return io.BytesIO(self.source)
        return os.fdopen(open_regular_file(self.source), "rb")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tree:
    """Files that belong together; made by `tree_of`."""

    label: str
    """Description in words; no part of the hash."""
    hash: str
    files: tuple[TreeFile, ...]

    @property
    def size_bytes(self) -> int:
        """Return the size of all files."""
        return sum(file.size_bytes for file in self.files)


def tree_of(label: str, files: Sequence[TreeFile]) -> Tree:
    """Return a tree of these files, in the order of their paths."""
    ordered = tuple(sorted(files, key=lambda file: file.path))
    lines = (
        f"{'x' if file.mode & stat.S_IXUSR else '-'} {file.sha256} {file.path}\n"
        for file in ordered
    )
    digest = hashlib.sha256("".join(lines).encode())
    return Tree(label=label, hash=digest.hexdigest(), files=ordered)


@functools.lru_cache(maxsize=1)
def runtime_tree() -> Tree:
    """
    Return the package `madns_runtime` as it is installed here.

    With what the distribution says of itself, so that there too simulations are found by name.
    """
    package = Path(madns_runtime.__file__).parent
    files = [
        read_tree_file(path, f"{package.name}/{name}")
        for path, name in walk(package)
        if name.endswith((".py", ".json", "py.typed")) or "/data/" in f"/{name}"
    ]
    return tree_of("runtime", [*files, *_distribution_files()])


def scenario_tree(scenario_file: ScenarioFile) -> Tree:
    """
    Return the scenario's folder: what its files name, and its plug-ins with their neighbours.

    Hidden files, caches, virtual environments, runs, COSMoS's own state and empty folders are left out, and so are links
    to such. A link to a file or folder within is sent as what it leads to.

    Raises:
        InputError: The folder is larger than a scenario's should be, or has another link that leads outside.
    """
    return folder_tree(f"scenario {scenario_file.scenario.name}", scenario_file.base_directory)


def folder_tree(label: str, folder: Path) -> Tree:
    """
    Return what is in a folder, but for what `scenario_tree` leaves out.

    Raises:
        InputError: As `scenario_tree`.
    """
    found = []
    total_bytes = 0
    for path, name in walk(folder):
        found.append((path, name))
        total_bytes += _size_bytes(path)
        if len(found) > FILES_MAX or total_bytes > TREE_BYTES_MAX:
            raise _too_large(folder, found)
    return tree_of(label, [read_tree_file(*each) for each in found])


def send_tree(helper: Helper, layout: Layout, tree: Tree, progress: Progress = no_progress) -> bool:
    """
    See that a tree is on a machine; what is there already is verified, not sent.

    Args:
        helper: Started with `cosmos_cli.provision.STORE_PARTS`.
        layout: Of the machine.
        tree: What is wanted.
        progress: Told while files are sent.

    Returns:
        Whether anything was changed there.

    Raises:
        MachineFailure: The connection is lost, its disk is full or read-only, or a file changed here.
    """
    asked = {
        "folder": layout.trees,
        "hash": tree.hash,
        "label": tree.label,
        "files": [[file.path, file.sha256, file.mode] for file in tree.files],
    }
    by_hash = {file.sha256: file for file in reversed(tree.files)}  # one of equal ones
    for _ in range(ROUNDS_MAX):
        told: Mapping[str, Any] = helper.call("tree", asked, timeout_s=ASSEMBLE_TIMEOUT_S).value
        if not told["missing"]:
            return bool(told["changed"])
        _send_blobs(helper, layout, [by_hash[sha256] for sha256 in told["missing"]], progress)
    raise MachineFailure(
        FailureKind.DATA,
        f"{tree.label}: files that were sent are not there ({len(told['missing'])} missing)",
        "repeat when no other command works there",
    )


def _send_blobs(
    helper: Helper, layout: Layout, files: Sequence[TreeFile], progress: Progress
) -> None:
    whole_bytes = sum(file.size_bytes for file in files)
    sent_bytes = 0
    for verb, arguments, content in _frames(files):
        helper.call(
            verb,
            {"folder": layout.trees, **arguments},
            body=_packed(content),
            timeout_s=ASSEMBLE_TIMEOUT_S,
        )
        sent_bytes += len(content)
        progress(f"files {sent_bytes / 1e6:.1f} MB", sent_bytes / max(1, whole_bytes))


def _frames(files: Sequence[TreeFile]) -> Iterator[tuple[str, Mapping[str, Any], bytes]]:
    """Yield verb, arguments and content of each frame: many small files together, a large one in pieces."""
    for batch in _batches([file for file in files if file.size_bytes <= BATCH_BYTES]):
        blobs = [[file.sha256, file.size_bytes] for file in batch]
        yield "blobs", {"blobs": blobs}, b"".join(file.read() for file in batch)
    for file in files:
        offset = 0
        for piece in file.pieces(BATCH_BYTES) if file.size_bytes > BATCH_BYTES else ():
            place = {"size": file.size_bytes, "offset": offset, "length": len(piece)}
            yield "blob", {"sha256": file.sha256, **place}, piece
            offset += len(piece)


def _packed(content: bytes) -> bytes:
    """Return content in the form of zlib; what its midst shows to be packed already is not compressed once more."""
    middle = len(content) // 2
    sample = content[middle : middle + SAMPLE_BYTES]
    is_dense = len(zlib.compress(sample, COMPRESSION_LEVEL)) > DENSE_SHARE * len(sample)
    return zlib.compress(content, 0 if is_dense else COMPRESSION_LEVEL)


def _batches(files: Sequence[TreeFile]) -> Iterator[list[TreeFile]]:
    batch: list[TreeFile] = []
    size_bytes = 0
    for file in files:
        if batch and size_bytes + file.size_bytes > BATCH_BYTES:
            yield batch
            batch, size_bytes = [], 0
        batch.append(file)
        size_bytes += file.size_bytes
    if batch:
        yield batch


def _distribution_files() -> Iterator[TreeFile]:
    """Yield the little of a .dist-info folder that an installed simulation is found by, and the version."""
    distribution = importlib.metadata.distribution(DISTRIBUTION)
    version = distribution.version
    groups: dict[str, list[str]] = {}
    for entry in sorted(distribution.entry_points, key=lambda e: (e.group, e.name)):
        if entry.value.startswith(f"{madns_runtime.__name__}."):
            groups.setdefault(entry.group, []).append(f"{entry.name} = {entry.value}")
    entries = "\n".join("\n".join([f"[{group}]", *lines, ""]) for group, lines in groups.items())
    folder = f"{DISTRIBUTION.replace('-', '_')}-{version}.dist-info"
    metadata = f"Metadata-Version: 2.1\nName: {DISTRIBUTION}\nVersion: {version}\n"
    yield _file(f"{folder}/METADATA", metadata.encode(), FILE_MODE)
    yield _file(f"{folder}/entry_points.txt", entries.encode(), FILE_MODE)


def read_tree_file(path: Path, name: str) -> TreeFile:
    """
    Return a file of this computer as *name* of a tree.

    Raises:
        InputError: It cannot be read.
    """
    try:
        content = read_regular_file(path, bytes_max=TREE_BYTES_MAX)
        is_program = bool(path.stat().st_mode & stat.S_IXUSR)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return _file(name, content, PROGRAM_MODE if is_program else FILE_MODE, path)


def _file(name: str, content: bytes, mode: int, source: Path | None = None) -> TreeFile:
    return TreeFile(
        path=name,
        sha256=hashlib.sha256(content).hexdigest(),
        mode=mode,
        size_bytes=len(content),
        source=content if source is None else source,
    )


def _size_bytes(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:  # removed since the folder was listed
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _too_large(folder: Path, found: Sequence[tuple[Path, str]]) -> InputError:
    sizes = sorted(((_size_bytes(path), name) for path, name in found), reverse=True)
    largest = ", ".join(f"{name} ({size / 1e6:.1f} MB)" for size, name in sizes[:LARGEST_SHOWN])
    return InputError(
        f"{folder}: expected a scenario's folder of at most {FILES_MAX} files and"
        f" {TREE_BYTES_MAX // (1024 * 1024)} MB, found more; the largest are {largest}; give the scenario"
        " and what it needs a folder of their own"
    )
