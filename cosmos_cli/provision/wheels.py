"""
The cache of wheels on this computer: each in a folder named after its hash, shared by runs and processes.

    <cache>/wheels/<sha256>/<wheel>      those of the index, and of one's own
    <cache>/built/<tree hash>            which wheel was built of a folder: built once, until a file of it changes

A scenario names distributions of one's own by path: a wheel file, or a folder that a wheel is built of. Such a
requirement is written `name @ file:///...` from here on.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import json
import os
import shutil
import stat
import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from email.parser import HeaderParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

from packaging.requirements import Requirement

from cosmos_cli.cache import CACHE_VARIABLE, cache_folder
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.text_forms import is_own_requirement
from cosmos_cli.provision import resolver
from cosmos_cli.provision.lock import Chosen, Locked, normal_name
from cosmos_cli.provision.platform import Platform
from cosmos_cli.provision.trees import Progress, folder_tree
from cosmos_cli.system.bounded_process import run_bounded
from cosmos_cli.system.ownership import read_own_file
from cosmos_cli.ui.step_times import HERE, timed
from madns_runtime.bounded_files import read_regular_file, real_path
from madns_runtime.partial_file import write_whole

UNUSED_S_MAX = 90 * 86_400.0
"""Age at which a wheel that nobody asks for is deleted."""
MAKING_S_MAX = 86_400.0
"""Age below which a file that belongs to nothing stays: somebody is just downloading it."""
WHEEL_BYTES_MAX = 256 * 1024 * 1024
BUILD_TIMEOUT_S = 600.0
LAST_LINES = 8
PROGRAM_MODE = 0o755
NOTE_BYTES_MAX = 4096
SCHEME = "file://"
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors of a write, which names no file."""


@contextlib.contextmanager
def cache_failures() -> Iterator[None]:
    """
    Turn what the operator's system says of the cache into a failure of this computer.

    Raises:
        MachineFailure: The cache cannot be read or written, or its disk is full.
    """
    try:
        yield
    except OSError as error:
        folder = cache_folder()
        path = (
            Path(os.fsdecode(error.filename)) if isinstance(error.filename, str | bytes) else None
        )
        if error.errno not in DISK_ERRORS and not (path and path.is_relative_to(folder)):
            raise
        raise MachineFailure(
            FailureKind.STEP,
            f"the cache of this computer, {path or folder}: {error.strerror}",
            f"make room for it or let this user write there, or name another folder with {CACHE_VARIABLE}",
        ) from error


def wheel_path(folder: Path, locked: Locked) -> Path:
    """Return where a wheel is, below the folder of all."""
    return folder / locked.sha256 / locked.filename


def lacking(wheels: Sequence[Locked], folder: Path) -> list[Locked]:
    """Return the wheels that are not there, or not of their size."""
    return [wheel for wheel in wheels if not _is_there(wheel_path(folder, wheel), wheel)]


def fetch(
    chosen: Sequence[Chosen], folder: Path, platform: Platform, progress: Progress
) -> tuple[Locked, ...]:
    """
    Return wheels with their sizes; those that are not there are downloaded, verified, and kept.

    Nothing that is remembered needs them yet: until then they are kept from other commands that clear the cache.

    Raises:
        MachineFailure: The index cannot be reached, or gives something else.
    """
    for each in chosen:
        _spare(wheel_path(folder, each.locked).parent)
    wanted = [each for each in chosen if lacking([each.locked], folder)]
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
        MachineFailure: It is gone, or no longer what was downloaded. It is thrown away, so that it is fetched anew.
    """
    try:
        is_verified = _has_hash(path, locked.sha256, path.stat().st_mtime_ns)
    except FileNotFoundError:
        text = f"{path} is gone: another command may have cleared the cache of this computer"
        raise MachineFailure(FailureKind.DATA, text, "repeat: it is downloaded again") from None
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
            if name.endswith(".dist-info/METADATA") and name.count("/") == 1:
                metadata = HeaderParser().parsestr(wheel.read(name).decode())
                return [str(text) for text in metadata.get_all("Requires-Dist", [])]
    return []


def with_own_wheels(
    requirements: Sequence[str], folder: Path, say: Callable[[str], None] = lambda text: None
) -> tuple[str, ...]:
    """
    Return requirements in which every path has become the wheel that stands for it, in the cache.

    Args:
        requirements: Of a scenario.
        folder: Its folder, from which paths are found.
        say: Told what is built, before it is: that may take long.

    Raises:
        InputError: There is no such thing, it is no wheel, or none can be built of it.
    """
    return tuple(
        _wheel_of(folder / text, text, say) if is_own_requirement(text) else text
        for text in requirements
    )


def is_own_wheel(requirement: str) -> bool:
    """Tell whether a requirement is one that `with_own_wheels` has written."""
    return f" @ {SCHEME}" in requirement


def own_wheel(requirement: str) -> tuple[Locked, Path]:
    """Return the wheel that a requirement of `with_own_wheels` means, and where it is."""
    path = Path(unquote(urlsplit(requirement.partition(" @ ")[2]).path))
    name, version = path.name.split("-")[:2]
    locked = Locked(
        name=normal_name(name), version=version, sha256=path.parent.name, filename=path.name
    )
    return _sized(locked, path), path


def remove_unused(cache: Path, *, now_s: float) -> None:
    """
    Remove what was not used for UNUSED_S_MAX, the wheels that nothing else needs, and what was left half made.

    Args:
        cache: With the folders "locks", "wheels" and "built".
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
    for note in (cache / "built").glob("*"):
        with contextlib.suppress(OSError):
            if now_s - note.stat().st_mtime > UNUSED_S_MAX:
                note.unlink()
    for path in (cache / "wheels").glob("*"):
        with contextlib.suppress(OSError):
            if path.name not in needed and now_s - path.stat().st_mtime > MAKING_S_MAX:
                shutil.rmtree(path)


