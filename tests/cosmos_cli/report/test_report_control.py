"""Slots judged by recorded truth: against what was put in, against what was believed, and with holes."""

import dataclasses
import math
import sys

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.diff.side import open_side
from cosmos_cli.evidence.tables import open_recorded_run, open_tables
from cosmos_cli.report.build import build_sections, with_simulation
from madns_runtime.analysis.tables import ComparedRun
from madns_runtime.analysis.values import Figure, TableBlock
from madns_runtime.recording.records import Field, StreamSchema
from madns_runtime.simulations.constellation.analysis.comparison import compare_runs
from madns_runtime.simulations.constellation.analysis.slots import read_control
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    osculating_from_mean,
    secular_rates,
    state_from_circular,
)

COMPONENTS = ("x_teme_m", "y_teme_m", "z_teme_m", "vx_teme_m_s", "vy_teme_m_s", "vz_teme_m_s")
STATE = StreamSchema("state", (Field("tick", "", "int"), *(Field(name) for name in COMPONENTS)))
ESTIMATES = StreamSchema("estimates", (Field("tick", "", "int"), Field("slot_error_deg", "deg")))
RESULTS = StreamSchema(
    "command_results",
    (
        Field("tick", "", "int"),
        Field("status", "", "str"),
        Field("at_s", "s"),
        Field("delta_v_m_s", "m/s"),
    ),
)
MESSAGES = StreamSchema(
    "messages", (Field("tick", "", "int"), Field("way", "", "str"), Field("sent_s", "s"))
)
TICKS = 5


def written(
    tmp_path,
    places_deg,
    *,
    slots="even",
    sma_m=(),
    skipped=(),
    lost=(),
    dead=(),
    raan_deg=(),
    crosslinks=None,
    rules=None,
    **more,
):
    """A run at 1/600 Hz: satellite i at places_deg[i](tick); *skipped* record nothing, *lost* two ticks, *dead* no beliefs."""
    count = len(places_deg)
    settings = {"slots": slots, **more} if slots else {}
    flight = rules or {"settings": settings}
    parameters = {"flight": flight, "crosslinks": crosslinks}
    config = make_config(count, ticks=TICKS, tick_hz=1 / 600, parameters=parameters)
    config = dataclasses.replace(config, simulation="constellation")
    made = SyntheticRun(tmp_path, config).write()
    for number, name in enumerate(made.names):
        if number in skipped:
            continue
        recorder = made.recorder(f"agents/{name}", name, STATE, ESTIMATES, RESULTS, MESSAGES)
        for tick in range(2 if number in lost else TICKS):
            mean = CircularElements(
                a_m=EGM_96.radius_m + 780e3 + (sma_m[number] if sma_m else 0.0),
                ex=1e-4,
                ey=0.0,
                i_rad=math.radians(86.4),
                raan_rad=math.radians(raan_deg[number] if raan_deg else 10.0),
                lam_rad=0.0,
            )
            turned = secular_rates(mean, EGM_96).lam_rad_s * 600.0 * tick
            lam_rad = (turned + math.radians(places_deg[number](tick))) % math.tau
            mean = CircularElements(
                a_m=mean.a_m, ex=mean.ex, ey=mean.ey, i_rad=mean.i_rad,
                raan_rad=mean.raan_rad, lam_rad=lam_rad,
            )  # fmt: skip
            state = state_from_circular(osculating_from_mean(mean, EGM_96), EGM_96.mu_m3_s2)
            recorder.record("state", (tick, *state))
            if number not in dead:
                recorder.record("estimates", (tick, 0.5))
            recorder.record("messages", (tick, "sent", 600.0 * tick))
            recorder.record("messages", (tick, "received", 600.0 * tick))
        recorder.record("command_results", (3, "accepted", 1200.0, 0.25))
        recorder.record("command_results", (3, "executed", 1200.0, 0.25 * (number + 1)))
        recorder.close()
    summary = finish_run(made.run, made.result(), made.expected)
    return made, summary.document


