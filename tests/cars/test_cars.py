"""A simulation in a wheel of its own: its figures stand in report and comparison, its cars have names."""

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from harness.cosmos_command import LOOSE

HERE = Path(__file__).parent
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def cosmos(tmp_path_factory):
    """Run a command where the wheel of the cars is installed beside COSMoS."""
    folder = tmp_path_factory.mktemp("cars")
    site = folder / "site"
    path = os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")])
    own = {"COSMOS_STATE_DIR": str(folder / "state"), "COSMOS_RUNS": str(folder / "runs")}

    def python(*arguments, code=0):
        done = subprocess.run(
            [sys.executable, *map(str, arguments)],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path, **own},
            capture_output=True,
            text=True,
            timeout=500,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    shutil.copytree(HERE, folder / "source")  # a build leaves files beside what it builds
    python("-m", "build", "--wheel", "--outdir", folder / "wheels", folder / "source")
    (wheel,) = (folder / "wheels").glob("*.whl")
    install = ("-m", "pip", "install", "--no-deps", "--no-index", "--quiet", "--target", site)
    python(*install, wheel)

    def command(*arguments, code=0):
        return python("-m", "cosmos_cli.app", *arguments, code=code)

    command.folder = folder
    return command


@pytest.fixture(scope="module")
def lockstep(cosmos):
    """A run of a minute, in lockstep."""
    return json.loads(cosmos("run", HERE / "cars.yaml", "--json", "--quiet"))


@pytest.mark.process
def test_cars_follow_each_other_without_a_collision_and_record_what_they_declare(lockstep):
    assert lockstep["status"] == "complete"
    checks = {check["name"]: check for check in lockstep["checks"]}
    assert checks["gap_m"]["got"] > 0
    assert checks["commands_refused"]["passed"]
    assert [text for text in lockstep["remarks"] if "declared" in text] == []
    heard = [one["heard_ahead"] for one in lockstep["simulation"]["agents"].values()]
    # Of 600 words of the car ahead to all and 600 to this one, one in a hundred is lost.
    assert 1140 < min(heard) <= max(heard) < 1200
    speeds_m_s = [own["drive.speed_m_s"] for own in lockstep["columns"].values()]
    assert len(speeds_m_s) == 6
    assert all(1.0 < speed_m_s < 15.0 for speed_m_s in speeds_m_s)


@pytest.mark.process
def test_report_draws_the_cars_own_figures(cosmos, lockstep):
    page = cosmos.folder / "page.html"

    cosmos("report", lockstep["run"], "--html", page)

    text = page.read_text(encoding="utf-8")
    own = ("Ring road", "Trajectories of all cars", "Gaps to the car ahead", "collision")
    for title in (*own, "agent-01 (RING 1)"):
        assert title in text


@pytest.mark.nightly
@pytest.mark.process
def test_comparison_tells_of_cars_what_their_simulation_knows(cosmos, lockstep):
    slow = ("--set", "parameters.driver.desired_speed_m_s=6", "--no-report")
    other = json.loads(cosmos("run", HERE / "cars.yaml", "--json", "--quiet", *slow))

    found = json.loads(cosmos("diff", lockstep["run"], other["run"], "--json"))

    first, second = _find(found, "mean_speed_m_s")["agent-02"]
    assert first > second > 1.0
    page = cosmos.folder / "comparison.html"
    told = cosmos("diff", lockstep["run"], other["run"], "--html", page)
    assert "Mean speeds of cars" in told
    drawn = page.read_text("utf-8")
    assert "Mean speeds of cars" in drawn
    assert "Speeds of both runs" in drawn


@pytest.mark.process
def test_cars_are_judged_by_expectations_of_what_they_and_the_road_record(cosmos, lockstep):
    checks = """
checks:
  - {name: apart, stream: road, field: gap_m, above: 0}
  - {name: drives, stream: drive, field: speed_m_s, agents: ["RING [12]"], statistic: mean, above: 3.6, unit: km/h}
  - {name: rushes, stream: drive, field: speed_m_s, statistic: max, below: 1, unit: cm/s}
"""
    path = cosmos.folder / "judged.yaml"
    path.write_text((HERE / "cars.yaml").read_text("utf-8") + checks, "utf-8")
    wrong = cosmos.folder / "wrong.yaml"
    wrong.write_text(path.read_text("utf-8").replace("gap_m,", "gap_km,"), "utf-8")

    told = json.loads(cosmos("judge", lockstep["run"], "-s", path, "--json", code=4))
    cosmos("judge", lockstep["run"], "-s", wrong, code=2)

    apart, drives, rushes = told["checks"]
    assert apart["passed"] and apart["got"] > 0 and apart["unit"] == "m"
    assert drives["passed"] and drives["agent"] in ("agent-01", "agent-02")
    assert not rushes["passed"] and rushes["agents_broken"] == 6


