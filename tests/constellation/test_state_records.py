"""How often an agent records its truth."""

from constellation_fakes import Star, parameters, state_rows


def test_state_is_recorded_as_often_as_the_scenario_says_on_ticks_that_all_agents_share():
    star = Star(parameters(record={"state_hz": 2.0}), 2, tick_hz=10.0, duration_s=2.0)

    star.run(2.0)

    for name in star.agents:
        assert [row[0] for row in state_rows(star, name).tolist()] == [0, 5, 10, 15]
    assert [summary["ticks_served"] for summary in star.summaries().values()] == [20, 20]
