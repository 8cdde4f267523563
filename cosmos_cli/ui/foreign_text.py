r"""
Text of somebody else, made harmless for a terminal, a log and a page.

What a board answered, an exception said or a file calls its keys may hold characters that move a terminal's
cursor, retitle its window, turn the order of letters round, or show nothing at all. They are shown as Python
writes them (`\x1b`, `\u202e`): nothing disappears, so that one sees what came. Used by all that prints
(`cosmos_cli.ui.console`), and wherever such text goes into a sentence with a bound.
"""

from __future__ import annotations

import re

LINE_CHARACTERS_MAX = 500
"""Characters that a name or one line of somebody else may take of a sentence."""

_SPACES = (
    "\xa0\u1680\u2000\u2001\u2002\u2003\u2004\u2005\u2006\u2007\u2008\u2009\u200a\u202f\u205f\u3000"
)
"""Spaces of other widths: no printable characters to Python, but harmless."""
_UNSEEN = "\u034f\u115f\u1160\u17b4\u17b5\u180b\u180c\u180d\u180f\u3164\uffa0"
"""Letters and marks by their class, but they show nothing: a name may hide in them."""
_SUSPECT = re.compile("[^\t\n\x20-\x7e\xa1-\xac\xae-\u02ff]")
_SUSPECT_IN_LINE = re.compile("[^\x20-\x7e\xa1-\xac\xae-\u02ff]")
_LINE_ENDS = re.compile("\r\n")


def clean_text(text: str, *, length_max: int | None = None) -> str:
    """
    Return *text* with every character that could steer a terminal shown as an escape; tabs and line ends stay.

    Harmless text comes back as it is, and so does text that was cleaned before.

    Args:
        text: Anything; lone surrogates, as in a path's name that is no UTF-8, are shown as escapes too.
        length_max: Longest text to return, characters; what is cut is counted at its end. None for any length.
    """
    return _bounded(_SUSPECT.sub(_shown, _LINE_ENDS.sub("\n", text)), length_max)


def clean_line(text: str, *, length_max: int | None = LINE_CHARACTERS_MAX) -> str:
    r"""Return *text* cleaned as one line: tabs and line ends, too, are shown as `\t` and `\n`."""
    return _bounded(_SUSPECT_IN_LINE.sub(_shown, text), length_max)


def _shown(match: re.Match[str]) -> str:
    character = match.group()
    is_harmless = character.isprintable() or character in _SPACES
    return character if is_harmless and character not in _UNSEEN else ascii(character)[1:-1]


def _bounded(text: str, length_max: int | None) -> str:
    if length_max is None or len(text) <= length_max:
        return text
    # The note takes room itself, so that more is cut, whose number may have one digit more.
    for kept in range(length_max - len(_cut_note(len(text) - length_max)), 0, -1):
        note = _cut_note(len(text) - kept)
        if kept + len(note) <= length_max:
            return text[:kept] + note
    return text[:length_max]


def _cut_note(count: int) -> str:
    return f"... ({count} characters more)"
