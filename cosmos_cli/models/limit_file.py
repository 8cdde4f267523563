"""
Files of patterns for --limit @FILE: one pattern a line, as Ansible's retry files; what starts with # is a comment.

Ansible splits no line of such a file, so a line with a comma is refused. It takes an empty file for all machines;
here that is refused, too.
"""

from __future__ import annotations

import re

from cosmos_cli.errors import Fault, InputError
from madns_runtime.bounded_files import read_regular_file

FILE_BYTES_MAX = 1024 * 1024
LINES_MAX = 10_000
MARK = "@"
COMMENT = "#"

_PIECES = re.compile(r"(?:[^\s:\[\]]|\[[^\]]*\])+")


def pieces_of(pattern: str) -> list[str]:
    """Return the pieces of a pattern, at commas, or at colons outside of brackets if there is no comma."""
    pieces = pattern.split(",") if "," in pattern else _PIECES.findall(pattern)
    return [text for piece in pieces if (text := piece.strip())]


def has_stray_bracket(pattern: str) -> bool:
    """Whether a bracket of a pattern without commas is never closed, or was never opened."""
    return "," not in pattern and bool(_PIECES.sub("", pattern).strip(": \t\r\n"))


def limit_files(limit: str | None) -> list[str]:
    """Return the paths of the files that a --limit names; what it means depends on their content."""
    return [piece[1:] for piece in pieces_of(limit or "") if piece.startswith(MARK)]


def file_patterns(path: str) -> list[str]:
    """
    Return the patterns of a file.

    Raises:
        InputError: It cannot be read, has no pattern, or lines that Ansible would not split.
    """
    if not path:
        raise InputError("--limit @: expected the path of a file after @")
    label = f"--limit {MARK}{path}"
    try:
        text = read_regular_file(path, bytes_max=FILE_BYTES_MAX).decode("utf-8")
    except FileNotFoundError:
        raise InputError(f"{label}: no such file") from None
    except OSError as error:
        raise InputError(f"{label}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        raise InputError(f"{label}: expected UTF-8 text, one pattern a line") from None
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    patterns = [(number, line) for number, line in lines if line and not line.startswith(COMMENT)]
    if not patterns:
        raise InputError(f"{label}: expected at least one machine or pattern, got none")
    if len(patterns) > LINES_MAX:
        raise InputError(f"{label}: expected at most {LINES_MAX} patterns, got {len(patterns)}")
    faults = [
        Fault(text=f"expected one pattern a line, got {line!r}", file=path, line=number, column=1)
        for number, line in patterns
        if "," in line or line.startswith(MARK) or any(map(str.isspace, line))
    ]
    if faults:
        raise InputError(faults=faults)
    return [line for _, line in patterns]
