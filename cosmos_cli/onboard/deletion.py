"""
Deletions of `cosmos wipe` on this machine: single runs as they were shown, or all of COSMoS's folder.

A folder that holds anything else than COSMoS's own is never deleted as a whole: who set cosmos_root to a
home directory keeps it.
"""

from __future__ import annotations

import json
import os
import shutil

from cosmos_cli.onboard.processes import (
    first_few,
    path_of,
    read_register,
    started_with,
    wait_for_end,
    words_of,
)
from cosmos_cli.onboard.records import RELEASED_PREFIX, is_folder, measured, remove
from cosmos_cli.onboard.request_loop import HelperRefusal, PlainValue, VerbRequest, verb

RUNS, STATE = "runs", "state"
INSTALLED = ("trees", "environments", "wheels")
OWN = (*INSTALLED, RUNS, STATE)
MEMORY = "settings.json"
"""In the state folder: what settings were before; without it nobody can put them back."""
GOING = ".going-"
"""Begins the name of a folder below the root that is being deleted."""


@verb("discard")
def discard(request: VerbRequest) -> None:
    """
    Delete one run's directory, if it holds what was shown of it and nothing of it lives.

    Of one that was released nobody has more to want: it may be less by now, for who released it deletes it still.
    """
    directory = path_of(request, "directory")
    wait_for_end(directory, path_of(request, "state"), 0.0)
    if not is_folder(directory):
        return
    shown = {name: request.arguments["shown"].get(name) for name in ("bytes", "files", "newest_s")}
    is_released = os.path.basename(directory).startswith(RELEASED_PREFIX)
    if not is_released and measured(directory) != shown:
        raise HelperRefusal(
            "data", f"{directory} has changed since it was listed", "repeat the command"
        )
    remove(directory)


@verb("root_content")
def root_content(request: VerbRequest) -> dict[str, PlainValue]:
    """Return what COSMoS's folder holds: bytes by part, what is not COSMoS's, and what runs from there."""
    root = path_of(request, "root")
    if not is_folder(root):
        return {"is_there": False, "bytes": {}, "others": [], "living": []}
    names = sorted(os.listdir(root))
    return {
        "is_there": True,
        "bytes": {
            name: measured(os.path.join(root, name))["bytes"] for name in names if name in INSTALLED
        },
        "others": _others(names),
        "living": _living(path_of(request, "state")),
    }


@verb("remove_root")
def remove_root(request: VerbRequest) -> list[str]:
    """Delete COSMoS's folder but runs that still lie there, and return what is left in it."""
    root, state = path_of(request, "root"), path_of(request, "state")
    if not is_folder(root):
        return []
    others = _others(os.listdir(root))
    if others:
        raise HelperRefusal(
            "data",
            f"{root} holds what is not COSMoS's: {first_few(others)}",
            "move that away, or delete trees, environments, wheels and state by hand",
        )
    living = _living(state)
    if living:
        raise HelperRefusal(
            "busy", f"still running there: {', '.join(living)}", "end it with: cosmos down"
        )
    for name in os.listdir(root):
        if name in INSTALLED:
            os.rename(os.path.join(root, name), os.path.join(root, f"{GOING}{name}-{os.getpid()}"))
    for name in os.listdir(root):
        if name.startswith(GOING):
            shutil.rmtree(os.path.join(root, name))
    _empty_state(os.path.join(root, STATE))
    return _close(root)


def _others(names: list[str]) -> list[str]:
    return sorted(name for name in names if name not in OWN and not name.startswith(GOING))


def _empty_state(state: str) -> None:
    for name in os.listdir(state) if os.path.isdir(state) else ():
        path = os.path.join(state, name)
        if name == MEMORY and _remembers(path):
            continue
        if os.path.isdir(path) and not os.path.islink(path):
            shutil.rmtree(path)
        else:
            os.unlink(path)


def _remembers(path: str) -> bool:
    """Tell whether a setting is in force that somebody may want to undo; a damaged memory is kept as well."""
    try:
        with open(path, "rb") as file:
            return bool(json.loads(file.read())["settings"])
    except (OSError, ValueError, KeyError, TypeError):
        return True


def _close(root: str) -> list[str]:
    """Remove what is empty, and return what is not, by path below the root."""
    left = []
    for folder, folders, names in os.walk(root, topdown=False):
        try:
            os.rmdir(folder)
        except OSError:
            is_state = os.path.basename(folder) == STATE
            left += [os.path.relpath(os.path.join(folder, n), root) for n in names if is_state]
            is_runs = os.path.relpath(folder, root) == RUNS
            left += [os.path.relpath(os.path.join(folder, n), root) for n in folders if is_runs]
    return sorted(left)


def _living(state: str) -> list[str]:
    """Return in words what lives of any run here: by the register, or because it was started for one."""
    entries = {entry.pid: f"{words_of(entry)} of {entry.run}" for entry in read_register(state)}
    started = started_with("COSMOS_STATE_DIR", state)
    return [*entries.values(), *(f"pid {pid}" for pid in started if pid not in entries)]
