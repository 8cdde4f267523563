"""Boards boot, fail as told, come back, and leave nothing behind."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.root


def test_boards_take_connections_of_their_user(tower8):
    for name in tower8.boards:
        assert tower8.run(name, "hostname; id -un; sudo id -un").stdout.split() == [
            name,
            "pi",
            "root",
        ]
