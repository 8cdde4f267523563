"""Words that a stream has in the place of one that is looked for and is nowhere: it may be misspelt."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from cosmos_cli.models.document import did_you_mean
from cosmos_cli.models.expectation import Expectation
from cosmos_cli.models.known_streams import WORDS
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.plain_values import first_few

KEPT_MAX: Final = 1000
"""Different words that are kept of one stream; of more, such as sentences, the first."""
TOLD_MAX: Final = 10
CHARACTERS_MAX: Final = 40
"""Characters of a word that are shown."""


class SeenWords:
    """
    Words that the stream of one expectation has, whoever recorded them.

    Args:
        expectation: What must be; others than of an event, or of records that hold a text, keep nothing.
    """

    def __init__(self, expectation: Expectation) -> None:
        self._expectation = expectation
        counted_text = None if expectation.when is None else expectation.when.text
        self._word = expectation.event or counted_text or ""
        is_known = expectation.has_known_words or (expectation.stream, expectation.field) in WORDS
        self.is_sought = bool(self._word) and not is_known
        """Whether the word is looked for and was not met."""
        self._words: set[str] = set()

    def take(self, values: NDArray[Any]) -> None:
        """Take the values of some records."""
        if not self.is_sought or values.dtype != object:
            return
        if np.any(values == self._word):
            self.is_sought = False
            return
        for each in values if len(self._words) < KEPT_MAX else ():
            if isinstance(each, str):
                self._words.add(each)
                if len(self._words) == KEPT_MAX:
                    return

    def remark(self) -> str | None:
        """Return what is to be told; None if the word was met, or nobody knows what would have been one."""
        expectation = self._expectation
        if not self.is_sought or not self._words:
            return None
        words = sorted(clean_line(word, length_max=CHARACTERS_MAX) for word in self._words)
        guess = did_you_mean(self._word, words)
        if not guess.endswith("?"):
            seen = first_few(words, TOLD_MAX)
            if len(words) == KEPT_MAX:  # how many there were is not known
                seen = f"{', '.join(words[:TOLD_MAX])} and more"
            guess = f"; words seen: {seen}"
        return (
            f"{expectation.name}: no record of {expectation.stream} has {self._word!r:.80}"
            f" in {expectation.field}{guess}"
        )
