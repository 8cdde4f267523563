"""
Patterns of --limit: Ansible's, over the machines of an inventory. Pure but for @FILE.

    pi07                  a machine              tower            a group
    pi0*, ~pi[0-9]+       names and groups that a glob, or a regular expression from their start, fits
    tower,lab  tower:lab  either                 all, *           every machine
    tower:&hwil           both                   tower:!chiefs    the first without the second
    tower[0] tower[-1]    by its place in what a pattern means; tower[1:3] both ends included, tower[5:]
    @FILE                 what the lines of a file mean (`limit_file` reads it: --limit alone, not a scenario)

As in Ansible, whatever the order: first all that is added, then what must be shared, then what is left out.
"""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from cosmos_cli.errors import FAULTS_SHOWN_MAX, InputError
from cosmos_cli.models.document import did_you_mean, may_guess
from cosmos_cli.models.limit_file import MARK, file_patterns, has_stray_bracket, pieces_of
from cosmos_cli.models.text_forms import compile_expression
from madns_runtime.plain_values import first_few

if TYPE_CHECKING:
    from cosmos_cli.models.inventory.machine import Machine

PATTERN_CHARACTERS_MAX = 4096
NAMES_SHOWN_MAX = 4
ALL = "all"

_SUBSCRIPT = re.compile(r"(.+)\[(?:(-?[0-9]{1,9})|([0-9]{1,9}):([0-9]{0,9}))\]")
_OLD_SUBSCRIPT = re.compile(r"(.+)\[([0-9]+)-([0-9]*)\]")


class PatternError(ValueError):
    """A pattern is malformed, names what there is not, or means no machine."""


def select_machines(
    machines: Sequence[Machine], pattern: str, *, groups: Sequence[str] = ()
) -> tuple[Machine, ...]:
    """
    Return the machines that a --limit pattern means, in the order of *machines*.

    Args:
        machines: All there are.
        pattern: As Ansible's --limit.
        groups: Further groups that are known, although no machine is in them.

    Raises:
        InputError: The pattern is malformed, names what there is not, or means no machine.
    """
    try:
        return _matching(machines, _split(pattern, has_files=True), groups)
    except PatternError as error:
        raise InputError(f"--limit {pattern}: {error}") from None


def matching_machines(
    machines: Sequence[Machine], pattern: str, *, groups: Sequence[str]
) -> tuple[Machine, ...]:
    """
    Return the machines that *pattern* means, for a caller who tells where it was written.

    Raises:
        PatternError: It is malformed, names what there is not, or means no machine.
    """
    return _matching(machines, _split(pattern), groups)


def _matching(
    machines: Sequence[Machine], pieces: Sequence[str], groups: Sequence[str]
) -> tuple[Machine, ...]:
    matcher = _Matcher(machines, groups)
    added: set[str] = set()
    plain = [piece for piece in pieces if piece[0] not in "!&"]
    for piece in plain or [ALL]:
        added.update(matcher.names(piece))
    for piece in pieces:
        if piece[0] == "&":
            added.intersection_update(matcher.names(piece[1:]))
    for piece in pieces:
        if piece[0] == "!":
            added.difference_update(matcher.names(piece[1:]))
    if matcher.faults:
        raise PatternError(first_few(list(dict.fromkeys(matcher.faults)), FAULTS_SHOWN_MAX, "; "))
    if not added:
        raise PatternError(f"means no machine; there are {_some(m.name for m in machines)}")
    return tuple(machine for machine in machines if machine.name in added)


def _split(pattern: str, *, has_files: bool = False) -> list[str]:
    """Return the pieces of a pattern, files replaced by their lines."""
    if len(pattern) > PATTERN_CHARACTERS_MAX:
        raise PatternError(f"expected at most {PATTERN_CHARACTERS_MAX} characters")
    if has_stray_bracket(pattern):
        raise PatternError("a bracket is never closed, or was never opened")
    pieces: list[str] = []
    for piece in pieces_of(pattern):
        is_file = has_files and piece[0] == MARK
        pieces += file_patterns(piece[1:]) if is_file else [piece]
    if not pieces:
        raise PatternError("expected a machine, a group or a pattern, got nothing")
    for piece in pieces:
        _check_piece(piece, has_files=has_files)
    return pieces


def _check_piece(piece: str, *, has_files: bool) -> None:
    if piece in ("!", "&", "~"):
        raise PatternError(f"expected a name after {piece!r}")
    if piece.lstrip("!&").startswith(MARK):
        raise PatternError(
            "expected a file of names (@FILE) by itself, not behind ! or &"
            if has_files
            else "files of names (@FILE) are not understood here: write the names"
        )


