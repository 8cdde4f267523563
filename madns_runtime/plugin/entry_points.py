"""Names that installed distributions register for simulations and kinds of devices, and the places that they stand for."""

from __future__ import annotations

import contextlib
import functools
import sys
from importlib import metadata

from madns_runtime.errors import PluginError


def registered(group: str) -> dict[str, tuple[str, ...]]:
    """Return the places of every name that is registered in a group; more than one where distributions disagree."""
    found: dict[str, tuple[str, ...]] = {}
    for entry in _entries(group, tuple(sys.path)):
        if entry.value not in found.get(entry.name, ()):
            found[entry.name] = (*found.get(entry.name, ()), entry.value)
    return found


def place_of_name(group: str, name: str) -> str:
    """
    Return the place that a registered name stands for.

    Raises:
        PluginError: Two distributions register it for different places: which one a computer finds first is open.
    """
    places = registered(group)[name]
    if len(places) > 1:
        told = ", ".join(
            f"{_distribution(entry)} ({entry.value})"
            for entry in _entries(group, tuple(sys.path))
            if entry.name == name
        )
        raise PluginError(
            f"{name!r} is registered by more than one distribution: {told}; uninstall all but one, or name the"
            f" place itself, such as {places[0]}"
        )
    return places[0]


def distributions_of(group: str, name: str) -> dict[str, str]:
    """
    Return the versions of the distributions that register a name; nothing of one that is not registered.

    Of a place such as package.module:NAME they are those that register another in the package, or the one of the package's
    name: to look through all distributions for the one that has its file takes a second.
    """
    package, colon, _ = name.partition(":")
    top = package.partition(".")[0]
    entries = [
        entry
        for entry in _entries(group, tuple(sys.path))
        if entry.name == name or (colon and entry.module.partition(".")[0] == top)
    ]
    found = {entry.dist.name: entry.dist.version for entry in entries if entry.dist is not None}
    if not found and colon and top.isidentifier():
        with contextlib.suppress(metadata.PackageNotFoundError):
            of_name = metadata.distribution(top)
            if top in (of_name.read_text("top_level.txt") or top).split():
                found[of_name.name] = of_name.version
    return found


@functools.lru_cache(maxsize=16)
def _entries(group: str, path: tuple[str, ...]) -> tuple[metadata.EntryPoint, ...]:
    """Return all entries of a group; read once per path of imports, as that takes 8 ms."""
    del path
    return tuple(metadata.entry_points(group=group))


def _distribution(entry: metadata.EntryPoint) -> str:
    return "an unknown one" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
