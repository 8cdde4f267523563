"""Pieces are packed when that is quicker, and not when the board's processor is what is slow; sizes in words."""

import pytest

from cosmos_cli.onboard.records import PackingTrial


def ways(pace, count, *, packed_s, plain_s):
    """Return which of *count* pieces were packed, when each way takes so long."""
    found = []
    for _ in range(count):
        found.append(pace.packs)
        pace.sent(packed_s if pace.packs else plain_s)
    return found


@pytest.mark.parametrize(("packed_s", "plain_s", "wanted"), [(1.0, 3.0, True), (3.0, 1.0, False)])
def test_both_ways_are_tried_and_the_quicker_one_is_kept(packed_s, plain_s, wanted):
    found = ways(PackingTrial(), PackingTrial.SETTLED_PIECES, packed_s=packed_s, plain_s=plain_s)

    tried = PackingTrial.TRIED_PIECES
    assert found[: 2 * tried] == [True] * tried + [False] * tried
    assert set(found[2 * tried :]) == {wanted}


def test_a_link_that_changes_is_tried_anew():
    pace = PackingTrial()
    ways(pace, PackingTrial.SETTLED_PIECES, packed_s=3.0, plain_s=1.0)

    found = ways(pace, PackingTrial.SETTLED_PIECES, packed_s=1.0, plain_s=9.0)

    assert found[-1] is True
