"""Lists in a message: the first few, and how many more there are."""

import pytest

from madns_runtime.plain_values import first_few


@pytest.mark.parametrize(
    ("texts", "separator", "line"),
    [
        ([], ", ", ""),
        (["a", "b"], ", ", "a, b"),
        (["a", "b", "c"], ", ", "a, b and 1 more"),
        (("a", "b", "c", "d"), "; ", "a; b; and 2 more"),
    ],
)
def test_first_few_are_named_and_the_rest_is_counted(texts, separator, line):
    found = first_few(texts, 2, separator)

    assert line == found
