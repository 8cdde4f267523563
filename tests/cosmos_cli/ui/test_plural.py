import pytest

from cosmos_cli.ui.plural import counted


@pytest.mark.parametrize(
    ("count", "noun", "words"),
    [
        (0, "agent", "0 agents"),
        (1, "agent", "1 agent"),
        (2, "machine", "2 machines"),
        (1, "process", "1 process"),
        (3, "process", "3 processes"),
    ],
)
def test_one_thing_is_told_in_the_singular(count, noun, words):
    assert counted(count, noun) == words
