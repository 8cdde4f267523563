"""
Distributions of one's own that a scenario requires by path: whether they are there, and installed here as well.

Boards get them from `cosmos up`. This computer, which reads the simulation's descriptor and runs the host and loopback
agents, is left to its owner: what is missing here is told with the command that installs it.
"""

from __future__ import annotations

import importlib.metadata
import os
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

from cosmos_cli.models.text_forms import is_own_requirement
from madns_runtime.bounded_files import FileRefused, check_regular_file, read_regular_file

WHEEL_BYTES_MAX = 256 * 1024 * 1024
PROJECT_BYTES_MAX = 1024 * 1024
PROJECT_FILES = ("pyproject.toml", "setup.py")
ANYWHERE = "-any.whl"

RequirementFault = tuple[tuple[str | int, ...], str]
"""The path within the scenario, and what is wrong there."""


def own_requirement_faults(requirements: Sequence[str], folder: Path) -> Iterator[RequirementFault]:
    """
    Yield what is wrong with each requirement that is a path.

    Args:
        requirements: Of the scenario.
        folder: The scenario's, from which paths are found.
    """
    for index, text in enumerate(requirements):
        if is_own_requirement(text):
            fault = _fault(folder / text)
            if fault:
                yield ("requirements", index), fault


def _fault(path: Path) -> str:
    if os.path.isdir(path):  # False of what cannot be looked at
        return _folder_fault(path)
    try:
        check_regular_file(path, bytes_max=WHEEL_BYTES_MAX)
    except FileNotFoundError:
        return f"no such file or folder: {path}"
    except FileRefused as error:
        return str(error)
    except OSError as error:
        return f"{path} cannot be read: {error.strerror}"
    parts = path.name.split("-")
    if path.suffix != ".whl" or len(parts) < 5:
        return f"expected a wheel such as cars-0.1-py3-none-any.whl, or a folder, got {path.name}"
    if not path.name.endswith(ANYWHERE):
        return ""  # perhaps of boards alone
    return _missing_here(parts[0], parts[1], path)


def _folder_fault(folder: Path) -> str:
    if not any(os.path.isfile(folder / name) for name in PROJECT_FILES):
        return f"expected a folder with {' or '.join(PROJECT_FILES)}, got {folder}"
    try:
        text = read_regular_file(folder / PROJECT_FILES[0], bytes_max=PROJECT_BYTES_MAX).decode()
        name = tomllib.loads(text).get("project", {}).get("name")
    except FileNotFoundError:
        name = None
    except (OSError, ValueError, AttributeError) as error:
        return f"{folder / PROJECT_FILES[0]} cannot be read: {error}"
    return _missing_here(name, None, folder) if isinstance(name, str) else ""


def _missing_here(name: str, version: str | None, path: Path) -> str:
    advice = f"install it here as well, where the simulation is read: pip install {path}"
    try:
        found = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return f"{name} is not installed on this computer; {advice}"
    except ValueError as error:
        return f"{path}: {error}"
    if version is not None and found != version:
        return f"{name} is {found} on this computer, and boards would get {version}; {advice}"
    return ""
