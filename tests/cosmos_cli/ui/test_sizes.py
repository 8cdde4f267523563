"""Sizes in words."""

import pytest

from cosmos_cli.ui.sizes import size_words


@pytest.mark.parametrize(
    ("size_bytes", "words"),
    [
        *((0, "0 B"), (999, "999 B"), (1000, "1.0 kB"), (2_345_678, "2.3 MB")),
        *((999_949, "999.9 kB"), (999_950, "1.0 MB"), (1e9, "1.0 GB"), (7e15, "7000.0 TB")),
    ],
)
def test_sizes_are_told_in_a_fitting_unit(size_bytes, words):
    assert size_words(size_bytes) == words
