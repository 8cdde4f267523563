"""The package of a run: one .tar.zst beside its directory, the same bytes for the same files."""

from __future__ import annotations

import contextlib
import os
import tarfile
from pathlib import Path

import zstandard

from cosmos_cli.manifest import run_files
from cosmos_cli.rundir import RunDirectory

LEVEL = 3
FILE_MODE = 0o644


def pack_run(run: RunDirectory, mtime_s: int) -> Path:
    """
    Package all evidence of a run; the package appears under its name when it is whole.

    Args:
        run: The run; nobody else packs it meanwhile (`alone`).
        mtime_s: Time that every member carries, s since 1970: the run's start, so that packing
            twice gives the same bytes.

    Raises:
        OSError: The package cannot be written.
    """
    # Always the same name: what a killed one left is taken by the next.
    partial = run.bundle.with_name(f".{run.bundle.name}.part")
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
    try:
        with partial.open("wb") as raw:
            with (
                compressor.stream_writer(raw, closefd=False) as packed,
                tarfile.open(fileobj=packed, mode="w|", format=tarfile.PAX_FORMAT) as archive,
            ):
                for path in run_files(run):
                    _add(archive, run, path, mtime_s)
            raw.flush()
            os.fsync(raw.fileno())
        partial.replace(run.bundle)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
    return run.bundle


def _add(archive: tarfile.TarFile, run: RunDirectory, path: Path, mtime_s: int) -> None:
    member = tarfile.TarInfo(f"{run.name}/{path.relative_to(run.path).as_posix()}")
    member.mtime, member.mode = mtime_s, FILE_MODE
    with path.open("rb") as stream:
        member.size = os.fstat(stream.fileno()).st_size
        archive.addfile(member, stream)
