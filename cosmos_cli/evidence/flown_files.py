"""
A run's own copy of what it flew: the files of its scenario's folder, as run.json lists them under "flown".

The list is read as the input that it is, since anybody may have edited it: names stay within the folder, sizes and
counts within bounds.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any, Final

from cosmos_cli.ui.foreign_text import clean_line

FOLDER: Final = "flown"
"""Name of the copy's folder in the run's directory."""
KEY: Final = "flown"
"""In run.json."""
FILES_MAX: Final = 2_000
"""Files that are listed; as many are looked at in one folder."""
FILE_BYTES_MAX: Final = 8 * 1024 * 1024
COPY_BYTES_MAX: Final = 64 * 1024 * 1024
"""All copied files together: the smallest come first."""
HASHED_BYTES_MAX: Final = 256 * 1024 * 1024
"""Bytes that are hashed of files that are too large to copy."""
NAME_BYTES_MAX: Final = 1024
LEFT_OUT_SHOWN_MAX: Final = 20
SHA256: Final = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownFile:
    """One file that was flown."""

    size_bytes: int
    sha256: str
    is_program: bool = False
    is_copied: bool = True
    """False of one that was too large: the run knows its hash alone."""

    def to_mapping(self) -> dict[str, Any]:
        """Return it as run.json holds it."""
        found: dict[str, Any] = {"bytes": self.size_bytes, "sha256": self.sha256}
        found |= {"program": True} if self.is_program else {}
        return found | ({} if self.is_copied else {"copied": False})


@dataclass(frozen=True, slots=True, kw_only=True)
class FlownFiles:
    """All files that were flown, by name within the folder, and what is said of those that are not in the copy."""

    files: Mapping[str, FlownFile]
    left_out: tuple[str, ...] = ()
    is_whole: bool = True
    """Whether all files are listed."""

    def to_mapping(self) -> dict[str, Any]:
        """Return it as run.json holds it."""
        return {
            "whole": self.is_whole,
            "files": {name: one.to_mapping() for name, one in self.files.items()},
            "left_out": list(self.left_out),
        }


def flown_remarks(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what the verdict says of files that are not in the copy, from run.json."""
    listed = document.get(KEY)
    left_out = listed.get("left_out") if isinstance(listed, Mapping) else None
    if not isinstance(left_out, list):
        return ()
    shown = tuple(f"{FOLDER}: {clean_line(str(one))}" for one in left_out[:LEFT_OUT_SHOWN_MAX])
    more = len(left_out) - len(shown)
    return (*shown, *((f"{FOLDER}: and {more} more files left out",) if more > 0 else ()))


def read_flown_files(document: Mapping[str, Any]) -> FlownFiles | None:
    """
    Return the files that a run.json lists; None if it lists none.

    Raises:
        ValueError: The list cannot be what a run wrote; the text says where and why.
    """
    listed = document.get(KEY)
    if listed is None:
        return None
    given = listed.get("files") if isinstance(listed, Mapping) else None
    if not isinstance(given, Mapping):
        raise ValueError(f"{KEY}.files: expected an object, got {type(given).__name__}")
    if len(given) > FILES_MAX:
        raise ValueError(f"{KEY}.files: expected at most {FILES_MAX} files, got {len(given)}")
    files = {name: _file(name, entry) for name, entry in given.items()}
    for is_copied, bytes_max in ((True, COPY_BYTES_MAX), (False, HASHED_BYTES_MAX)):
        size = sum(one.size_bytes for one in files.values() if one.is_copied is is_copied)
        if size > bytes_max:
            which = "copied" if is_copied else "left out"
            raise ValueError(
                f"{KEY}.files: expected at most {bytes_max} bytes in all files {which}, got {size}"
            )
    left_out = listed.get("left_out")
    return FlownFiles(
        files=files,
        left_out=tuple(map(str, left_out)) if isinstance(left_out, list) else (),
        is_whole=listed.get("whole") is True,
    )


def fault_of_name(name: str) -> str:
    """Say why a name cannot be that of a file within a folder; empty if it can."""
    if (
        not name.isprintable()
        or "\\" in name
        or len(name.encode(errors="replace")) > NAME_BYTES_MAX
    ):
        return f"expected printable characters without a backslash, at most {NAME_BYTES_MAX} bytes"
    path = PurePosixPath(name)
    if path.is_absolute() or path.as_posix() != name or not path.parts:
        return "expected a path within the folder"
    if any(part.startswith(".") for part in path.parts):
        return "expected no part that starts with a dot"
    if name.endswith(".part"):
        return "expected another ending than .part, which is that of files half written"
    return ""


def _file(name: str, entry: Any) -> FlownFile:
    where = f"{KEY}.files: {clean_line(name)!r:.200}"
    fault = fault_of_name(name)
    if fault:
        raise ValueError(f"{where}: {fault}")
    if not isinstance(entry, Mapping):
        raise ValueError(f"{where}: expected an object, got {type(entry).__name__}")
    size, sha256 = entry.get("bytes"), entry.get("sha256")
    is_copied = entry.get("copied", True) is True
    if isinstance(size, bool) or not isinstance(size, int) or size < 0:
        raise ValueError(f"{where}: expected bytes >= 0, got {size!r:.80}")
    bytes_max = FILE_BYTES_MAX if is_copied else HASHED_BYTES_MAX
    if size > bytes_max:
        raise ValueError(f"{where}: expected at most {bytes_max} bytes, got {size}")
    if not isinstance(sha256, str) or not SHA256.fullmatch(sha256):
        raise ValueError(f"{where}: expected the sha256 of its content, got {sha256!r:.80}")
    is_program = entry.get("program") is True
    return FlownFile(size_bytes=size, sha256=sha256, is_program=is_program, is_copied=is_copied)
