"""Truth, measurements, estimates and control of two runs of a constellation, apart."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli import app
from cosmos_cli.collect.finish import finish_run
from madns_runtime.recording.records import Field, StreamSchema
from madns_runtime.simulations.constellation import streams
from madns_runtime.simulations.constellation.analysis.measurement_errors import QUATERNION, Quantity

TICKS, TICK_HZ = 200, 1.0
STATE = StreamSchema(
    "state",
    (
        Field("tick", "", "int"),
        *(Field(f"{axis}_teme_m", "m") for axis in "xyz"),
        *(Field(f"v{axis}_teme_m_s", "m/s") for axis in "xyz"),
    ),
)
GNSS = StreamSchema("gnss", (Field("tick", "", "int"), Field("t_s", "s"), *STATE.fields[1:]))
ESTIMATES = StreamSchema("estimates", (Field("tick", "", "int"), Field("slot_error_deg", "deg")))
COMMANDS = StreamSchema(
    "commands",
    (
        Field("tick", "", "int"),
        Field("number", "", "int"),
        Field("kind", "", "str"),
        *(Field(axis, "m/s") for axis in "xyz"),
    ),
    shape="object",
)
MANEUVERS = StreamSchema(
    "maneuvers",
    (
        Field("agent", "", "str"),
        Field("number", "", "int"),
        Field("commanded_s", "s"),
        Field("at_s", "s"),
        Field("executed_s", "s"),
        Field("dv_given_m_s", "m/s"),
        Field("propagation_s", "s"),
        Field("network_s", "s"),
        Field("slack_s", "s"),
    ),
    shape="object",
)
ATTITUDE = StreamSchema("attitude", streams.ATTITUDE)
DATA = r'<script type="application/json" id="data">(.*)</script>'
RADIUS_M, SPEED_M_S, RATE = 7e6, 7500.0, 7500.0 / 7e6


def state(tick, along_m=0.0):
    """A circle in the x-y plane, *along_m* ahead."""
    angle = RATE * tick / TICK_HZ + along_m / RADIUS_M
    c, s = np.cos(angle), np.sin(angle)
    return (RADIUS_M * c, RADIUS_M * s, 0.0, -SPEED_M_S * s, SPEED_M_S * c, 0.0)


class Flown(SyntheticRun):
    """A run of satellites whose truth, measurements, estimates and commands are made up."""

    def fly(
        self,
        *,
        along_m,
        noise_m,
        slot_error_deg,
        delta_v_m_s,
        turned_deg=None,
        rate_rad_s=0,
        apart_m=None,
        begin_s=10.0,
    ):
        host = self.recorder("host", "host", MANEUVERS)
        for number, name in enumerate(self.names):
            recorder = self.recorder(f"agents/{name}", name, STATE, GNSS, ESTIMATES, COMMANDS)
            if turned_deg is not None:
                half = np.radians(turned_deg * (number + 1)) / 2
                body = (0.0, 0.0, np.sin(half), np.cos(half), 0.0, 0.0, rate_rad_s)
                bodies = self.recorder(f"agents/{name}", name, ATTITUDE)
                for tick in range(self.ticks):
                    bodies.record("attitude", (tick, *body))
                bodies.close()
            ahead_m = along_m * (number + 1) if apart_m is None else apart_m[number]
            for tick in range(self.ticks):
                truth = state(tick, ahead_m)
                recorder.record("state", (tick, *truth))
                if tick >= 2:  # measured two ticks ago
                    x, *rest = state(tick - 2, ahead_m)
                    recorder.record("gnss", (tick, (tick - 2) / TICK_HZ, x + noise_m, *rest))
                recorder.record("estimates", (tick, slot_error_deg))
            command = {"tick": 10, "number": 0, "kind": "delta_v", "x": 0.0, "y": delta_v_m_s}
            recorder.record("commands", command | {"z": 0.0})
            given = {"agent": name, "number": 0, "dv_given_m_s": delta_v_m_s * 0.9}
            times = {"commanded_s": 1.0, "at_s": 10.0, "executed_s": 10.0}
            slack = {"propagation_s": 0.25, "network_s": 0.5, "slack_s": begin_s - 1.0 - 1.25}
            host.record("maneuvers", given | times | slack)
            recorder.close()
        host.close()


@pytest.fixture
def fly(own_places, tmp_path):

    def fly_run(
        *, frame="TEME", epoch="2017-03-07T12:00:00Z", result=None, shutdown_s=None, **what
    ):
        config = make_config(2, ticks=TICKS, tick_hz=TICK_HZ)
        made = Flown(tmp_path / "runs", dataclasses.replace(config, simulation="constellation"))
        flown = {"along_m": 0.0, "noise_m": 0.0, "slot_error_deg": 0.1, "delta_v_m_s": 0.5}
        made.fly(**flown | what)
        made.write(shutdown_s=shutdown_s)
        summary = {"frame": frame, "epoch_utc": epoch}
        ended = made.result(simulation=summary, **result or {})
        finish_run(made.run, ended, made.expected, has_report=False)

    return fly_run


def compared(capsys, *more):
    assert app.run(["diff", "1", "2", "--json", "--quiet", *more]) == 0
    return json.loads(capsys.readouterr().out)["constellation"]


def test_difference_in_position_is_told_by_agent_over_all_and_over_time(fly, capsys):
    fly(), fly(along_m=30.0)

    truth = compared(capsys)["truth"]

    first, second = truth["agents"]["agent-01"], truth["agents"]["agent-02"]
    assert first["rms_m"] == pytest.approx(30.0, rel=1e-6)
    assert second["max_m"] == pytest.approx(60.0, rel=1e-6)
    assert second["along_rms_m"] == pytest.approx(60.0, rel=1e-6)
    assert second["normal_rms_m"] == 0.0
    assert truth["all"]["rms_m"] == pytest.approx(np.sqrt((30.0**2 + 60.0**2) / 2), rel=1e-6)
    assert truth["all"]["count"] == 2 * TICKS
    assert truth["over_time"][-1]["t_s"] == TICKS / TICK_HZ
    assert truth["over_time"][-1]["max_m"] == pytest.approx(60.0, rel=1e-6)


def test_a_satellite_in_the_same_place_counts_over_time_as_over_all(fly, capsys):
    fly(), fly(apart_m=(0.0, 30.0))

    truth = compared(capsys)["truth"]

    assert truth["agents"]["agent-01"]["max_m"] == 0.0
    assert truth["all"]["rms_m"] == pytest.approx(30.0 / np.sqrt(2), rel=1e-6)
    over_time = [row["rms_m"] for row in truth["over_time"]]
    assert over_time == pytest.approx([30.0 / np.sqrt(2)] * len(over_time), rel=1e-6)


def test_same_truth_is_no_distance_apart(fly, capsys):
    fly(), fly(slot_error_deg=0.2)

    truth = compared(capsys)["truth"]

    assert (truth["all"]["rms_m"], truth["all"]["max_m"], truth["all"]["count"]) == (
        0,
        0,
        2 * TICKS,
    )


def test_measurements_are_held_against_the_truth_of_their_own_time(fly, capsys):
    fly(), fly(noise_m=4.0)

    found = compared(capsys)["measurements"]

    errors = {one["quantity"]: one["errors"] for one in found if one["sensor"] == "gnss"}
    assert [e["rms"] for e in errors["position"]] == pytest.approx([0.0, 4.0], abs=1e-6)
    assert errors["position"][1]["count"] == 2 * (TICKS - 2)
    assert errors["velocity"][1]["max"] == 0.0


def test_measurements_of_which_the_tables_alone_are_left_are_the_same(fly, capsys, tmp_path):
    fly(noise_m=4.0), fly(noise_m=4.0)
    shutil.rmtree(tmp_path / "runs" / "0002-synthetic" / "agents")

    assert app.run(["diff", "1", "2", "--json", "--quiet"]) == 0

    document = json.loads(capsys.readouterr().out)
    gnss = next(one for one in document["streams"] if one["table"] == "gnss")
    assert (gnss["matched"], gnss["fields_only_a"]) == (2 * (TICKS - 2), [])
    found = document["constellation"]["measurements"]
    assert [e["count"] for e in found[0]["errors"]] == [2 * (TICKS - 2)] * 2


def test_delta_v_commanded_and_given_stand_side_by_side(fly, capsys):
    fly(), fly(delta_v_m_s=-0.75)

    control = compared(capsys)["control"]

    assert [one["commanded_m_s"] for one in control["all"]] == [1.0, 1.5]
    assert [one["commands"] for one in control["agents"]["agent-01"]] == [1, 1]


def test_delta_v_that_a_stop_came_before_was_not_given(fly, capsys):
    fly(), fly(result={"duration_s": 9.0})

    control = compared(capsys)["control"]

    assert [one["given_m_s"] for one in control["all"]] == [0.9, 0.0]


@pytest.mark.parametrize(("shutdown_s", "given_m_s"), [(9.5, 0.0), (10.5, 0.9)])
def test_delta_v_that_a_failure_came_before_was_not_given(fly, capsys, shutdown_s, given_m_s):
    fly(), fly(result={"status": "failed", "reason": "no fuel"}, shutdown_s=shutdown_s)

    control = compared(capsys)["control"]

    assert [one["given_m_s"] for one in control["all"]] == [0.9, given_m_s]


def test_slot_error_is_told_as_flight_software_believed_it(fly, capsys):
    fly(), fly(slot_error_deg=-0.02)

    estimates = compared(capsys)["estimates"]

    assert [one["rms_deg"] for one in estimates["all"]] == pytest.approx([0.1, 0.02])
    assert [one["last_deg"] for one in estimates["agents"]["agent-02"]] == [0.1, -0.02]
    assert [rows[-1]["rms_deg"] for rows in estimates["over_time"]] == pytest.approx([0.1, 0.02])


def test_different_epochs_are_said(fly, capsys):
    fly(), fly(epoch="2018-01-01T00:00:00Z")

    assert "epochs differ" in compared(capsys)["remarks"][0]


@pytest.mark.parametrize(("begin_s", "given_m_s"), [(8.0, 0.9), (-179.0, 0.9), (-181.0, 0.0)])
def test_a_burn_under_way_at_the_end_is_not_over(fly, capsys, begin_s, given_m_s):
    # Centred on 10 s: of TICKS seconds the last burn has as many behind its time as before it.
    fly(), fly(begin_s=begin_s)

    control = compared(capsys)["control"]

    assert [one["given_m_s"] for one in control["all"]] == [0.9, given_m_s]


def test_terminal_tells_truth_measurements_control_and_estimates_apart(fly, capsys):
    fly(), fly(along_m=30.0, noise_m=4.0)

    app.run(["diff", "1", "2", "--quiet"])

    out = capsys.readouterr().out
    places = [out.index(f"\n{word}:") for word in ("Truth", "Measurements", "Control", "Estimates")]
    assert places == sorted(places)


def test_page_has_the_figures_that_the_terminal_speaks_of(fly, capsys, tmp_path):
    fly(), fly(along_m=100.0, slot_error_deg=0.2)
    page = tmp_path / "comparison.html"

    assert app.run(["diff", "1", "2"]) == 0
    assert "2 figures more with --html FILE" in capsys.readouterr().err
    assert app.run(["diff", "1", "2", "--html", str(page)]) == 0

    assert f"comparison written to {page}" in capsys.readouterr().err
    text = page.read_text()
    distance, believed = json.loads(re.search(DATA, text)[1])["figures"]
    assert "<h3>Truth: distance between A and B</h3>" in text
    assert [trace["name"] for trace in distance["choices"][0]["traces"]] == ["rms", "largest"]
    assert [trace["name"] for trace in believed["choices"][0]["traces"]] == ["A", "B"]


def test_attitude_and_its_negative_quaternion_are_one():
    quantity = Quantity(truth="attitude", names=QUATERNION, unit="deg")
    half = np.radians(0.5)
    measured = {"q1": [0.0, np.sin(half)], "q2": [0, 0], "q3": [0, 0], "q4": [-1.0, np.cos(half)]}
    truth = {"q1": [0.0, 0.0], "q2": [0, 0], "q3": [0, 0], "q4": [1.0, 1.0]}

    sizes = quantity.sizes(
        {n: np.array(v, dtype=float) for n, v in measured.items()},
        {n: np.array(v, dtype=float) for n, v in truth.items()},
    )

    assert sizes == pytest.approx([0.0, 1.0])


def test_terminal_tells_nothing_one_by_one_of_satellites_in_the_same_places(fly, capsys):
    fly(), fly(slot_error_deg=0.2)

    app.run(["diff", "1", "2", "--quiet"])

    out = capsys.readouterr().out
    truth = out[out.index("\nTruth:") : out.index("\nMeasurements:")]
    assert "all" in truth
    assert "agent-01" not in truth


def test_bodies_that_are_turned_against_each_other_are_told_by_angle_and_rates(fly, capsys):
    fly(turned_deg=10.0), fly(turned_deg=10.5, rate_rad_s=np.radians(2.0))

    found = compared(capsys)["attitude"]

    assert found["agent-01"]["count"] == TICKS
    assert found["agent-01"]["angle_deg_rms"] == pytest.approx(0.5)
    assert found["agent-02"]["angle_deg_max"] == pytest.approx(1.0)
    assert found["agent-02"]["rate_deg_s_rms"] == pytest.approx(2.0)
    assert found["agent-01"]["rate_deg_s_last_a"] == 0.0
    assert found["agent-01"]["rate_deg_s_last_b"] == pytest.approx(2.0)


def test_either_quaternion_of_one_attitude_is_the_same_body(fly, capsys):
    fly(turned_deg=10.0), fly(turned_deg=370.0)

    found = compared(capsys)["attitude"]

    assert found["agent-01"]["angle_deg_max"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.process
def test_estimates_that_diverged_cost_no_warning_of_our_source(fly):
    fly(), fly(slot_error_deg=1e200)

    done = subprocess.run(
        [sys.executable, "-m", "cosmos_cli.start", "diff", "1", "2", "--quiet"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )

    assert (done.returncode, done.stderr) == (0, "")
    assert "DIFFERENT: records differ in estimates" in done.stdout
    assert "compared nothing itself" not in done.stdout


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_estimates_and_commands_that_diverged_are_told_as_json(fly, capsys):
    fly(), fly(slot_error_deg=1e200, delta_v_m_s=1.7e308)

    found = compared(capsys)

    assert [one["last_deg"] for one in found["estimates"]["all"]] == pytest.approx([0.1, 1e200])
    assert [one["rms_deg"] for one in found["estimates"]["all"]] == [pytest.approx(0.1), None]
    assert found["control"]["all"][1]["commanded_m_s"] is None


def test_several_runs_are_each_compared_with_the_first(fly, capsys):
    fly(), fly(along_m=30.0), fly()

    assert app.run(["diff", "1", "2", "3", "--json", "--quiet"]) == 0
    document = json.loads(capsys.readouterr().out)

    far, near = document["comparisons"]
    assert document["first"] == "0001-synthetic"
    assert [one["runs"]["b"] for one in (far, near)] == ["0002-synthetic", "0003-synthetic"]
    assert far["constellation"]["truth"]["agents"]["agent-01"]["rms_m"] == pytest.approx(30.0)
    assert (far["same"], near["same"], document["same"]) == (False, True, False)
    assert app.run(["diff", "1", "3", "2", "--expect-same", "--quiet"]) == 1
    assert capsys.readouterr().out.count("DIFFERENT") == 1
