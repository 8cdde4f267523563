"""Words between an agent's process and a device's: all that was said is heard, and an end is told from silence."""

import pytest

from madns_runtime.hardware import messages


@pytest.fixture
def pair():
    own, other = messages.make_pair()
    with own, other:
        yield own, other


def test_silence_is_no_end_and_an_end_is_one_once_all_was_heard(pair):
    own, other = pair
    found = [messages.is_over(own)]
    messages.send(other, ["report", 1])
    found.append(messages.is_over(own))
    assert list(messages.receive_all(own)) == [["report", 1]]
    found.append(messages.is_over(own))
    other.close()
    found.append(messages.is_over(own))

    assert found == [False, False, False, True]


def test_the_last_words_of_one_that_ended_without_reading_what_it_was_told_are_heard(pair):
    own, other = pair
    messages.send(own, [messages.END, "the run is over"])
    messages.send(other, ["report", {}])
    other.close()

    assert list(messages.receive_all(own)) == [["report", {}]]
    assert messages.is_over(own)


@pytest.mark.parametrize("count", [1, 15, 16, 1000])
def test_a_mapping_that_is_told_in_parts_is_received_whole(pair, count):
    own, other = pair
    told = {f"pi22/clock{number}": {"records": "x" * (number % 300)} for number in range(count)}
    for part in messages.in_parts("report", told):
        assert messages.send(other, part)

    heard = {}
    for word, part in messages.receive_all(own):
        assert word == "report"
        heard |= part
    assert heard == told
    assert list(messages.in_parts("report", {})) == []