def rows_of(made):
    return read_control(open_tables(made.run.tables), made.config)


def test_slot_error_is_what_truth_says_and_not_what_was_believed(tmp_path):
    errors = (0.3, -0.1, -0.1, -0.1)
    # The errors die out linearly; the common phase of 77 deg and its motion are nobody's error.
    places = [
        lambda tick, n=n: 77.0 + 2.0 * tick + 90.0 * n + errors[n] * (1 - tick / 4)
        for n in range(4)
    ]
    made, _ = written(tmp_path, places)

    rows = rows_of(made)

    start = math.sqrt(np.mean(np.square(errors)))
    expected = [start * (1 - tick / 4) for tick in range(TICKS)]
    assert [row.slot_error_deg_rms for row in rows] == pytest.approx(expected, abs=1e-3)
    assert rows[0].slot_error_deg_max == pytest.approx(0.3, abs=1e-3)
    assert {row.slot_error_estimated_deg_rms for row in rows} == {0.5}
    assert rows[0].height_km == pytest.approx(780.0, abs=0.02)


EVEN = {"slots": "even", "spacing_deg": 90.0}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ((EVEN, EVEN), [4] * TICKS),
        (({}, EVEN), [4] * TICKS),
        ((EVEN, {**EVEN, "spacing_deg": 60.0}), []),
        (({}, {}), []),
    ],
)
def test_slots_are_judged_by_what_the_rules_of_flight_software_agree_on(
    tmp_path, settings, expected
):
    rules = [
        "coasting.py:Coasting",
        *({"software": f"{n}.py:Keeper", "settings": each} for n, each in enumerate(settings)),
    ]
    made, _ = written(tmp_path, [lambda tick, n=n: 90.0 * n for n in range(4)], rules=rules)

    rows = rows_of(made)

    assert [row.satellites for row in rows] == expected
    assert [row.slot_error_deg_max for row in rows] == pytest.approx([0.0] * len(rows), abs=1e-3)


def test_delta_v_counts_once_executed_and_messages_once_sent(tmp_path):
    made, _ = written(tmp_path, [lambda _t, n=n: 120.0 * n for n in range(3)])

    rows = rows_of(made)

    assert [row.delta_v_m_s_mean for row in rows] == pytest.approx([0, 0, 0.5, 0.5, 0.5])
    assert rows[-1].delta_v_m_s_max == 0.75
    assert [row.messages for row in rows] == [3, 6, 9, 12, 15]


@pytest.mark.slow
def test_two_runs_are_judged_at_times_of_both_and_then_of_the_longer(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "TICKS", 200)
    places = [lambda _t, n=n: 120.0 * n for n in range(3)]
    short, _ = written(tmp_path, places)
    monkeypatch.setattr(sys.modules[__name__], "TICKS", 450)
    long, _ = written(tmp_path, places)
    sides = [open_side(made.run, made.run.name) for made in (short, long)]
    runs = [
        ComparedRun(
            run=open_recorded_run(side.run, side.document), streams=side.streams, identical={}
        )
        for side in sides
    ]

    found = compare_runs(*runs)

    of_short, of_long = ([row.t_s for row in rows] for rows in found.slots)
    assert of_long[: len(of_short)] == of_short
    assert (of_short[0], of_long[-1]) == (0.0, 449 * 600.0)
    assert max(of_short) > 190 * 600.0
    assert all(row.slot_error_deg_rms < 1e-3 for row in found.slots[1])
    assert found.slots[1][-1].messages == 3 * 450


def test_agent_that_recorded_nothing_leaves_its_slot_empty_and_the_others_where_they_are(tmp_path):
    made, _ = written(tmp_path, [lambda _t, n=n: 90.0 * n for n in range(4)], skipped=(1,))

    rows = rows_of(made)

    assert [row.slot_error_deg_rms for row in rows] == pytest.approx([0.0] * TICKS, abs=1e-3)


