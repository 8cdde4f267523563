"""
Wheels as machines are sent them: without what nobody imports there, with what Python makes of their sources.

    <cache>/wheels/<sha256>/sent-<rule>-<python>/<wheel>      beside the wheel that it was made of
    <cache>/wheels/<sha256>/sent-<rule>-<python>/sent.json    its hash and size

Two thirds of the files of what the runtime requires are tests and stubs: they are unpacked, linked and looked at for
nothing. Modules travel compiled as well, when this computer's Python writes what the machine's reads: what is compiled
counts by the hash that RECORD has of it (PEP 552, unchecked), as every file of the environment is looked at before a run.
Every file is verified here by what RECORD says of it, so that a machine, which verifies the hash of the whole, need only
see that each comes out as it was packed. A wheel that is not as it should be is sent as it came, and refused there.

The same wheel packed twice has not the same bytes: what Python compiles depends on what else it has in memory. So one
command packs it while others wait, and it appears together with its note: nobody reads the one with the other's hash.
"""

from __future__ import annotations

import base64
import contextlib
import csv
import hashlib
import importlib.util
import io
import json
import marshal
import shutil
import struct
import sys
import tempfile
import threading
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.onboard.wheels import HASHES, SIGNATURES
from cosmos_cli.provision.lock import Locked
from cosmos_cli.provision.platform import Platform
from cosmos_cli.system import file_lock
from cosmos_cli.system.ownership import read_own_file

RULE = 1
"""Of what is left out and added; another one makes other wheels."""
RUNTIME_NAMES = ("annotated-types", "msgpack", "numpy", "orjson", "psutil")
"""Distributions that the runtime requires. Of other wheels nothing is left out: a scenario may import their tests."""
LEFT_OUT_FOLDERS = ("numpy/distutils/", "numpy/f2py/", "numpy/_pyinstaller/")
"""Files for those who compile or package, which nothing else imports."""
TESTS = "tests"
LEFT_OUT_SUFFIXES = (".pyi", ".pxd", ".pyx", ".c", ".h", ".a")
"""Stubs, and what a compiler reads."""
NOTE = "sent.json"
NOTE_BYTES_MAX = 4096
SENT_TIME = (1980, 1, 1, 0, 0, 0)
UNCHECKED_HASH = 1
"""Flags of a compiled module that Python takes without a look at its source (PEP 552)."""
LOCK = "sent.lock"
LOCK_TIMEOUT_S = 900.0
"""A slow operator compiles numpy for some minutes, once."""
FAULTS = (
    *(zipfile.BadZipFile, zlib.error, csv.Error, EOFError, LookupError),
    *(NotImplementedError, RuntimeError, ValueError),
)
"""Errors of reading a wheel that is damaged, or not what the specification asks for."""
_compiling = threading.Lock()
"""The filters of warnings are the process's: two threads that set and restore them leave those of one behind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SentWheel:
    """A wheel as a machine is sent it."""

    locked: Locked
    path: Path
    """Where it is here."""
    is_verified: bool
    """Whether its files were verified by RECORD here; else the machine does that."""


def sent_wheel(path: Path, locked: Locked, platform: Platform) -> SentWheel:
    """
    Return a wheel as a machine is sent it; made when it is first wanted. Safe for threads and processes.

    Args:
        path: The wheel; verified.
        locked: What it is.
        platform: Of the machine.

    Raises:
        MachineFailure: BUSY: another command packed it all the time.
    """
    python = sys.implementation.cache_tag if _writes_for(platform) else "sources"
    folder = path.parent / f"sent-{RULE}-{python}"
    found = _noted(folder, locked) or _make_once(path, locked, folder, platform)
    if found is None:
        return SentWheel(locked=locked, path=path, is_verified=False)
    return SentWheel(locked=found, path=folder / locked.filename, is_verified=True)


def _make_once(path: Path, locked: Locked, folder: Path, platform: Platform) -> Locked | None:
    """Make it unless another thread or command has just done so."""
    lock = path.parent / LOCK
    try:
        with file_lock.locked(lock, timeout_s=LOCK_TIMEOUT_S):
            return _noted(folder, locked) or _make(path, locked, folder, platform)
    except file_lock.LockHeld as held:
        raise MachineFailure(
            FailureKind.BUSY,
            f"another command on this computer packs {locked.filename}, and holds {lock}: {held}",
            "wait for its end, then repeat",
        ) from None


def _writes_for(platform: Platform) -> bool:
    """Tell whether this Python compiles for a machine's: the format is one for each minor version."""
    return sys.implementation.name == "cpython" and platform.python == sys.version_info[:2]


