"""How often an agent records its truth."""

import pytest
from constellation_fakes import Star, parameters, state_rows

from madns_runtime.simulations.constellation.check import find_faults
from madns_runtime.simulations.constellation.record_rates import RecordedTicks


def test_state_is_recorded_as_often_as_the_scenario_says_on_ticks_that_all_agents_share():
    star = Star(parameters(record={"state_hz": 2.0}), 2, tick_hz=10.0, duration_s=2.0)

    star.run(2.0)

    for name in star.agents:
        assert [row[0] for row in state_rows(star, name).tolist()] == [0, 5, 10, 15]
    assert [summary["ticks_served"] for summary in star.summaries().values()] == [20, 20]


@pytest.mark.parametrize(
    ("state_hz", "ticks"),
    [
        (3.0, [0, 3, 7, 10, 13, 17]),
        (7.0, [0, 1, 3, 4, 6, 7, 9, 10, 11, 13, 14, 16, 17, 19]),
        (0.9, [0, 11]),
    ],
)
def test_a_rate_that_does_not_divide_the_ticks_is_kept_in_the_mean(state_hz, ticks):
    record = {"state_hz": state_hz, "elements_hz": state_hz}
    star = Star(parameters(record=record), 1, tick_hz=10.0, duration_s=2.0)

    star.run(2.0)

    [name] = star.agents
    assert [row[0] for row in state_rows(star, name).tolist()] == ticks
    assert [row[0] for row in star.contexts[name].records["elements"]] == ticks


@pytest.mark.parametrize(
    ("rate_hz", "tick_hz", "every"),
    [(0.1, 10.0, 100), (1e-9, 100.0, 10**11), (0.3, 0.9, 3), (10.0, 10.0, 1), (25.0, 10.0, 1)],
)
def test_a_rate_that_divides_the_ticks_is_kept_to_the_tick_however_long(rate_hz, tick_hz, every):
    ticks = RecordedTicks(rate_hz, tick_hz)

    for before in (0, every - 1, every * 10**9, every * 10**9 + every - 1):
        assert ticks.after(before) == before // every * every + every


def test_a_state_for_every_tick_is_the_most(tmp_path):
    def faults(state_hz):
        given = parameters(record={"state_hz": state_hz})
        found = find_faults(given, 1, tmp_path, names=("a",), duration_s=10.0, tick_hz=10.0)
        return [fault for fault in found if "state_hz" in fault]

    assert faults(10.0) == faults(3.0) == []
    [fault] = faults(25.0)
    assert fault.startswith(
        "parameters.record.state_hz: expected at most agents.tick_hz, 10 Hz, got 25: "
    )
