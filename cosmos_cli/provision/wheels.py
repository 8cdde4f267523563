"""The cache of wheels on this computer: each in a folder named after its hash, shared by runs and processes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import replace
from email.parser import HeaderParser
from pathlib import Path

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision import resolver
from cosmos_cli.provision.lock import Chosen, Locked
from cosmos_cli.provision.platform import Platform
from cosmos_cli.provision.trees import Progress

UNUSED_S_MAX = 90 * 86_400.0
"""What nobody has asked for in so long is not kept."""
MAKING_S_MAX = 86_400.0
"""What belongs to nothing may be younger: somebody is just downloading it."""


def wheel_path(folder: Path, locked: Locked) -> Path:
    """Return where a wheel is, below the folder of all."""
    return folder / locked.sha256 / locked.filename


def lacking(wheels: Sequence[Locked], folder: Path) -> list[Locked]:
    """Return the wheels that are not there, or not of their size."""
    found = []
    for wheel in wheels:
        try:
            size_bytes = wheel_path(folder, wheel).stat().st_size
        except FileNotFoundError:
            size_bytes = -1
        if size_bytes < 0 or wheel.size_bytes not in (0, size_bytes):
            found.append(wheel)
    return found


def fetch(
    chosen: Sequence[Chosen], folder: Path, platform: Platform, progress: Progress
) -> tuple[Locked, ...]:
    """
    Return wheels with their sizes; those that are not there are downloaded, verified, and kept.

    Raises:
        MachineFailure: The index cannot be reached, or gives something else.
    """
    gone = lacking([each.locked for each in chosen], folder)
    wanted = [each for each in chosen if each.locked in gone]
    if wanted:
        progress(f"downloading {len(wanted)} wheels for {platform.label}", 0.5)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".new-", dir=folder) as private:
            resolver.download(wanted, Path(private), platform)
            for each in wanted:
                _keep(Path(private, each.locked.filename), each.locked, folder)
    return tuple(_sized(each.locked, wheel_path(folder, each.locked)) for each in chosen)


def see_verified(path: Path, locked: Locked) -> None:
    """
    Read a wheel before it is sent; once for all machines.

    Raises:
        MachineFailure: It is no longer what was downloaded. It is thrown away, so that it is fetched anew.
    """
    try:
        is_verified = _has_hash(path, locked.sha256, path.stat().st_mtime_ns)
    except FileNotFoundError:
        is_verified = False
    if not is_verified:
        path.unlink(missing_ok=True)
        raise MachineFailure(
            FailureKind.DATA,
            f"{path} on this computer is not what was downloaded; it was removed",
            "repeat: it is downloaded again",
        )


def requirements_of(path: Path) -> list[str]:
    """Return what a wheel says that it needs."""
    with zipfile.ZipFile(path) as wheel:
        for name in wheel.namelist():
            if name.endswith(".dist-info/METADATA"):
                metadata = HeaderParser().parsestr(wheel.read(name).decode())
                return [str(text) for text in metadata.get_all("Requires-Dist", [])]
    return []


def remove_unused(cache: Path, *, now_s: float) -> None:
    """
    Remove what was not used for UNUSED_S_MAX, the wheels that nothing else needs, and what was left half made.

    Args:
        cache: With the folders "locks" and "wheels".
        now_s: By the wall clock.
    """
    needed: set[str] = set()
    for path in (cache / "locks").glob("*.json"):
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            if now_s - path.stat().st_mtime > UNUSED_S_MAX:
                path.unlink()
                path.with_suffix(".lock").unlink(missing_ok=True)
            else:
                needed |= {wheel["sha256"] for wheel in json.loads(path.read_bytes())["wheels"]}
    for path in (cache / "wheels").glob("*"):
        with contextlib.suppress(OSError):
            if path.name not in needed and now_s - path.stat().st_mtime > MAKING_S_MAX:
                shutil.rmtree(path)


def _keep(downloaded: Path, locked: Locked, folder: Path) -> None:
    try:
        with downloaded.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            os.fsync(file.fileno())
    except FileNotFoundError:
        sha256 = ""
    if sha256 != locked.sha256:
        raise MachineFailure(
            FailureKind.DATA,
            f"{locked.filename}: what the package index gave is not what it announced",
            "repeat; if that does not help, the index or a proxy before it is broken",
        )
    path = wheel_path(folder, locked)
    path.parent.mkdir(exist_ok=True)
    downloaded.replace(path)


def _sized(locked: Locked, path: Path) -> Locked:
    with zipfile.ZipFile(path) as wheel:
        installed_bytes = sum(entry.file_size for entry in wheel.infolist())
    size_bytes = path.stat().st_size
    return replace(locked, size_bytes=size_bytes, installed_bytes=installed_bytes)


@functools.lru_cache(maxsize=256)
def _has_hash(path: Path, sha256: str, _changed_ns: int) -> bool:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == sha256
