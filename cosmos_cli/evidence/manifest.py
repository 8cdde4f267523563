"""
All files of a run: the manifest, which tells size, hash and losses of each, and the package, which holds them.

The package is one .tar.zst beside the run's directory, the same bytes for the same files.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import os
import shlex
import tarfile
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

import zstandard

from cosmos_cli.evidence.run_directory import RESERVE_NAME, SCHEMA, RunDirectory
from cosmos_cli.evidence.streams import StreamScan
from madns_runtime.bounded_files import open_regular_file
from madns_runtime.partial_file import partial_file
from madns_runtime.recording.access import file_mode

MANIFEST_NAME = "manifest.json"
PATH_BYTES_MAX = 4096
"""Bytes of a path that the system takes, its end mark included."""
COMPRESSION_LEVEL = 3


def run_files(run: RunDirectory, without: Container[Path] = ()) -> Iterator[Path]:
    """Yield the files that are evidence, in the order of their names; no reserve, nothing half-written."""
    for path in sorted(path for path, error in _below(run.path) if error is None):
        is_left_out = path in without or path.name == RESERVE_NAME or path.name.endswith(".part")
        if os.path.isfile(path) and not path.is_symlink() and not is_left_out:
            yield path


def unreadable_places(run: RunDirectory) -> dict[Path, OSError]:
    """Return the folders of a run that cannot be listed, files whose names are too long, and of each why."""
    return {path: error for path, error in _below(run.path) if error is not None}


def _below(folder: Path) -> Iterator[tuple[Path, OSError | None]]:
    """Yield what lies below and is no folder, and what cannot be looked at; however deep, and through no link."""
    waiting = [folder]
    while waiting:
        here = waiting.pop()
        try:
            # Its names may be listed, and nothing of them be looked at.
            os.stat(os.path.join(here, "."))
            with os.scandir(here) as entries:
                for entry in entries:
                    path = Path(entry.path)
                    is_long = len(os.fsencode(path)) >= PATH_BYTES_MAX
                    if entry.is_dir(follow_symlinks=False) and not is_long:
                        waiting.append(path)
                    elif is_long:
                        yield path, OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
                    else:
                        yield path, None
        except OSError as error:
            yield here, error


def build_manifest(
    run: RunDirectory,
    scans: Mapping[Path, StreamScan],
    was: Mapping[str, Mapping[str, Any]] | None,
    *,
    without: Container[Path],
) -> dict[str, Any]:
    """
    Return the manifest of all files but itself.

    Args:
        run: The run.
        scans: What was found in each stream file; it holds the hash already.
        was: First entries of files that are no longer what they were, or are gone.
        without: Files that are not read.
    """
    files: dict[str, Any] = {}
    for path in run_files(run, without):
        scan = scans.get(path)
        if path != run.manifest_json:
            name = path.relative_to(run.path).as_posix()
            files[name] = _stream_entry(scan) if scan else file_entry(path)
    for name, entry in (was or {}).items():
        files[name] = {**files.get(name, {"missing": True}), "was": entry}
    return {"schema": SCHEMA, "run": run.name, "files": files}


def file_entry(path: Path) -> dict[str, Any]:
    """Return the entry of a file that is no stream: size and hash."""
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return {"bytes": stream.tell(), "sha256": digest}


def _stream_entry(scan: StreamScan) -> dict[str, Any]:
    return {
        "bytes": scan.size_bytes,
        "sha256": scan.sha256,
        "records": scan.records,
        "lost": scan.lost,
        "dropped": scan.dropped,
        "damaged": scan.damaged,
        "truncated": scan.truncated,
        "closed": scan.promised is not None,
    }


def pack_run(run: RunDirectory, mtime_s: int, *, without: Container[Path] = ()) -> Path:
    """
    Package all evidence of a run; the package appears under its name when it is whole.

    Args:
        run: The run; nobody else packs it meanwhile (`alone`).
        mtime_s: Time that every member carries, s since 1970: the run's start, so that packing
            twice gives the same bytes.
        without: Files that are left out.

    Raises:
        OSError: The package cannot be written.
    """
    compressor = zstandard.ZstdCompressor(level=COMPRESSION_LEVEL, write_checksum=True)
    mode = file_mode(run.access)
    with (
        partial_file(run.bundle, mode=mode, takes_over=True) as raw,
        compressor.stream_writer(raw, closefd=False) as packed,
        tarfile.open(fileobj=packed, mode="w|", format=tarfile.PAX_FORMAT) as archive,
    ):
        for path in run_files(run, without):
            name = f"{run.name}/{path.relative_to(run.path).as_posix()}"
            member = tarfile.TarInfo(name)
            member.mtime, member.mode = mtime_s, mode
            with path.open("rb") as stream:
                member.size = os.fstat(stream.fileno()).st_size
                archive.addfile(member, stream)
    return run.bundle


def first_still_packed(run: RunDirectory, entries: Mapping[str, Mapping[str, Any]]) -> str:
    """
    Return the name within the package of the first file that is there as its entry says; empty if none is.

    Args:
        run: The run; it may have no package.
        entries: Of the manifest, by the names of files below the run's directory.
    """
    if not entries:
        return ""
    # A package that is cut or damaged holds what comes before.
    with (
        contextlib.suppress(OSError, EOFError, tarfile.TarError, zstandard.ZstdError),
        os.fdopen(open_regular_file(run.bundle), "rb") as raw,
        zstandard.ZstdDecompressor().stream_reader(raw) as packed,
        tarfile.open(fileobj=packed, mode="r|") as archive,
    ):
        for member in archive:
            entry = entries.get(member.name.partition("/")[2], {})
            content = archive.extractfile(member) if entry else None
            if isinstance(content, io.BufferedReader):
                digest = hashlib.file_digest(content, "sha256").hexdigest()
                if digest == entry.get("sha256"):
                    return member.name
    return ""


def told_as_kept(run: RunDirectory, member: str) -> str:
    """Return why the package of a run was not written anew, and how a member that it alone holds is brought back."""
    bundle = shlex.quote(str(run.bundle))
    return (
        f"{run.bundle}: left as it was, for it holds what is no longer here as it was collected; bring that back, then"
        f" repeat: tar -xf {bundle} -C {run.shell_path} --strip-components=1 {shlex.quote(member)}; to give it up,"
        " remove the package first"
    )
