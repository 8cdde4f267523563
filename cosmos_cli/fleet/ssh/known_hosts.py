"""
Host keys of machines: OpenSSH's known_hosts files, read, asked and added to.

A key is known, unknown, changed or revoked. Unknown ones may be recorded when the operator asks for it;
a changed one never is.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import errno
import functools
import hashlib
import hmac
import os
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from cosmos_cli.fleet.ssh.config import matches
from cosmos_cli.system.file_lock import LockHeld, take_lock
from madns_runtime.bounded_files import read_regular_file

SSH_PORT = 22
HASHED = "|1|"
REVOKED = "@revoked"
CERTIFICATE_AUTHORITY = "@cert-authority"
FILE_BYTES_MAX = 64 * 1024 * 1024
NOWHERE = ("/dev/null", "none")
LOCK_TIMEOUT_S = 5.0
"""For whoever else locks the file: anybody may who can read it."""

_RECORDING = threading.Lock()


class Standing(Enum):
    """Standing of a key by the files."""

    KNOWN = "known"
    UNKNOWN = "unknown"
    CHANGED = "changed"
    REVOKED = "revoked"


MARKERS = ("", REVOKED, CERTIFICATE_AUTHORITY)
AUTHORITY_STANDINGS = {REVOKED: Standing.REVOKED, CERTIFICATE_AUTHORITY: Standing.KNOWN}
"""By marker, the one that counts first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HostKey:
    """A machine's public key."""

    kind: str
    """Such as ssh-ed25519."""
    blob: bytes

    @property
    def fingerprint(self) -> str:
        """Return what `ssh-keygen -l` shows."""
        return "SHA256:" + _base64(hashlib.sha256(self.blob).digest()).rstrip("=")


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownHost:
    """One line of a known_hosts file."""

    patterns: str
    key: HostKey
    file: str
    line: int
    marker: str = ""
    """REVOKED, or CERTIFICATE_AUTHORITY of a key that signs others; empty for a machine's own."""

    def matches(self, name: str) -> bool:
        """Whether it speaks of *name*, a host name or [name]:port."""
        if self.patterns.startswith(HASHED):
            return _matches_hash(self.patterns, name)
        return matches(self.patterns.split(","), name)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyVerdict:
    """Knowledge of a key that a machine showed."""

    standing: Standing
    against: KnownHost | None = None
    """The line that says so, or otherwise."""


