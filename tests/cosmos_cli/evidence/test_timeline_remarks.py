"""Remarks on actions that were refused, of a timeline and of those that were ordered live."""

import json
from types import SimpleNamespace

import numpy as np

from cosmos_cli.evidence.timeline_remarks import timeline_remarks

LIVE = SimpleNamespace(timeline=(), conditions=())
"""A run whose scenario has no timeline."""
REFUSAL = ("action_refused", {"action": "leak", "reason": "no valve here"})


class Events:
    """Events of some sources, as a table; counts how often it is read."""

    def __init__(self, by_source):
        self._by_source = by_source
        self.sources = tuple(by_source)
        self.reads = 0

    def has(self, *names):
        return True

    def batches(self, source, names, rows_max):
        self.reads += 1
        words, details = zip(*self._by_source[source], strict=True)
        told = np.array([None if one is None else json.dumps(one) for one in details], dtype=object)
        yield {"event": np.array(words, dtype=object), "details": told}


def test_refusals_of_actions_that_were_ordered_live_are_told_without_a_timeline():
    began = ("action_began", {"action": "leak"})
    tables = {
        "host_events": Events({"host": [("state", None), began]}),
        "events": Events({"agent-01": [("start", None), REFUSAL]}),
    }

    told = timeline_remarks(LIVE, tables)

    assert told == ("timeline: leak was refused 1 time by agent-01: no valve here",)


def test_agents_of_a_run_in_which_nothing_was_ordered_are_not_asked():
    agents = Events({"agent-01": [REFUSAL]})

    assert timeline_remarks(LIVE, {"host_events": Events({"host": [("start", None)]}), "events": agents}) == ()  # fmt: skip
    assert agents.reads == 0


def test_nothing_is_told_of_a_run_without_events():
    assert timeline_remarks(LIVE, {}) == timeline_remarks(None, {}) == ()