@pytest.mark.process
def test_cars_are_found_by_their_plates(cosmos, lockstep):
    by_name = cosmos("logs", lockstep["run"], "agent-02")

    assert cosmos("logs", lockstep["run"], "RING 2") == by_name
    import pyarrow.parquet as pq

    table = cosmos.folder / "runs" / lockstep["run"] / "tables" / "host_road.parquet"
    rows = pq.read_table(table, columns=["agent", "car"]).to_pylist()
    assert {(row["agent"], row["car"]) for row in rows} == {
        (f"agent-0{number}", f"RING {number}") for number in range(1, 7)
    }


@pytest.mark.nightly
@pytest.mark.process
def test_cars_drive_in_real_time_too_and_record_what_they_declare(cosmos):
    settings = [
        word
        for setting in ("time.mode=realtime", "time.duration_s=3", *LOOSE)
        for word in ("--set", setting)
    ]

    document = json.loads(
        cosmos("run", HERE / "cars.yaml", "--json", "--quiet", "--no-report", *settings)
    )

    assert document["status"] == "complete"
    assert [text for text in document["remarks"] if "declared" in text] == []
    assert document["columns"]["agent-01"]["drive.speed_m_s"] > 0.0


def test_drivers_keep_the_speed_of_the_models_equilibrium(monkeypatch):
    monkeypatch.syspath_prepend(str(HERE))
    from ring_cars.car_following import acceleration_m_s2, equilibrium_gap_m
    from ring_cars.parameters import Driver

    driver = Driver()
    for speed_m_s in (0.0, 3.0, 10.0, 14.0):
        gap_m = equilibrium_gap_m(driver, speed_m_s)
        assert acceleration_m_s2(driver, speed_m_s, 0.0, gap_m) == pytest.approx(0.0, abs=1e-12)
    # Source: the model's limits. A free road: a_max from standstill, none at the desired speed.
    assert acceleration_m_s2(driver, 0.0, 0.0, math.inf) == driver.acceleration_m_s2
    assert acceleration_m_s2(driver, 15.0, 0.0, math.inf) == pytest.approx(0.0)
    # Braking for a standing car, from 15 m/s at 75 m: v^2 / 2s, the comfortable deceleration.
    assert acceleration_m_s2(driver, 15.0, 15.0, 75.0) < -driver.deceleration_m_s2


def _find(document, key):
    """Return the value of a key, wherever in a document it stands."""
    if isinstance(document, dict):
        if key in document:
            return document[key]
        document = list(document.values())
    if isinstance(document, list):
        for item in document:
            found = _find(item, key)
            if found is not None:
                return found
    return None


@pytest.mark.process
def test_a_car_that_the_timeline_has_brake_stands_and_those_behind_it_stop_too(cosmos):
    scenario = (HERE / "cars.yaml").read_text().replace("duration_s: 60", "duration_s: 40")
    entry = "{at_s: 20, action: brake, agents: [RING 3], deceleration_m_s2: 8, for_s: 15}"
    path = cosmos.folder / "braking.yaml"
    path.write_text(f"{scenario}timeline:\n  - {entry}\n")

    result = json.loads(cosmos("run", path, "--json", "--quiet", "--no-report"))
    cosmos("validate", path)
    path.write_text(path.read_text().replace("m_s2: 8", "m_s2: 80"))
    cosmos("validate", path, code=2)

    run = cosmos.folder / "runs" / result["run"] / "host"
    (braking,) = {
        json.loads(line)["agents"][0]
        for line in (run / "events.jsonl").read_text().splitlines()
        if "action_began" in line
    }
    rows = [
        row
        for line in (run / "road.jsonl").read_text().splitlines()
        if isinstance(row := json.loads(line), list)
    ]
    speeds = {t_s: speed for t_s, agent, _, speed, _ in rows if agent == braking}
    assert max(speed for t_s, speed in speeds.items() if t_s < 20) > 1
    assert max(speed for t_s, speed in speeds.items() if 23 < t_s < 35) == 0
    assert max(speed for t_s, speed in speeds.items() if t_s > 36) > 0.1
    assert {check["name"]: check["passed"] for check in result["checks"]}["gap_m"]