class _Matcher:
    """Finds the machines that one piece of a pattern means; what is unknown is collected in `faults`."""

    def __init__(self, machines: Sequence[Machine], groups: Sequence[str]) -> None:
        self.faults: list[str] = []
        self.broken: set[str] = set()
        """Regular expressions that are none, and told as such."""
        self.machines = dict.fromkeys(machine.name for machine in machines)
        self.groups: dict[str, list[str]] = {ALL: [], **{name: [] for name in groups}}
        places: dict[str, dict[str, int]] = {ALL: {}}
        for index, machine in enumerate(machines):
            for group in dict.fromkeys((ALL, *machine.groups)):
                self.groups.setdefault(group, []).append(machine.name)
                place = machine.positions.get(group, index)
                places.setdefault(group, {})[machine.name] = place
        for group, names in self.groups.items():
            names.sort(key=places.get(group, {}).__getitem__)

    def names(self, piece: str) -> list[str]:
        """Return the machines; an empty list and a fault if there is no such thing."""
        if piece in self.machines:
            return [piece]
        if piece[0] == "~":
            return self._matches(piece)
        old = _OLD_SUBSCRIPT.fullmatch(piece)
        if old:
            base, first, last = old.groups()
            told = f"write {base}[{first}:{last}] for places, ~{base}[{first}-{last}] for names"
            self.faults.append(f"{piece}: to Ansible, [{first}-{last}] counts places; {told}")
            return []
        match = _SUBSCRIPT.fullmatch(piece)
        if match is None:
            return self._matches(piece)
        found = self._matches(match.group(1), match)
        return self._cut(found, match) if found else []

    def _matches(self, text: str, subscript: re.Match[str] | None = None) -> list[str]:
        groups, singles = self._fitting(text)
        found = [name for group in groups for name in self.groups[group]]
        if not groups or text[0] == "~" or _is_glob(text) or "." in text:
            found += singles
        if not found and not groups and text not in self.broken:
            self.faults.append(self._no_places(subscript) if subscript else self._unknown(text))
        return found

    def _fitting(self, text: str) -> tuple[list[str], list[str]]:
        """Return the groups and the machines of a name, a glob or a regular expression."""
        if text[0] != "~" and not _is_glob(text):
            return [text] * (text in self.groups), [text] * (text in self.machines)
        try:
            written = text[1:] if text[0] == "~" else fnmatch.translate(text)
            fits = compile_expression(written).match
        except ValueError as error:
            self.faults.append(f"{text}: {error}")
            self.broken.add(text)
            return [], []
        return list(filter(fits, self.groups)), list(filter(fits, self.machines))

    def _cut(self, found: list[str], match: re.Match[str]) -> list[str]:
        if match.group(2) is None:
            last = int(match.group(4)) if match.group(4) else len(found) - 1
            return found[int(match.group(3)) : last + 1]
        try:
            return [found[int(match.group(2))]]
        except IndexError:
            self.faults.append(f"{match.group()}: {match.group(1)} has {len(found)} machines")
            return []

    def _no_places(self, subscript: re.Match[str]) -> str:
        """Say that brackets count places, and how to write the names that were perhaps meant."""
        base, only, first, last = subscript.groups()
        if not self._may_guess():
            return f"{subscript.group()} counts places in a group, and none is named {base}"
        meant = self._numbered(base, only or first, last if only is None else only)
        if not meant:
            hint = did_you_mean(base, list(self.groups))
            hint = hint if hint.endswith("?") else f"; there are {_some(list(self.groups))}"
            return f"{subscript.group()} counts places in a group, and none is named {base}{hint}"
        shown = meant if len(meant) <= NAMES_SHOWN_MAX else [*meant[:2], "...", meant[-1]]
        digits = len(meant[0]) - len(base)
        return (
            f"{subscript.group()} counts places in a group, and none is named {base}; for machines write"
            f" {':'.join(shown)}, or a glob such as {base}{'?' * digits}"
        )

    def _numbered(self, base: str, first: str, last: str) -> list[str]:
        """Return the machines that an inventory would mean by base[first:last]; an empty *last* is any."""
        numbers = {
            name: rest
            for name in self.machines
            if name.startswith(base) and (rest := name[len(base) :]).isdecimal()
        }
        return [
            name
            for name, rest in numbers.items()
            if len(rest) >= len(first) and int(first) <= int(rest) <= int(last or rest)
        ]

    def _unknown(self, text: str) -> str:
        is_like = text[0] == "~" or _is_glob(text)
        if not self._may_guess():
            return f"no machine or group is {'like' if is_like else 'named'} {text}"
        names = [*self.groups, *self.machines]
        if is_like:
            return f"no machine or group is like {text}; there are {_some(names)}"
        hint = did_you_mean(text, names)
        if not hint.endswith("?"):
            hint = f"; there are {_some(names)}"
        return f"no machine or group is named {text}{hint}"

    def _may_guess(self) -> bool:
        return may_guess(len(self.faults), len(self.groups) + len(self.machines))


def _is_glob(text: str) -> bool:
    return any(character in text for character in "?*[")


def _some(names: Iterator[str] | Sequence[str]) -> str:
    """Return the names for a message, cut when there are many."""
    listed = list(names)
    return ", ".join(listed[:12]) + (f", ... ({len(listed)})" if len(listed) > 12 else "")