class KnownHosts:
    """
    The operator's known_hosts files.

    Args:
        files: In the order in which they are asked.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._files = tuple(files)

    def judge(self, names: Sequence[str], key: HostKey) -> KeyVerdict:
        """
        Say what is known of *key* as a key of a machine.

        Args:
            names: See `names_of`.
            key: What the machine showed.
        """
        found = [self._entries(name) for name in names]
        for entry in (entry for entries in found for entry in entries):
            if entry.marker == REVOKED and entry.key == key:
                return KeyVerdict(standing=Standing.REVOKED, against=entry)
        for entries in found:
            keys = [entry for entry in entries if not entry.marker]
            if any(entry.key == key for entry in keys):
                return KeyVerdict(standing=Standing.KNOWN)
            if keys and entries is found[0]:
                alike = [entry for entry in keys if entry.key.kind == key.kind]
                return KeyVerdict(standing=Standing.CHANGED, against=(alike or keys)[0])
        return KeyVerdict(standing=Standing.UNKNOWN)

    def judge_authority(self, names: Sequence[str], key: HostKey) -> KeyVerdict:
        """Say whether *key* may sign certificates of a machine: KNOWN, REVOKED or UNKNOWN, and by which line."""
        entries = [entry for name in names for entry in self._entries(name) if entry.key == key]
        for marker, standing in AUTHORITY_STANDINGS.items():
            for entry in entries:
                if entry.marker == marker:
                    return KeyVerdict(standing=standing, against=entry)
        return KeyVerdict(standing=Standing.UNKNOWN)

    def has_authority(self, names: Sequence[str]) -> bool:
        """Tell whether a certificate would be a proof of a machine."""
        entries = (entry for name in names for entry in self._entries(name))
        return any(entry.marker == CERTIFICATE_AUTHORITY for entry in entries)

    def kinds(self, names: Sequence[str]) -> list[str]:
        """Return the kinds of keys that are known of a machine, so that it is asked for one of these."""
        for name in names:
            kinds = [entry.key.kind for entry in self._entries(name) if not entry.marker]
            if kinds:
                return list(dict.fromkeys(kinds))
        return []

    def record(self, name: str, key: HostKey, *, is_hashed: bool = False) -> KeyVerdict:
        """
        Add an unknown key to the first file, under a lock, unless somebody else has by now.

        Returns:
            KNOWN when it stands there now; CHANGED when another one does.

        Raises:
            OSError: The file cannot be written.
        """
        file = self._files[0] if self._files else None
        if file is None or str(file) in NOWHERE:
            return KeyVerdict(standing=Standing.KNOWN)
        with _RECORDING:
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            descriptor = os.open(file, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "r+b") as stream:
                _lock(stream.fileno(), file)
                verdict = self.judge((name,), key)
                if verdict.standing is not Standing.UNKNOWN:
                    return verdict
                size = stream.seek(0, os.SEEK_END)
                ends_a_line = size == 0 or os.pread(descriptor, 1, size - 1) == b"\n"
                line = f"{_hashed(name) if is_hashed else name} {key.kind} {_base64(key.blob)}\n"
                stream.write((b"" if ends_a_line else b"\n") + line.encode())
        return KeyVerdict(standing=Standing.KNOWN)

    def _entries(self, name: str) -> list[KnownHost]:
        return [entry for file in self._files for entry in _book(file).of(name)]


def _lock(descriptor: int, file: Path) -> None:
    try:
        take_lock(descriptor, timeout_s=LOCK_TIMEOUT_S)
    except LockHeld as held:
        raise BlockingIOError(
            errno.EAGAIN, f"locked for {LOCK_TIMEOUT_S:g} s by {held}", str(file)
        ) from None


def names_of(host: str, port: int, alias: str | None = None) -> tuple[str, ...]:
    """Return under which names a machine's key is looked for; the first is the one that is recorded."""
    if alias:
        return (alias.lower(),)
    plain = host.lower()
    return (plain,) if port == SSH_PORT else (f"[{plain}]:{port}", plain)


@dataclass(frozen=True, slots=True)
class _Book:
    """One file's lines: those that name a host plainly are found at once, all others are tried."""

    plain: dict[str, list[KnownHost]]
    others: list[KnownHost]

    def of(self, name: str) -> list[KnownHost]:
        found = [*self.plain.get(name, ()), *(e for e in self.others if e.matches(name))]
        return sorted(found, key=lambda entry: entry.line) if len(found) > 1 else found


def _book(file: Path) -> _Book:
    try:
        status = file.stat()
    except OSError:
        return _Book({}, [])
    return _read_book(str(file), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=16)
def _read_book(file: str, changed_ns: int, size_bytes: int) -> _Book:
    """Read a file once for all machines; it is read again when it has changed."""
    book = _Book({}, [])
    with contextlib.suppress(OSError):
        text = read_regular_file(file, bytes_max=FILE_BYTES_MAX).decode(errors="replace")
        for entry in parse(text, file):
            if any(character in entry.patterns for character in "*?!|"):
                book.others.append(entry)
                continue
            for name in entry.patterns.lower().split(","):
                book.plain.setdefault(name, []).append(entry)
    return book


def parse(text: str, file: str = "") -> Iterable[KnownHost]:
    """Read the lines of a known_hosts file; what is no such line is passed over, as ssh does."""
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        marker = words.pop(0) if words and words[0].startswith("@") else ""
        if len(words) < 3 or words[0].startswith("#") or marker not in MARKERS:
            continue
        try:
            blob = base64.b64decode(words[2], validate=True)
        except (binascii.Error, ValueError):
            continue
        yield KnownHost(
            patterns=words[0],
            key=HostKey(kind=words[1], blob=blob),
            file=file,
            line=number,
            marker=marker,
        )


def _matches_hash(patterns: str, name: str) -> bool:
    try:
        salt, digest = (base64.b64decode(part) for part in patterns[len(HASHED) :].split("|"))
    except (binascii.Error, ValueError):
        return False
    return hmac.compare_digest(hmac.digest(salt, name.encode(), "sha1"), digest)


def _hashed(name: str) -> str:
    salt = os.urandom(20)
    digest = hmac.digest(salt, name.encode(), "sha1")
    return f"{HASHED}{_base64(salt)}|{_base64(digest)}"


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
