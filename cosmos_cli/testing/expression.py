"""
An expression that chooses tests, as pytest's -k: words joined by and, or, not and parentheses.

A word matches a test if it is part of its name, of its file's name or of a tag, whatever the case. Read by recursive
descent; nothing is evaluated as Python.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.scenario_test import OPERATORS

CHARACTERS_MAX = 2000
DEPTH_MAX = 50
OPTION = "-k"

Matcher = Callable[[Sequence[str]], bool]
"""Tells whether a test with these names, in lower case, is meant."""
_TOKEN = re.compile(r"\s*(?:(?P<mark>[()])|(?P<word>[^\s()]+))")
_WORD = re.compile(r"[\w.:+\-\[\]=/\\]+")


def parse_expression(text: str) -> Matcher:
    """
    Return what an expression means.

    Raises:
        InputError: It is none; the message says where.
    """
    if len(text) > CHARACTERS_MAX:
        raise InputError(f"{OPTION}: expected at most {CHARACTERS_MAX} characters, got {len(text)}")
    return _Reader(text).expression()


class _Reader:
    """Tokens of one expression and the place of the next."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = [
            (match["mark"] or match["word"], match.start("mark" if match["mark"] else "word"))
            for match in _TOKEN.finditer(text)
        ]
        self.index = 0

    def expression(self) -> Matcher:
        """Read all of it."""
        found = self.either(0)
        if self.index < len(self.tokens):
            raise self.fault("expected and, or, or the end")
        return found

    def either(self, depth: int) -> Matcher:
        """Read what or joins."""
        parts = [self.both(depth)]
        while self.takes("or"):
            parts.append(self.both(depth))
        return parts[0] if len(parts) == 1 else lambda names: any(part(names) for part in parts)

    def both(self, depth: int) -> Matcher:
        """Read what and joins."""
        parts = [self.single(depth)]
        while self.takes("and"):
            parts.append(self.single(depth))
        return parts[0] if len(parts) == 1 else lambda names: all(part(names) for part in parts)

    def single(self, depth: int) -> Matcher:
        """Read a word, not, or what stands in parentheses."""
        if depth > DEPTH_MAX:
            raise self.fault(f"expected at most {DEPTH_MAX} levels of not and parentheses")
        if self.takes("not"):
            inner = self.single(depth + 1)
            return lambda names: not inner(names)
        if self.takes("("):
            found = self.either(depth + 1)
            if not self.takes(")"):
                raise self.fault("expected and, or, or a closing parenthesis")
            return found
        if self.index == len(self.tokens) or self.tokens[self.index][0] in (*OPERATORS, "(", ")"):
            raise self.fault("expected a word, not, or an opening parenthesis")
        word = self.tokens[self.index][0]
        if not _WORD.fullmatch(word):
            raise self.fault("expected a word of letters, digits, '_', '.', '-', ':', '[' or ']'")
        self.index += 1
        sought = word.lower()
        return lambda names: any(sought in name for name in names)

    def takes(self, token: str) -> bool:
        """Take the next token if it is this one."""
        if self.index < len(self.tokens) and self.tokens[self.index][0] == token:
            self.index += 1
            return True
        return False

    def fault(self, text: str) -> InputError:
        """Return an error at the next token."""
        at_end = self.index >= len(self.tokens)
        got, start = ("", len(self.text)) if at_end else self.tokens[self.index]
        told = f"{text}, got {got!r}" if got else f"{text}; it ends here"
        return InputError(
            faults=[Fault(text=told, file=OPTION, line=1, column=start + 1, source=self.text)]
        )
