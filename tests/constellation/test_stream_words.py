"""Words that the streams declare, for fields of words: all that their types know."""

from typing import get_args

from madns_runtime.simulations.constellation import streams
from madns_runtime.simulations.constellation.messages import (
    CommandFrame,
    CommandKind,
    CommandStatus,
)
from madns_runtime.simulations.constellation.truth.maneuvers.stuck_thrusters import BurnState
from madns_runtime.simulations.constellation.truth.radio.channel import OUTCOMES


def words_of(fields, name):
    return next(field.words for field in fields if field.name == name)


def test_streams_declare_the_words_of_the_types():
    kinds, statuses = get_args(CommandKind), get_args(CommandStatus)

    assert words_of(streams.COMMANDS, "kind") == words_of(streams.MANEUVERS, "kind") == kinds
    assert words_of(streams.COMMANDS, "frame") == get_args(CommandFrame)
    assert words_of(streams.COMMAND_RESULTS, "status") == statuses
    assert words_of(streams.MANEUVERS, "status") == statuses
    assert words_of(streams.LINKS, "outcome") == OUTCOMES
    assert words_of(streams.STUCK_THRUSTERS, "state") == get_args(BurnState)
