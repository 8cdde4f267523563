"""The manifest: every file of a run with its size and hash, and what its records lost."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.rundir import RESERVE_NAME, SCHEMA, RunDirectory
from cosmos_cli.streams import StreamScan

MANIFEST_NAME = "manifest.json"


def run_files(run: RunDirectory) -> Iterator[Path]:
    """Yield the files that are evidence, in the order of their names; no reserve, nothing half-written."""
    for path in sorted(run.path.rglob("*")):
        if path.is_symlink() or not path.is_file():
            continue
        if path.name == RESERVE_NAME or path.name.endswith(".part"):
            continue
        yield path


def build_manifest(
    run: RunDirectory,
    scans: Mapping[Path, StreamScan],
    was: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """
    Return the manifest of all files but itself.

    Args:
        run: The run.
        scans: What was found in each stream file; it holds the hash already.
        was: First entries of files that are no longer what they were, or are gone.
    """
    files: dict[str, Any] = {}
    for path in run_files(run):
        name = path.relative_to(run.path).as_posix()
        if name == MANIFEST_NAME:
            continue
        scan = scans.get(path)
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
