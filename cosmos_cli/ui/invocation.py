"""The command line that is being carried out, so that a command can say how to repeat it, or which other one helps."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

INVENTORY = ("--inventory", "-i")
INVENTORY_VARIABLE = "COSMOS_INVENTORY"
LIMIT = ("--limit", "-l")


@dataclass(frozen=True, slots=True, kw_only=True)
class Invocation:
    """A verb and its words."""

    verb: str
    words: tuple[str, ...] = ()
    valued: frozenset[str] = frozenset()
    """Options of the verb that take a value."""
    has_tail: bool = False
    """Whether what follows the first plain word is no option of ours, as in `exec`."""

    def with_limit(self, pattern: str) -> str:
        """Return the command line for a shell, with this --limit in place of its own."""
        return shlex.join(["cosmos", self.verb, "--limit", pattern, *self._without_limit()])

    def has_option(self, name: str) -> bool:
        """Tell whether an option is given to the verb: neither to what `exec` runs, nor as the value of another option."""
        words = iter(self.words)
        for word in words:
            if word == "--" or (self.has_tail and not word.startswith("-")):
                return False
            _, option, is_attached = self._options(word)
            if option == name:
                return True
            if option in self.valued and not is_attached:
                next(words, None)
        return False

    @property
    def machine_options(self) -> str:
        """
        Return -i and --limit as they were typed, each behind a space, for another command on these machines.

        Of COSMOS_INVENTORY nothing, as the other command reads it, too; INVENTORY where nobody named any.
        """
        limits = (f" --limit {shlex.quote(each)}" for each in self._values_of(LIMIT))
        return self.inventory_options + "".join(limits)

    @property
    def inventory_options(self) -> str:
        """Return -i alone, as in `machine_options`, for a command that names its own machines."""
        inventories = self._values_of(INVENTORY)
        if not inventories and not os.environ.get(INVENTORY_VARIABLE):
            inventories = ["INVENTORY"]
        return "".join(f" -i {shlex.quote(each)}" for each in inventories)

    def _values_of(self, names: Sequence[str]) -> list[str]:
        """Return the values that an option was given."""
        words, values = iter(self.words), []
        for word in words:
            if word == "--" or (self.has_tail and not word.startswith("-")):
                break
            flags, name, is_attached = self._options(word)
            if name not in self.valued:
                continue
            start = len(name) + 1 if word.startswith("--") else max(len(flags), 1) + 1
            value = word[start:] if is_attached else next(words, "")
            values += [value] if name in names else []
        return values

    def _without_limit(self) -> Iterator[str]:
        words = iter(self.words)
        for word in words:
            if word == "--" or (self.has_tail and not word.startswith("-")):
                yield word
                yield from words
                return
            flags, name, is_attached = self._options(word)
            if name in LIMIT:
                if flags:
                    yield flags
                if not is_attached:
                    next(words, None)
                continue
            yield word
            if name in self.valued and not is_attached:
                yield from [value for value in [next(words, None)] if value is not None]

    def _options(self, word: str) -> tuple[str, str, bool]:
        """Return short flags that a word begins with, as in -vql, its last option's name, and whether that has its value in the same word."""
        if word.startswith("--"):
            name, equals, _ = word.partition("=")
            return "", name, bool(equals)
        for place, letter in enumerate(word[1:] if word.startswith("-") else "", start=1):
            if f"-{letter}" in self.valued:  # what follows is its value
                return word[:place] if place > 1 else "", f"-{letter}", place + 1 < len(word)
        return word, "", True


NOTHING = Invocation(verb="")


@dataclass(slots=True)
class _Current:
    """The command line that this process carries out, and whether its result is printed."""

    invocation: Invocation = NOTHING
    has_result: bool = False


_current = _Current()


def forget() -> None:
    """Begin another command line, of which nothing is read yet."""
    _current.invocation, _current.has_result = NOTHING, False


def record(verb: str, words: Sequence[str], valued: frozenset[str], *, has_tail: bool) -> None:
    """Remember the command line that begins."""
    _current.invocation = Invocation(
        verb=verb, words=tuple(words), valued=valued, has_tail=has_tail
    )


def current() -> Invocation:
    """Return the command line that is being carried out; NOTHING before its words are understood."""
    return _current.invocation


def note_result() -> None:
    """Remember that the one document that --json promises is printed."""
    _current.has_result = True


def has_result() -> bool:
    """Tell whether it is printed: whoever reads it takes no second one."""
    return _current.has_result
