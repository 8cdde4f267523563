"""Where a plug-in's code is written, as messages tell it: file and line, which its writer looks at first."""

from __future__ import annotations

import contextlib
import inspect
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from madns_runtime.bounded_files import read_regular_file
from madns_runtime.plugin import time_limit

CODE_BYTES_MAX = 16 * 1024 * 1024
"""Bytes of a file of Python: no text that somebody wrote is longer."""
MODULE_PREFIX = "madns_plugin_"
"""Prefix of the names under which files are loaded."""


def place_of(thing: Any) -> str:
    """Return file:line where a function or class is written; its name if that is not known."""
    try:
        thing = inspect.unwrap(thing)
        file = inspect.getsourcefile(thing)
        line = inspect.getsourcelines(thing)[1]
    except (OSError, TypeError, ValueError):
        return str(getattr(thing, "__qualname__", thing))
    return f"{file}:{line}"


def place_of_class(kind: type) -> str:
    """Return where a class stands, and its name: for a fault alone, as its file is read for it."""
    return f"{place_of(kind)}: {kind.__name__}"


def line_of(thing: Any) -> str:
    """Return NAME OF THE FILE:line where a function or class is written; empty if that is not known."""
    try:
        file, colon, line = place_of(thing).rpartition(":")
    except Exception:  # noqa: BLE001 - a class of a plug-in's may raise anything when it is asked what it wraps
        return ""
    return f"{Path(file).name}:{line}" if colon and line.isdecimal() else ""


def error_text(error: BaseException) -> str:
    """Return what an error says of itself; of one whose class cannot, that."""
    try:
        return str(error)
    except BaseException as fault:  # noqa: BLE001 - __str__ of a plug-in's class may raise anything
        return f"(its __str__ raised {type(fault).__name__})"


def blame(error: BaseException, thing: Callable[..., Any]) -> str:
    """Return the last line of a function's or class's own file that took part in an error: its writer looks there first."""
    try:
        own = inspect.getsourcefile(inspect.unwrap(thing))
    except TypeError:
        own = None
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == own]
    return f"{own}:{frames[-1].lineno}" if frames else place_of(thing)


def told_place(where: str, thing: Any = None) -> str:
    """Return *where* as its writer knows it: of a file's part, its file and line instead of the module's name."""
    place, _, attribute = where.rpartition(":")
    module = sys.modules.get(place)
    if not place.startswith(MODULE_PREFIX) or module is None:
        return where
    file = str(module.__file__)
    if getattr(thing, "__module__", None) == place:
        return f"{place_of(thing)}: {attribute}"
    return f"{file}{_line_naming(file, attribute)}: {attribute}"


def _line_naming(file: str, attribute: str) -> str:
    """Return :LINE of the line that names a part as the descriptor does."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        for number, line in enumerate(
            read_regular_file(file, bytes_max=CODE_BYTES_MAX).decode().splitlines(), 1
        ):
            if f':{attribute}"' in line or f":{attribute}'" in line:
                return f":{number}"
    return ""


def line_in(error: BaseException, path: Path) -> str:
    """Return :LINE of the last line of *path* that took part in *error*."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f":{error.lineno}"
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    return f":{lines[-1]}" if lines else ""


def last_place(error: BaseException, module: str) -> str:
    """Return the last line that took part in an import's *error*, as "FILE:LINE: "; the module's name if there is none."""
    if isinstance(error, SyntaxError):
        return f"{error.filename}:{error.lineno}: "
    frames = traceback.extract_tb(error.__traceback__)[1:]  # the first is where it was caught
    outside = [
        frame
        for frame in frames
        if "importlib" not in frame.filename and frame.filename != time_limit.__file__
    ]
    return f"{outside[-1].filename}:{outside[-1].lineno}: " if outside else f"{module}: "