def _spare(path: Path) -> None:
    """Make a wheel's folder, or a note, one that somebody is just using, for `remove_unused` of other commands."""
    with contextlib.suppress(OSError):  # not there yet, or another user's
        os.utime(path)


def _is_there(path: Path, locked: Locked) -> bool:
    try:
        size_bytes = path.stat().st_size
    except FileNotFoundError:
        return False
    return locked.size_bytes in (0, size_bytes)


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


def _wheel_of(path: Path, text: str, say: Callable[[str], None]) -> str:
    path = real_path(path)
    kept = _kept_of_folder(path, text, say) if path.is_dir() else _keep_own(path, text)
    name = kept.name.split("-")[0].replace("_", "-")
    return f"{name} @ {kept.as_uri()}"


def _kept_of_folder(folder: Path, text: str, say: Callable[[str], None]) -> Path:
    tree = folder_tree(f"requirement {text}", folder)
    note = cache_folder() / "built" / tree.hash
    try:
        kept = Path(read_own_file(note, bytes_max=NOTE_BYTES_MAX).decode())
        _spare(kept.parent)
        if kept.is_file():
            _spare(note)
            return kept
    except (OSError, ValueError):
        pass  # never built, forgotten, or damaged; or another user laid it there
    with tempfile.TemporaryDirectory(prefix="cosmos-build-") as private:
        # What a build leaves beside its sources must not make another tree of them.
        source, made = Path(private, "source"), Path(private, "made")
        for file in tree.files:
            target = source / file.path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read())
            if file.mode & stat.S_IXUSR:
                target.chmod(PROGRAM_MODE)
        say(f"building a wheel of {text}")
        with timed(HERE, f"build a wheel of {text}"):
            wheel = _built(source, made, text)
        kept = _keep_own(wheel, text)
    with _own_failures(text):
        note.parent.mkdir(parents=True, exist_ok=True)
        write_whole(note, str(kept).encode())
    return kept


def _built(source: Path, made: Path, text: str) -> Path:
    command = [
        *resolver.PIP,
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(made),
        str(source),
    ]
    try:
        done = run_bounded(command, timeout_s=BUILD_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise InputError(
            f"requirements: {text}: no wheel was built within {BUILD_TIMEOUT_S:g} s; see what it waits for"
            f" with: pip wheel --no-deps {text}, or build the wheel elsewhere and name its file instead"
        ) from None
    wheels = sorted(made.glob("*.whl"))
    if done.returncode or len(wheels) != 1:
        last = " | ".join(done.stderr.strip().splitlines()[-LAST_LINES:])
        raise InputError(
            f"requirements: {text}: no wheel can be built of it: {last or 'pip said nothing'};"
            f" try: pip wheel --no-deps {text}"
        )
    return wheels[0]


def _keep_own(path: Path, text: str) -> Path:
    """Put a wheel beside those of the index, under its hash."""
    try:
        content = read_regular_file(path, bytes_max=WHEEL_BYTES_MAX)
    except OSError as error:
        raise InputError(f"requirements: {text}: {error.strerror or error}") from error
    kept = cache_folder() / "wheels" / hashlib.sha256(content).hexdigest() / path.name
    _spare(kept.parent)
    if not kept.is_file() or kept.stat().st_size != len(content):
        if not zipfile.is_zipfile(path):
            raise InputError(f"requirements: {text}: expected a wheel, got another kind of file")
        _check_metadata(path, text)
        with _own_failures(text):
            kept.parent.mkdir(parents=True, exist_ok=True)
            write_whole(kept, content)
    return kept


def _check_metadata(path: Path, text: str) -> None:
    """Refuse a wheel of which nobody could say what it needs, before any machine is worked on."""
    try:
        for requirement in requirements_of(path):
            Requirement(requirement)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(
            f"requirements: {text}: what it needs cannot be read of its METADATA ({reason});"
            " build the wheel anew"
        ) from error


@contextlib.contextmanager
def _own_failures(text: str) -> Iterator[None]:
    """Tell of a cache that takes no wheel before any machine is worked on."""
    try:
        with cache_failures():
            yield
    except MachineFailure as failure:
        raise InputError(f"requirements: {text}: {failure}") from failure
