"""The transparency study: its flight software converges on truth and on measurements, and its scenarios are a pair."""

import json
import math
import os
import subprocess
import sys

import numpy as np
import pytest
from control_harness import SCENARIOS, Fleet, flight_class

from cosmos_cli.diff.compare import differing_keys
from cosmos_cli.models.loading import load_scenario
from madns_runtime.simulations.constellation.flight.api import TRUTH, Reading
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.orbit.mean_elements import (
    CircularElements,
    mean_from_state,
    osculating_from_mean,
    secular_rates,
    state_from_circular,
    wrapped,
)

OFFSETS_DEG = (0.3, -0.2)
SETTINGS = {"time_constant_s": 6000.0, "period_s": 3000.0}
HALF_DAY_S = 43_200.0
TRUTH_FED, SENSOR_FED = (SCENARIOS / f"transparency_{kind}.yaml" for kind in ("truth", "sensors"))


def slot(index, offset_deg=0.0):
    return CircularElements(
        a_m=7_158_137.0,
        ex=0.0,
        ey=0.0,
        i_rad=math.radians(53.0),
        raan_rad=0.0,
        lam_rad=math.radians(60.0 * index + offset_deg),
    )


def slot_errors_deg(states, t_s):
    """By truth, against slots that turn with the ring."""
    rate = secular_rates(slot(0), EGM_96).lam_rad_s
    return [
        math.degrees(
            wrapped(
                mean_from_state(tuple(s[:3]), tuple(s[3:]), EGM_96).lam_rad
                - slot(index).lam_rad
                - rate * t_s
            )
        )
        for index, s in enumerate(np.asarray(states).tolist())
    ]


def guidance():
    return flight_class("transparency.py", "Guidance")


def measuring():
    """The same software behind a receiver with noise, whose fixes are known a tick late."""

    class Measuring(guidance()):
        late, random = None, np.random.default_rng(5)

        def step(self, t_s, readings):
            position_m = self.random.normal(0.0, 5.0, 3)
            noise = np.concatenate((position_m, self.random.normal(0.0, 0.05, 3)))
            values = tuple((np.array(readings[TRUTH].values) + noise).tolist())
            known, self.late = self.late, Reading(t_s, values)
            super().step(t_s, {} if known is None else {"gnss": known})

    return Measuring


def fly(software, *, until_s=HALF_DAY_S, sign=1.0):
    states = []
    for index, offset_deg in enumerate(OFFSETS_DEG):
        osculating = osculating_from_mean(slot(index, offset_deg), EGM_96)
        states.append(state_from_circular(osculating, EGM_96.mu_m3_s2))
    fleet = Fleet(software, states, settings=SETTINGS, tick_s=30.0, sign=sign)
    fleet.run(until_s)
    return fleet


@pytest.mark.slow
def test_fed_with_truth_it_reaches_its_slot():
    fleet = fly(guidance())

    assert slot_errors_deg(fleet.states, fleet.t_s) == pytest.approx([0.0, 0.0], abs=5e-4)
    assert all(1.0 < spent < 6.0 for spent in fleet.delta_v_m_s)


@pytest.mark.slow
def test_fed_with_measurements_it_reaches_its_slot_and_knows_where_it_is():
    fleet = fly(measuring())

    errors_deg = slot_errors_deg(fleet.states, fleet.t_s)
    believed_deg = [one.finish()["slot_error_deg"] for one in fleet.software]
    assert errors_deg == pytest.approx([0.0, 0.0], abs=2e-3)
    assert believed_deg == pytest.approx(errors_deg, abs=5e-4)


def test_thrusters_the_wrong_way_round_are_noticed():
    fleet = fly(guidance(), until_s=HALF_DAY_S / 3, sign=-1.0)

    assert max(map(abs, slot_errors_deg(fleet.states, fleet.t_s))) > 0.3


@pytest.mark.process
def test_pair_differs_in_what_the_study_varies_alone():
    truth, sensors = (load_scenario(path).to_mapping() for path in (TRUTH_FED, SENSOR_FED))

    keys = {one.key for one in differing_keys(truth, sensors)}
    varied = ("name", "parameters.vehicles[0].sensors", "parameters.vehicles[0].thruster")
    assert {k for k in keys if not k.startswith(varied)} == {"parameters.flight.input"}
    assert "parameters.vehicles[0].thruster.magnitude_error" in keys
    assert truth["seed"] == sensors["seed"]


@pytest.mark.process
def test_one_command_runs_both_and_prints_the_difference(tmp_path):
    environment = os.environ | {
        "COSMOS_STATE_DIR": str(tmp_path / "state"),
        "COSMOS_RUNS": str(tmp_path / "runs"),
    }
    short = ("--duration", "240", "--set", "agents.count=2")
    settings = "parameters.flight.settings"
    often = ("--set", f"{settings}.period_s=60", "--set", f"{settings}.estimate_s=10")
    command = [sys.executable, "-m", "cosmos_cli.start", "diff", "--run", TRUTH_FED, SENSOR_FED]

    done = subprocess.run(
        [*map(str, command), *short, *often, "--json", "--quiet", "--expect-same"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )

    assert done.returncode == 1, done.stderr  # they differ, and not to differ was asked for
    found = json.loads(done.stdout)
    constellation = found["constellation"]
    assert found["runs"] == {"a": "0001-transparency-truth", "b": "0002-transparency-sensors"}
    assert 0.0 < constellation["truth"]["all"]["max_m"] < 1000.0
    assert constellation["measurements"][0]["errors"][0] is None
    assert 5.0 < constellation["measurements"][0]["errors"][1]["rms"] < 40.0
    assert all(one["given_m_s"] > 1.0 for one in constellation["control"]["all"])
    assert all(rows for rows in constellation["slots"])
