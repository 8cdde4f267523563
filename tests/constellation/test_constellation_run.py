"""Both halves against a fake context: whole runs, and segments late, lost and early."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import orjson
import pytest
from constellation_fakes import IRIDIUM, Star, parameters, state_rows

from madns_runtime.errors import PluginError
from madns_runtime.simulations.constellation.orbit.constants import GRAVITY_MODELS
from madns_runtime.simulations.constellation.streams import ELEMENTS
from madns_runtime.simulations.constellation.truth.initial_states import load_fleet
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    load_propagator,
)

BYTES_PER_TICK_MAX = 110


@pytest.mark.parametrize("kind", ["scipy", "sgp4"])
def test_sixty_seconds_serve_every_tick_with_the_propagators_own_states(kind):
    params = parameters(IRIDIUM, propagator={"kind": kind})
    star = Star(params, 10)

    star.run(60.0)

    fleet = load_fleet(params, 10, star.context.base_directory)
    times_s = np.arange(600) / 10
    truth = load_propagator(kind).propagate(
        fleet.states,
        0.0,
        times_s,
        PropagationParameters(
            settings=params.propagator,
            gravity=GRAVITY_MODELS[params.gravity],
            epoch_utc=fleet.epoch_utc,
            element_sets=fleet.element_sets,
        ),
    )
    for number, name in enumerate(star.agents):
        rows = state_rows(star, name)
        assert rows[:, 0].tolist() == list(range(600))
        # Records are rounded to 10 um and 10 nm/s; SGP4's positions carry noise of 1e-5 m.
        noise_m_s = 3e-5 if kind == "sgp4" else 0.0
        assert np.abs(rows[:, 1:4] - truth[number, :, :3]).max() < 0.7e-4
        assert np.abs(rows[:, 4:] - truth[number, :, 3:]).max() < 1.3e-7 + noise_m_s
    assert star.underruns() == 0


def test_every_agent_reports_a_passed_underrun_check():
    star = Star(parameters(), 4)

    star.run(60.0)

    for summary in star.summaries().values():
        assert summary["checks"] == [
            {"name": "constellation.underruns", "limit": 0, "got": 0, "passed": True}
        ]
        assert summary["ticks_served"] == 600
        assert summary["joint_gap_m_max"] == 0.0


def test_no_agent_has_less_than_half_its_buffer_when_its_refill_comes():
    star = Star(parameters(segments={"buffer_s": 8.0, "knot_s": 0.5}), 7)

    star.run(60.0)

    for summary in star.summaries().values():
        assert 4.0 - 0.02 <= summary["left_at_refill_s_min"] <= 6.0


@pytest.mark.slow
def test_refills_are_spread_so_that_no_instant_sees_a_burst():
    star = Star(parameters(), 60, duration_s=60.0)

    star.run(60.0)

    sent_s = sorted(sent_s for sent_s, _, _ in star.context.sent)
    in_window = [
        sum(1 for t in sent_s if start <= t < start + 0.1) for start in np.arange(0, 60, 0.1)
    ]
    # 60 segments in 5 s of every 10 s.
    assert max(in_window) <= 3
    assert len(sent_s) == 60 * 4


def test_ticks_between_knots_are_served_at_any_rate():
    star = Star(parameters(), 2, tick_hz=50.0, duration_s=25.0)

    star.run(25.0)

    assert star.underruns() == 0
    assert len(state_rows(star, "agent-01")) == 25 * 50


def test_a_segment_later_than_its_buffer_is_an_underrun_that_breaks_the_check():
    late = {"agent-02": 12.0}
    star = Star(parameters(), 3, delay_s=lambda sent_s, agent: late.get(agent, 0.005))

    star.run(60.0)

    summaries = star.summaries()
    assert summaries["agent-01"]["underruns"] == summaries["agent-03"]["underruns"] == 0
    broken = summaries["agent-02"]
    assert broken["underruns"] > 0
    assert broken["underruns"] + broken["ticks_served"] == 600
    assert broken["checks"][0]["passed"] is False


def test_a_segment_later_than_planned_but_within_the_buffer_costs_nothing():
    star = Star(parameters(), 3, delay_s=lambda sent_s, agent: 9.5)

    star.run(60.0)

    assert star.underruns() == 0


def test_a_lost_segment_leaves_a_hole_of_exactly_its_length():
    star = Star(
        parameters(),
        2,
        delay_s=lambda sent_s, agent: None if agent == "agent-01" and 15 < sent_s < 25 else 0.005,
    )

    star.run(60.0)

    ticks = state_rows(star, "agent-01")[:, 0].tolist()
    missing = sorted(set(range(600)) - set(map(int, ticks)))
    # The window's first and last knots belong to its neighbours too.
    assert missing == list(range(301, 400))
    assert star.summaries()["agent-01"]["underruns"] == 99


def test_segments_out_of_order_are_put_in_order():
    star = Star(
        parameters(),
        1,
        delay_s=lambda sent_s, agent: 9.5 if 5 < sent_s < 15 else 0.0,
    )

    star.run(60.0)

    assert star.underruns() == 0
    assert star.summaries()["agent-01"]["joint_gap_m_max"] == 0.0


def test_an_agent_that_rejoins_flies_on_along_the_same_orbit():
    whole, broken = Star(parameters(), 3), Star(parameters(), 3)
    whole.run(60.0)
    broken.run(23.0)
    broken.host.agent_lost("agent-02", "killed")
    del broken.agents["agent-02"]
    broken.run(31.37, from_s=23.0)

    broken.join("agent-02")
    broken.run(33.0, from_s=31.37)
    broken.host.agent_rejoined("agent-02")
    broken.run(60.0, from_s=33.0)

    rows = {int(row[0]): row for row in state_rows(broken, "agent-02")}
    expected = {int(row[0]): row for row in state_rows(whole, "agent-02")}
    assert set(expected) - set(rows) == set(range(230, 314))
    assert all((rows[tick] == expected[tick]).all() for tick in rows)
    assert broken.underruns() == 0


def test_a_refill_due_between_initial_data_and_rejoining_is_not_missed():
    star = Star(parameters(), 3)
    star.run(13.0)
    star.host.agent_lost("agent-03", "killed")
    del star.agents["agent-03"]
    star.run(14.0, from_s=13.0)
    star.join("agent-03")
    star.run(29.0, from_s=14.0)

    star.host.agent_rejoined("agent-03")
    star.run(60.0, from_s=29.0)

    assert star.underruns() == 0


def test_a_lost_agent_is_sent_nothing():
    star = Star(parameters(), 2)
    star.run(12.0)
    star.host.agent_lost("agent-01", "killed")
    sent = len(star.context.sent)

    star.run(60.0, from_s=12.0)

    assert {to for _, to, _ in star.context.sent[sent:]} == {"agent-02"}


def test_truth_that_comes_too_late_is_counted_and_named():
    star = Star(parameters(), 2)
    star.job_s = 18.0

    star.run(20.0)

    # Asked for at 0 s, due for the first of two agents at 17.5 s.
    summary = star.host.finish()
    assert summary["truth_late"] == 1
    assert summary["truth_late_s_max"] == pytest.approx(18.0 - 17.5, abs=0.02)
    assert [level for level, text in star.context.logs if "too late" in text] == ["warning"]


def test_never_more_than_one_propagation_is_under_way():
    star = Star(parameters(), 2)
    star.job_s = 1e9

    star.run(30.0)

    assert len(star.context.jobs) == 2
    summary = star.host.finish()
    assert summary["truth_late"] == 1
    assert summary["truth_late_s_max"] == pytest.approx(30.0 - 17.5, abs=0.02)
    (text,) = (text for level, text in star.context.logs if level == "warning")
    assert text.startswith("truth from 30 s on has not come, by now 12.490 s too late; ")


def test_late_truth_is_sent_as_soon_as_it_is_there():
    star = Star(parameters(), 2)
    star.job_s = 45.0
    star.run(44.0)
    star.job_s = 0.01

    star.run(60.0, from_s=44.0)

    # Truth is held until 30 s; the next comes at 45 s and the following ones at once.
    for summary in star.summaries().values():
        assert 149 <= summary["underruns"] <= 152


def test_the_host_keeps_only_the_windows_it_may_still_need():
    star = Star(parameters(), 2, duration_s=300.0)

    star.run(200.0, step_s=0.1)

    store = star.host._store
    assert store.end - store.oldest <= 5


def test_invariants_are_recorded_for_every_vehicle_and_window():
    star = Star(parameters(), 3)

    star.run(60.0)

    rows = star.context.records["invariants"]
    # The last window's turn comes half a window before the one it follows ends.
    assert sorted((row[0], row[1]) for row in rows) == [
        (10.0 * window, name) for window in range(1, 7) for name in sorted(star.agents)
    ]
    assert all(row[2] < 0 for row in rows)
    summary = star.host.finish()
    assert summary["energy_drift_max"] < 1e-13
    assert summary["checks"][0]["passed"] is True


def test_sgp4_energy_is_recorded_and_not_judged():
    star = Star(parameters(IRIDIUM, propagator={"kind": "sgp4"}), 3)

    star.run(60.0)

    assert len(star.context.records["invariants"]) == 18
    assert star.host.finish()["checks"] == []


def test_recorded_bytes_stay_within_budget():
    star = Star(parameters(IRIDIUM), 10)

    star.run(60.0)

    for context in star.contexts.values():
        total = sum(len(orjson.dumps(row)) + 1 for rows in context.records.values() for row in rows)
        assert total / 600 <= BYTES_PER_TICK_MAX


def test_elements_are_recorded_at_their_own_rate():
    star = Star(parameters(record={"elements_hz": 2.0}), 1)

    star.run(10.0)

    ticks = [row[0] for row in star.contexts["agent-01"].records["elements"]]
    assert ticks == list(range(0, 100, 5))


def test_angles_of_elements_are_below_a_whole_turn_on_record():
    orbit = {"name": "a", "altitude_km": 550, "e": 0.01, "i_deg": 56}
    two_body = {"kind": "scipy", "forces": ["two_body"]}
    star = Star(parameters({"keplerian": [orbit]}, propagator=two_body), 1)

    star.run(60.0)

    rows = star.contexts["agent-01"].records["elements"]
    digits = [field.digits for field in ELEMENTS]
    recorded = [list(map(round, row[4:], digits[4:])) for row in rows]
    assert len(recorded) == 60
    assert max(map(max, recorded)) < 360.0
    # Of an orbit whose perigee lies at its node: rounding errors fall to both sides of 0.
    assert max(min(row[1], 360.0 - row[1]) for row in recorded) < 1e-6


def test_initial_data_name_satellite_frame_and_epoch():
    star = Star(parameters(IRIDIUM), 10)

    initial = star.host.initial_data("agent-06")

    assert initial["satellite"] == "IRIDIUM 914"
    assert initial["frame"] == "TEME"
    assert initial["epoch_utc"] == "2017-03-07T13:32:57Z"
    assert initial["segment"]["states"].dtype == np.float64
    assert initial["segment"]["states"].shape == (21, 6)


def test_a_run_shorter_than_one_window_needs_no_refill():
    star = Star(parameters(), 2, duration_s=3.0)

    star.run(3.0)

    assert star.underruns() == 0
    assert star.context.sent == []


@pytest.mark.parametrize(
    "message",
    [
        None,
        {"kind": "other"},
        {"kind": "segment"},
        {"kind": "segment", "revision": 0, "t0_s": 0.0, "knot_s": 1.0, "states": np.zeros(11)},
        {"kind": "segment", "revision": 0, "t0_s": 0.0, "knot_s": 0.0, "states": np.zeros(12)},
        {"kind": "segment", "revision": 0, "t0_s": 0.0, "knot_s": 1.0, "states": [np.nan] * 12},
    ],
)
def test_a_message_that_is_no_segment_is_refused_by_name(message):
    star = Star(parameters(), 1)

    with pytest.raises(PluginError, match="segment"):
        star.agents["agent-01"].receive(message)


def test_the_timer_asks_for_times_that_move_forward():
    star = Star(parameters(), 3)
    star.context.clock_s = 0.0
    times = [0.0]
    while (following := star.host.timer(times[-1])) is not None and len(times) < 1000:
        times.append(following)
        star.context.clock_s = following
        star._run_jobs(all_now=True)

    assert all(b > a for a, b in pairwise(times))
    assert len(times) < 1000


@pytest.mark.process
def test_the_agents_half_needs_neither_scipy_nor_sgp4():
    code = (
        "import sys, madns_runtime.simulations.constellation.agent\n"
        "print([m for m in ('scipy', 'sgp4', 'pydantic') if m in sys.modules])"
    )

    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )

    assert done.stdout.strip() == "[]"


@pytest.mark.process
def test_naming_and_checking_a_constellation_loads_neither_scipy_nor_sgp4():
    code = (
        "import sys\n"
        "from madns_runtime.simulations.constellation import simulation\n"
        "import madns_runtime.simulations.constellation.check\n"
        "print([m for m in ('scipy', 'sgp4', 'pydantic') if m in sys.modules])"
    )

    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )

    assert done.stdout.strip() == "[]"
