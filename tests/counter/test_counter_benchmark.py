"""The numbers of the thesis's benchmark from records: missed ticks among them that no tick followed."""

from types import SimpleNamespace

import numpy as np
import pytest

from madns_runtime.analysis.tables import RecordedRun
from madns_runtime.simulations.counter.analysis.benchmark import document


def table(**missed):
    """Stand for a table of one column per agent."""
    return SimpleNamespace(
        sources=tuple(missed),
        has=lambda *names: set(names) <= {"missed"},
        batches=lambda agent, names, rows_max: iter([{"missed": np.array(missed[agent])}]),
    )


@pytest.mark.parametrize(
    ("late", "absent", "missed"),
    [
        ({}, None, 3),
        ({"a": [1, 2]}, 0, 3),
        ({"a": [1, 2, 5], "b": [9]}, 0, 8),
        ({"a": [1, 2]}, 65, 68),
        ({}, 68, 68),
    ],
)
def test_missed_ticks_that_no_tick_followed_count_and_those_of_a_killed_agent(late, absent, missed):
    run = RecordedRun(
        document={
            "simulation": {"agents": {"a": {"sent": 7, "returned": 6, "lost": 1}}},
            "timing": {"causes_by_agent": {"a": {"absent": absent}}},
        },
        tables={"ticks": table(a=[0, 1, 0, 2]), "late_ticks": table(**late)},
        config=None,
    )

    assert document(run)["benchmark"]["agents"] == {
        "a": {"sent": 7, "returned": 6, "lost": 1, "ticks": 4, "missed": missed}
    }


def test_an_agent_that_never_ran_a_tick_has_missed_what_run_json_tells():
    run = RecordedRun(
        document={
            "simulation": {"agents": {"a": {}, "b": {}}},
            "timing": {"causes_by_agent": {"b": {"absent": 40}}},
        },
        tables={"ticks": table(a=[0, 1])},
        config=None,
    )

    agents = document(run)["benchmark"]["agents"]

    assert (agents["b"]["ticks"], agents["b"]["missed"]) == (0, 40)
    assert sum(of["missed"] for of in agents.values()) == 41
