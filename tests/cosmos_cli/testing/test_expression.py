"""Expressions that choose tests, as pytest's -k."""

import itertools

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.testing.expression import DEPTH_MAX, parse_expression

NAMES = ["ring93", "ring93.yaml", "quick"]


@pytest.mark.parametrize(
    ("text", "is_meant"),
    [
        ("ring", True),
        ("RING93", True),
        ("quick and ring", True),
        ("quick and not ring", False),
        ("not (quick and slow)", True),
        ("slow or quick", True),
        ("slow or quick and thesis", False),
        ("(slow or quick) and ring", True),
        ("not not quick", True),
        ("ring93.yaml", True),
        ("android", False),
        ("notable or oracle", False),
        ("seed=3", False),
    ],
)
def test_means_what_pytest_means(text, is_meant):
    assert parse_expression(text)(NAMES) is is_meant


def test_and_binds_tighter_than_or_in_every_case():
    meant = parse_expression("a and b or not c and d")
    for letters in itertools.product((True, False), repeat=4):
        names = [name for name, there in zip("abcd", letters, strict=True) if there]
        a, b, c, d = letters
        assert meant(names) is ((a and b) or (not c and d))


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("", 1, "expected a word"),
        ("quick and", 10, "expected a word"),
        ("and quick", 1, "got 'and'"),
        ("quick slow", 7, "expected and, or, or the end"),
        ("(quick", 7, "closing parenthesis"),
        ("quick)", 6, "the end, got ')'"),
        ("()", 2, "expected a word"),
        ("quick or or slow", 10, "got 'or'"),
        ("__import__('os')", 11, "got '('"),
        ("a;b", 1, "letters, digits"),
    ],
)
def test_what_is_none_is_refused_with_its_place(text, place, words):
    with pytest.raises(InputError) as caught:
        parse_expression(text)

    (fault,) = caught.value.faults
    assert fault.column == place
    assert words in fault.render()


def test_depth_and_length_are_bounded():
    deep = "(" * (DEPTH_MAX + 5) + "a" + ")" * (DEPTH_MAX + 5)
    with pytest.raises(InputError, match="levels"):
        parse_expression(deep)
    with pytest.raises(InputError, match="characters"):
        parse_expression("a or " * 1000)
