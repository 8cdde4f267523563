"""A file that a person named for what a command has to tell."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from cosmos_cli.errors import InputError


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
