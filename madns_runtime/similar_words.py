"""The known word that is most like one that is not known: what a misspelt name may have meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def most_similar(word: str, known: Iterable[str]) -> str | None:
    """Return the known word that is most like *word*; None where none is much like it."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return close[0] if close else None


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return `, did you mean X?` for a message; nothing where no known word is much like *word*."""
    close = most_similar(word, known)
    return "" if close is None else f", did you mean {close}?"
