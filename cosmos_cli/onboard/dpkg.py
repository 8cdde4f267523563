"""Installed packages of a machine, as dpkg knows them; nothing is changed, and no network is asked. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

TOOL_TIMEOUT_S = 5.0
APT_CACHE_TIMEOUT_S = 20.0
"""Of a slow board that must first make a cache of all that its package sources have."""
DPKG_QUERY = (
    "dpkg-query",
    "-W",
    "-f=${Package} ${Architecture} ${db:Status-Status} ${Version}\\n",
)
PROVIDES_QUERY = ("dpkg-query", "-W", "-f=${db:Status-Status} ${Package} ${Provides}\\n")


def installed_versions(
    names: Sequence[str], ask: Callable[[Sequence[str], float], str]
) -> dict[str, str | None]:
    """
    Tell the installed version of each package; None for one that is not there.

    *ask* runs a program for so many seconds and returns what it prints in English, nothing of one that is not there.

    A name that no package has, such as libasound-dev, is there when a package is that provides it, and that is told in
    its place; apt would install nothing for it. One that is also a package's own is not: apt would install that.
    """
    said = ask([*DPKG_QUERY, *names_asked(names)], TOOL_TIMEOUT_S) if names else ""
    found = versions_of(said)
    told = {name: version_of(name, found) for name in names}
    missing = [name for name, version in told.items() if version is None and ":" not in name]
    providers = providers_of(ask(PROVIDES_QUERY, TOOL_TIMEOUT_S)) if missing else {}
    provided = [name for name in missing if name in providers]
    if provided:
        virtual = virtual_names(ask(["apt-cache", "policy", *provided], APT_CACHE_TIMEOUT_S))
        told |= {name: providers[name] for name in provided if name in virtual}
    return told


def names_asked(names: Sequence[str]) -> list[str]:
    """Return what dpkg is asked for: a package for any architecture, such as adduser, is none of adduser:amd64 to it."""
    return [each for name in names for each in dict.fromkeys((name, _for_any(name)))]


def version_of(name: str, found: Mapping[str, str]) -> str | None:
    """Return the version of a package among `versions_of`; as apt sees it, one for any architecture is of each."""
    return found.get(name) or found.get(_for_any(name))


def _for_any(name: str) -> str:
    package, colon, _ = name.partition(":")
    return f"{package}:all" if colon else package


def versions_of(said: str) -> dict[str, str]:
    """Return what `DPKG_QUERY` tells: versions by name, and by name:architecture as well."""
    found: dict[str, str] = {}
    for line in said.splitlines():
        words = line.split(" ")
        if len(words) == 4 and words[2] == "installed":
            found.setdefault(words[0], words[3])
            found[f"{words[0]}:{words[1]}"] = words[3]
    return found


def providers_of(said: str) -> Mapping[str, str]:
    """Return which installed package provides a name, from what `PROVIDES_QUERY` tells: `a (= 1), b` behind its own."""
    found: dict[str, str] = {}
    for line in said.splitlines():
        status, _, rest = line.partition(" ")
        package, _, provided = rest.partition(" ")
        if status == "installed":
            for each in provided.split(","):
                found.setdefault(each.strip().partition(" ")[0], package)
    return found


def virtual_names(said: str) -> set[str]:
    """Return the names for which `apt-cache policy` knows no package to install."""
    found: set[str] = set()
    name = ""
    for line in said.splitlines():
        if not line.startswith(" "):
            name = line.removesuffix(":")
        elif line.split() == ["Candidate:", "(none)"]:
            found.add(name)
    return found
