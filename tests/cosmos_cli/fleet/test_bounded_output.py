"""Output within bounds: the first and the last are kept, and what fell between is counted."""

from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.fleet.transfer_limits import BoundedOutput


def test_what_fits_is_whole():
    output = BoundedOutput(4, 4)
    for piece in (b"ab", b"cdef", b"gh"):
        output.add(piece)

    assert (output.data, output.cut_bytes) == (b"abcdefgh", 0)


def test_first_and_last_are_kept_and_the_cut_is_told():
    output = BoundedOutput(2, 3)
    output.add(b"abcdefgh")

    assert output.cut_bytes == 3
    assert output.data == b"ab\n[... 3 bytes left out ...]\nfgh"


def test_without_a_first_part_the_last_is_kept_alone():
    output = BoundedOutput(0, 3)
    output.add(b"abcdef")

    assert (output.data, output.cut_bytes, output.text()) == (b"def", 3, "def")


@given(st.lists(st.binary(max_size=20), max_size=20), st.integers(0, 12), st.integers(0, 12))
def test_every_byte_is_kept_or_counted(pieces, first_bytes, last_bytes):
    output = BoundedOutput(first_bytes, last_bytes)
    for piece in pieces:
        output.add(piece)
    whole = b"".join(pieces)

    kept = bytes(output._first + output._last)
    assert len(kept) + output.cut_bytes == len(whole)
    assert whole.startswith(bytes(output._first))
    assert whole.endswith(bytes(output._last))