def _noted(folder: Path, locked: Locked) -> Locked | None:
    """Return what was made earlier, if it is still there; what another user laid there is not believed."""
    try:
        note = json.loads(read_own_file(folder / NOTE, bytes_max=NOTE_BYTES_MAX))
        sent = replace(locked, sha256=str(note["sha256"]), size_bytes=int(note["size_bytes"]))
        size_bytes = (folder / locked.filename).stat().st_size
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return sent if size_bytes == sent.size_bytes else None


def _make(path: Path, locked: Locked, folder: Path, platform: Platform) -> Locked | None:
    """Make it all at once; None when the wheel is not what the specification asks for, which the machine says."""
    content = io.BytesIO()
    try:
        with zipfile.ZipFile(path) as source, zipfile.ZipFile(content, "w") as sent:
            _rewrite(source, sent, locked, can_compile=_writes_for(platform))
    except FAULTS:
        return None
    whole = content.getvalue()
    made = replace(locked, sha256=hashlib.sha256(whole).hexdigest(), size_bytes=len(whole))
    note = {"sha256": made.sha256, "size_bytes": made.size_bytes}
    with tempfile.TemporaryDirectory(prefix=".sent-", dir=path.parent) as private:
        complete = Path(private, folder.name)
        complete.mkdir()
        (complete / locked.filename).write_bytes(whole)
        (complete / NOTE).write_text(json.dumps(note), encoding="utf-8")
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)  # what is there has lost its wheel or its note
        complete.rename(folder)  # both at once
    return made


def _rewrite(
    source: zipfile.ZipFile, sent: zipfile.ZipFile, locked: Locked, *, can_compile: bool
) -> None:
    info = "-".join(locked.filename.split("-")[:2]) + ".dist-info"
    record = f"{info}/RECORD"
    rows = {row[0]: row for row in csv.reader(io.StringIO(source.read(record).decode())) if row}
    kept: dict[str, list[str]] = {}
    for entry in source.infolist():
        name = entry.filename
        if entry.is_dir() or name == record or _is_left_out(name, locked):
            continue
        content = source.read(entry)
        _verify(name, content, rows.get(name, [name, ""])[1], info)
        sent.writestr(_entry(name, entry), content)
        if name in rows:
            kept[name] = rows[name]
        for made, code in _compiled(name, content) if can_compile else ():
            if made not in rows:
                sent.writestr(_entry(made), code)
                kept[made] = [made, f"sha256={_digest(code)}", str(len(code))]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([*kept.values(), [record, "", ""]])
    sent.writestr(_entry(record), text.getvalue())


def _verify(name: str, content: bytes, said: str, info: str) -> None:
    method, _, digest = said.partition("=")
    if name in {f"{info}/{each}" for each in SIGNATURES}:
        return
    if method not in HASHES or _digest(content, method) != digest:
        raise ValueError(f"{name} is not what RECORD says")


def _is_left_out(name: str, locked: Locked) -> bool:
    if locked.name not in RUNTIME_NAMES:
        return False
    folders = name.split("/")[1:-1]  # the first is the package itself
    return TESTS in folders or name.endswith(LEFT_OUT_SUFFIXES) or name.startswith(LEFT_OUT_FOLDERS)


def _compiled(name: str, content: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield where Python looks for a compiled module, and the module; nothing for what is none."""
    folder, _, file = name.rpartition("/")
    if not file.endswith(".py") or ".data/" in name:
        return
    try:
        with _compiling, warnings.catch_warnings(action="ignore"):
            code = compile(content, name, "exec", dont_inherit=True)
    except (SyntaxError, ValueError):  # a template, or of another Python
        return
    header = struct.pack(
        "<4sI8s",
        importlib.util.MAGIC_NUMBER,
        UNCHECKED_HASH,
        importlib.util.source_hash(content),
    )
    made = f"{file.removesuffix('.py')}.{sys.implementation.cache_tag}.pyc"
    inner = f"__pycache__/{made}"
    yield (f"{folder}/{inner}" if folder else inner), header + marshal.dumps(code)


def _entry(name: str, like: zipfile.ZipInfo | None = None) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, SENT_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    if like is not None:
        entry.external_attr = like.external_attr
    return entry


def _digest(content: bytes, method: str = "sha256") -> str:
    return base64.urlsafe_b64encode(hashlib.new(method, content).digest()).rstrip(b"=").decode()
