"""Text of somebody else holds nothing that steers a terminal, and nothing of it is lost."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.ui.foreign_text import clean_line, clean_text

STEERING = ("Cc", "Cf", "Cs", "Zl", "Zp")
"""Unicode's classes of controls, formats (bidi, zero width, tags), surrogates, line and paragraph ends."""


def test_every_character_that_could_steer_a_terminal_is_shown_as_an_escape():
    steering = [c for c in map(chr, range(0x110000)) if unicodedata.category(c) in STEERING]

    cleaned = clean_text("".join(c for c in steering if c not in "\n\t"))

    assert cleaned.isascii()
    assert cleaned.isprintable()
    assert all(clean_text(c).startswith("\\") for c in steering if c not in "\n\t")


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("\x1b[2J\x1b[31mred\x1b[0m", r"\x1b[2J\x1b[31mred\x1b[0m"),
        ("\x9b31m\x7f\x00", r"\x9b31m\x7f\x00"),
        ("10%\r20%", r"10%\r20%"),
        ("user\u202etxt.exe", r"user\u202etxt.exe"),
        ("a\u200bb\ufeffc\xadd", r"a\u200bb\ufeffc\xadd"),
        ("a\u2028b\u2029c", r"a\u2028b\u2029c"),
        ("caf\udce9", r"caf\udce9"),
        ("\U000e0041", r"\U000e0041"),
        ("hidden\u3164", r"hidden\u3164"),
    ],
)
def test_it_is_shown_as_python_writes_it(text, shown):
    assert clean_text(text) == shown


@pytest.mark.parametrize(
    "text",
    ["", "two\nlines\tand a tab", "Ångström µm/s² ─ Спутник 衛星 ½ 5 km\xa0s", "C:\\x1b", "🛰 Ω≠ω"],
)
def test_harmless_text_stays_as_it_is(text):
    assert clean_text(text) == text


def test_line_ends_of_windows_become_ends_of_lines():
    assert clean_text("a\r\nb") == "a\nb"
    assert clean_line("a\r\nb\tc") == r"a\r\nb\tc"


def test_long_text_is_cut_with_a_count_and_within_its_bound():
    assert clean_text("x" * 1000, length_max=40) == "x" * 15 + "... (985 characters more)"
    assert clean_line("\x1b" * 10_000, length_max=100).endswith(" characters more)")


def test_note_of_what_was_cut_is_whole_whatever_the_number_of_its_digits() -> None:
    for size in range(90, 300):
        cut = clean_line("x" * size, length_max=85)

        kept, _, note = cut.partition("... ")
        assert len(cut) <= 85
        assert note == f"({size - len(kept)} characters more)"


@pytest.mark.slow
@given(st.text(), st.integers(0, 60))
def test_what_is_clean_stays_so_and_no_bound_is_passed(text, length_max):
    cleaned = clean_text(text)

    assert clean_text(cleaned) == cleaned
    assert len(clean_text(text, length_max=length_max)) <= length_max
    assert clean_text(text, length_max=len(cleaned)) == cleaned
    assert "\n" not in clean_line(text, length_max=None)
