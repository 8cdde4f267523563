"""A file that a person named for what a command has to tell."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from cosmos_cli.errors import InputError
from madns_runtime.partial_file import check_replaceable


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


def check_writable(path: Path) -> None:
    """
    Refuse a file that could not be written, before anything is run, read or told for it.

    Raises:
        InputError: It could not.
    """
    with named_file(path):
        check_replaceable(path)
        path.parent.stat()
