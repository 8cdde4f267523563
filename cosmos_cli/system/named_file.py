"""A file that a person named for what a command has to tell."""

from __future__ import annotations

import contextlib
import errno
import re
from codecs import BOM_UTF8
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cosmos_cli.errors import InputError
from madns_runtime.partial_file import check_replaceable

START_BYTES_MAX: Final = 1000
"""Of a file that is there, to tell what it is."""


@dataclass(frozen=True, slots=True)
class FileKind:
    """Kind of file that a command writes where a person named one."""

    name: str
    begins: re.Pattern[bytes]
    """Matches the start of every such file."""


HTML: Final = FileKind("HTML", re.compile(rb"\s*<(!doctype html|html)", re.IGNORECASE))
JSON_SCHEMA: Final = FileKind("JSON Schema", re.compile(rb'\s*{\s*"\$'))
JUNIT: Final = FileKind("JUnit XML", re.compile(rb"\s*(<.*)?<testsuite", re.DOTALL))


@contextlib.contextmanager
def named_file(path: Path) -> Iterator[None]:
    """
    Look at a file that was named, or write it.

    Raises:
        InputError: It cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def check_no_other(path: Path, kind: FileKind) -> None:
    """
    See that nothing is lost that no such command wrote, such as the scenario of who left FILE out.

    Raises:
        OSError: What is there is of another kind and not empty, or cannot be read.
    """
    if not path.is_file():
        return
    with path.open("rb") as stream:
        start = stream.read(START_BYTES_MAX).removeprefix(BOM_UTF8)
    if start.strip() and not kind.begins.match(start):
        why = f"what is there is no {kind.name}, and would be lost; name another file"
        raise OSError(errno.EEXIST, why, str(path))


def check_writable(path: Path, kind: FileKind) -> None:
    """
    Refuse a file that could not be written, before anything is run, read or told for it.

    Raises:
        InputError: It could not, or what is there is of another kind.
    """
    with named_file(path):
        check_replaceable(path)
        check_no_other(path, kind)
        path.parent.stat()
