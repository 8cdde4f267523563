"""Numbers come back from their text bit by bit, and other text is refused."""

import base64
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from madns_runtime.simulations.constellation.truth.segment_records import (
    pack_numbers,
    unpack_numbers,
)

TABLES = arrays.arrays(
    np.uint64,
    st.tuples(st.integers(1, 40), st.integers(1, 13)),
    elements=st.integers(0, 2**64 - 1),
)


@pytest.mark.slow
@given(TABLES)
def test_every_bit_pattern_comes_back(bits):
    numbers = bits.view(np.float64)

    found = unpack_numbers(pack_numbers(numbers), *numbers.shape)

    assert found.tobytes() == numbers.tobytes()


def test_a_smooth_series_needs_a_third_of_its_bytes_or_less():
    t_s = np.arange(61.0)[:, None]
    numbers = 7e6 * np.cos(1e-3 * t_s + np.arange(6))

    text = pack_numbers(numbers)

    assert unpack_numbers(text, 61, 6).tobytes() == numbers.tobytes()
    assert len(text) < numbers.nbytes / 3


GOOD = pack_numbers(np.arange(12.0).reshape(4, 3))


@pytest.mark.parametrize(
    ("text", "rows", "columns"),
    [
        ("", 4, 3),
        ("%%%%", 4, 3),
        ("\u00e4", 4, 3),
        (GOOD[:-8], 4, 3),
        (GOOD, 4, 4),
        (GOOD, 3, 3),
        (GOOD, 0, 3),
        (GOOD, -1, -1),
        (GOOD, 10**9, 10**9),
        (base64.b64encode(b"\xff" + zlib.compress(bytes(96))).decode(), 4, 3),
        (base64.b64encode(b"\x01" + zlib.compress(bytes(1 << 24))).decode(), 4, 3),
    ],
)
def test_what_holds_no_such_table_is_refused(text, rows, columns):
    with pytest.raises(ValueError, match="numbers"):
        unpack_numbers(text, rows, columns)
