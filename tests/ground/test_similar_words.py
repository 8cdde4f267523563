"""What a misspelt word may have meant: the most similar of those that are known."""

import pytest

from madns_runtime.similar_words import did_you_mean, most_similar


@pytest.mark.parametrize(
    ("word", "known", "meant"),
    [
        ("constelation", ["counter", "constellation"], "constellation"),
        ("xyz", ["counter", "constellation"], None),
        ("xyz", [], None),
        ("serail", {"serial": 1, "can": 2}, "serial"),
    ],
)
def test_the_most_similar_word_is_guessed_or_none(word, known, meant):
    guess = did_you_mean(word, known)

    assert most_similar(word, known) == meant
    assert guess == ("" if meant is None else f", did you mean {meant}?")