def test_slots_are_judged_to_the_end_when_the_first_agent_is_lost(tmp_path):
    made, _ = written(tmp_path, [lambda _t, n=n: 90.0 * n for n in range(4)], lost=(0,))

    rows = rows_of(made)

    assert [row.t_s for row in rows] == pytest.approx([600.0 * tick for tick in range(TICKS)])
    assert [row.satellites for row in rows] == [4, 4, 3, 3, 3]


def test_slots_of_a_chain_are_as_far_apart_as_the_scenario_says(tmp_path):
    places = [lambda t, n=n: 300.0 + t + 2.5 * n + 0.1 * (-1) ** n for n in range(4)]
    made, _ = written(tmp_path, places, spacing_deg=2.5)

    rows = rows_of(made)

    assert [row.slot_error_deg_rms for row in rows] == pytest.approx([0.1] * TICKS, abs=1e-3)


@pytest.mark.parametrize("slots", ["even", "kept"])
def test_dead_satellite_has_a_place_in_the_order_and_no_slot(tmp_path, slots):
    # It drifts away by 3 deg a tick, and flies no software that believes anything.
    places = [lambda t, n=n: 90.0 * n + (3.0 * t if n == 1 else 0.0) for n in range(4)]
    made, _ = written(tmp_path, places, slots=slots, dead=(1,))

    rows = rows_of(made)

    assert [row.slot_error_deg_rms for row in rows] == pytest.approx([0.0] * TICKS, abs=1e-3)
    assert {row.satellites for row in rows} == {3}


def test_kept_slots_are_those_of_the_start_within_each_plane(tmp_path):
    # Two in one plane part by 0.2 deg a tick; a third in another plane and a fourth far above have no one.
    places = [
        lambda t: 0.1 * t,
        lambda t: 40.0 - 0.1 * t,
        lambda t: 5.0 * t,
        lambda t: 80.0 + 3.0 * t,
    ]
    made, _ = written(
        tmp_path, places, slots="kept", raan_deg=(10, 11, 60, 10), sma_m=(0, 100, 0, 20e3)
    )

    rows = rows_of(made)

    expected = [0.1 * tick for tick in range(TICKS)]
    assert [row.slot_error_deg_rms for row in rows] == pytest.approx(expected, abs=2e-3)
    assert {row.satellites for row in rows} == {2}


def test_kept_slots_are_of_those_who_hear_each_other(tmp_path):
    # 100 deg apart the Earth is between the pairs, which part by 10 deg a tick; each pair by 0.2.
    places = [
        lambda t: 0.1 * t,
        lambda t: 30.0 - 0.1 * t,
        lambda t: 150.0 + 10.1 * t,
        lambda t: 180.0 + 9.9 * t,
    ]
    made, _ = written(tmp_path, places, slots="kept", crosslinks={"range_km_max": 20_000})

    rows = rows_of(made)

    expected = [0.1 * tick for tick in range(TICKS)]
    assert [row.slot_error_deg_rms for row in rows] == pytest.approx(expected, abs=2e-3)
    assert {row.satellites for row in rows} == {4}


def test_report_and_json_show_the_slots(tmp_path):
    made, document = written(tmp_path, [lambda _t, n=n: 120.0 * n for n in range(3)])

    sections = {s.title: s.blocks for s in build_sections(made.run, document)}
    told = with_simulation(made.run, document, pytest.fail)["control"]

    titles = [block.title for block in sections["Control"] if isinstance(block, Figure)]
    table = next(block for block in sections["Control"] if isinstance(block, TableBlock))
    assert titles[:2] == ["Slot error, by truth", "Delta-v given"]
    assert table.title == "Slots over time"
    assert len(table.rows) == TICKS
    assert told["slots"] == "even"
    assert told["rows"][-1]["messages"] == 15


def test_run_without_slots_is_told_as_before(tmp_path):
    made, document = written(tmp_path, [lambda _t: 0.0], slots="")

    assert rows_of(made) == ()
    assert with_simulation(made.run, document, pytest.fail) == document
