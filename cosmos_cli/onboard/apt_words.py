"""Messages of apt and dpkg, understood: changes that they would make, and why they could not. Pure."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from cosmos_cli.onboard.request_loop import HelperRefusal, last_words

Changes = list[dict[str, str | None]]
"""One package each: "name", "old" and "new" version; no old one is newly installed, no new one removed."""

_INSTALLED = re.compile(r"^Inst (\S+)(?: \[(\S+)\])? \((\S+)", re.MULTILINE)
_REMOVED = re.compile(r"^(?:Remv|Purg) (\S+)(?: \[(\S+)\])?", re.MULTILINE)
_KEPT_BACK = re.compile(
    r"^The following packages have been kept back:\n((?:  .*\n?)+)", re.MULTILINE
)
_FULL = re.compile(r"No space left on device|have enough free space in (\S+?)\.?$", re.MULTILINE)
_HOLDER = re.compile(r"held by process (\d+)(?: \(([^)]+)\))?")
_UNKNOWN = re.compile(
    r"Unable to locate package (\S+)|Package '?([^\s']+)'? has no installation candidate"
    r"|Version '([^']+)' for '([^']+)' was not found"
)
_UNMET = re.compile(r"unmet dependencies:\n((?: .*\n?)+)")
_NO_WAY = re.compile(
    r"Temporary failure resolving '([^']+)'|Could not resolve '([^']+)'"
    r"|Could not connect to (\S+)|[Uu]nable to connect to (\S+)|Cannot initiate the connection to (\S+)"
)


class Trouble(HelperRefusal):
    """
    Refusal of what apt failed in.

    Args:
        word: Name of the reason.
        kind: As of every refusal.
        text: What the operator is told.
        advice: What to do.
    """

    def __init__(self, *, word: str, kind: str, text: str, advice: str = "") -> None:
        super().__init__(kind, text, advice)
        self.word = word


PYTHON_HINT = (
    "a Python package belongs into `requirements` of the scenario or `cosmos_requirements` of the"
    " inventory, then `cosmos up`"
)


def _holder(output: str) -> str:
    found = _HOLDER.search(output)
    return f" ({found[2] or 'process'}, pid {found[1]})" if found else ""


def _full_folder(output: str) -> str:
    found = _FULL.search(output)
    return f" in {found[1]}" if found and found[1] else ""


def _unknown_names(output: str) -> str:
    names = [
        name or candidate or f"{versioned}={version}"
        for name, candidate, version, versioned in _UNKNOWN.findall(output)
    ]
    return f" {', '.join(dict.fromkeys(names))}"


def _first_unmet(output: str) -> str:
    found = _UNMET.search(output)
    if found is None:
        return ""
    lines = [" ".join(line.split()) for line in found[1].splitlines()]
    return f" ({lines[0]}{'; and more' if lines[1:] else ''})"


def _source(output: str) -> str:
    found = _NO_WAY.search(output)
    where = next(filter(None, found.groups()), "") if found else ""
    return f" {where}" if where else ""


class _Symptom(NamedTuple):
    """Words of apt and dpkg by which a trouble is known, and what is told of it."""

    word: str
    """Name of the trouble."""
    pattern: re.Pattern[str]
    text: str
    advice: str
    kind: str = "step"
    """Of the refusal; most say no more than that a step failed."""
    details: Callable[[str], str] | None = None
    """Returns what follows the text, from all that was said."""


_SYMPTOMS = (
    _Symptom(
        "locked",
        re.compile(r"Could not get lock|is another process using it|was locked by another process"),
        "another program works on packages there",
        "wait for its end, then repeat; a board often updates itself after it was started",
        kind="busy",
        details=_holder,
    ),
    _Symptom(
        "disk_full",
        _FULL,
        "not enough free space",
        "make room there (`cosmos exec --sudo -- apt-get clean`, `cosmos wipe`), then repeat",
        kind="disk_full",
        details=_full_folder,
    ),
    _Symptom(
        "unknown",
        _UNKNOWN,
        "its package sources have no",
        "check the spelling, and the sources in /etc/apt there; " + PYTHON_HINT,
        details=_unknown_names,
    ),
    _Symptom(
        "no_way",
        re.compile(rf"{_NO_WAY.pattern}|Network is unreachable|Connection timed out"),
        "no way from there to its package source",
        "boards without internet need a mirror, a proxy (Acquire::http::Proxy in"
        " /etc/apt/apt.conf.d) or a local repository that they can reach",
        details=_source,
    ),
    _Symptom(
        "interrupted",
        re.compile(r"dpkg was interrupted"),
        "an earlier installation was interrupted there",
        "`cosmos exec --sudo -- dpkg --configure -a` finishes it",
    ),
    _Symptom(
        "read_only",
        re.compile(r"Read-only file system"),
        "its disk is read-only",
        "check the card or disk there (a worn SD card turns read-only)",
        kind="read_only",
    ),
    _Symptom(
        "clock",
        re.compile(r"is not valid yet|[Rr]elease file .* is expired"),
        "its clock and its package source disagree about the date",
        "set the clock there: `cosmos doctor` tells how far it is off",
    ),
    _Symptom(
        "unsigned",
        re.compile(r"NO_PUBKEY|is not signed|couldn't be verified"),
        "its package source is not signed by a key that it trusts",
        "add the key of that source there, or take the source out of /etc/apt",
    ),
    _Symptom(
        "stale",
        re.compile(r"404 +Not Found|File has unexpected size|Hash Sum mismatch"),
        "its package source no longer has what its lists name",
        "repeat the command later: the source may be changing right now",
    ),
    _Symptom(
        "sources",
        re.compile(r"The list of sources could not be read|Malformed (?:entry|line|stanza)"),
        "its list of package sources cannot be read",
        "check /etc/apt/sources.list and /etc/apt/sources.list.d there",
    ),
    _Symptom(
        "broken",
        re.compile(r"fix-broken"),
        "packages there do not fit together",
        "`cosmos exec --sudo -- apt-get --fix-broken install --yes` may mend it",
        details=_first_unmet,
    ),
    _Symptom(
        "unmet",
        re.compile(r"[Uu]nmet dependencies|held (?:broken )?packages"),
        "what is asked does not fit the packages there",
        "others that need it, or that it needs, are in the way; `cosmos exec -- apt-mark showhold` names"
        " what is held there",
        details=_first_unmet,
    ),
    _Symptom(
        "essential",
        re.compile(r"[Ee]ssential packages|should NOT be done|[Pp]rotected packages"),
        "apt will not remove what the system itself needs",
        "leave that package installed",
    ),
    _Symptom(
        "not_root",
        re.compile(r"are you root\?|Permission denied"),
        "apt may not change packages there",
        "this needs root: let the user run sudo without a password",
        kind="no_sudo",
    ),
)
"""In the order in which they are looked for: the first that is met is told."""


def trouble_of(output: str) -> Trouble:
    """Return what went wrong, from what apt or dpkg said."""
    for known in _SYMPTOMS:
        if known.pattern.search(output):
            text = known.text + (known.details(output) if known.details else "")
            return Trouble(word=known.word, kind=known.kind, text=text, advice=known.advice)
    said = last_words(output.encode()) or "it said nothing"
    return Trouble(word="other", kind="step", text=f"apt failed: {said}")


def planned_changes(output: str) -> Changes:
    """Return what `apt-get --simulate` says that it would do, by name."""
    changes: dict[str, dict[str, str | None]] = {}
    for name, old in _REMOVED.findall(output):
        changes[name] = {"name": name, "old": old or None, "new": None}
    for name, old, new in _INSTALLED.findall(output):
        changes[name] = {"name": name, "old": old or None, "new": new}
    return [changes[name] for name in sorted(changes)]


def changes_between(before: Mapping[str, str], after: Mapping[str, str]) -> Changes:
    """Return what became of the installed packages, by name."""
    return [
        {"name": name, "old": before.get(name), "new": after.get(name)}
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    ]


def kept_back(output: str) -> list[str]:
    """Return the packages that an upgrade left as they are, because they would need others or are on hold."""
    return [name for block in _KEPT_BACK.findall(output) for name in block.split()]
