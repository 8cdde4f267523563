"""Seeds of a suite."""

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.testing.seeds import parse_seeds


@pytest.mark.parametrize(
    ("text", "seeds"),
    [("1..4", (1, 2, 3, 4)), ("7", (7,)), ("5,1..3,2", (5, 1, 2, 3)), ("0..0", (0,))],
)
def test_ranges_and_numbers_in_their_order_each_once(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["", "1..", "a", "3..1", "-1", "1...3", "1..99999999", "99999999999999999999", "1,,2"]
)
def test_others_are_refused(text):
    with pytest.raises(InputError, match="--seeds: expected"):
        parse_seeds(text)


def test_ranges_that_overlap_count_each_seed_once():
    assert parse_seeds("1..10000,1..10000,9000..10000") == tuple(range(1, 10_001))
    with pytest.raises(InputError, match="at most 10000 seeds"):
        parse_seeds("1..10000,2..10001")
