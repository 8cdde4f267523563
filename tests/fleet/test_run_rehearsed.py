"""`cosmos run --check`, several inventories and logs on virtual boards over real SSH."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from run_tower import PATIENT, RunTower
from tower import Tower
from tower.fixtures import need_tower
from up_tower import LIST

pytestmark = pytest.mark.root

QUICK = {"time": {"duration_s": 3, "rtf_tolerance": 0.9}, "timeouts": PATIENT}
TALKATIVE = Path(__file__).parents[1] / "harness" / "talkative.py"


@pytest.fixture(scope="module")
def tower(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunTower]:
    """Boards that nobody has made ready yet: two to be checked bare, two for the others."""
    need_tower()
    with Tower(count=4, boot_delay_s=1.0) as boards:
        folder = tmp_path_factory.mktemp("operator")
        yield RunTower(boards, folder, tmp_path_factory.mktemp("cache"))


def runs_of(tower: RunTower) -> set[str]:
    return {path.name for path in tower.runs.iterdir()} if tower.runs.exists() else set()


def check(tower: RunTower, *words: str) -> dict:
    scenario = str(tower.scenario(**QUICK))
    done = tower.cosmos("run", scenario, "--check", "--json", *words)
    answer = json.loads(done.stdout)
    assert answer["exit_code"] == done.returncode, done.stderr
    return answer


def test_boards_are_checked_made_ready_run_and_read(tower: RunTower) -> None:
    tower.choose("pi03")
    first = str(tower.inventory)
    second = str(tower.folder / "second.yaml")
    tower.tower.write_inventory(Path(second), {}, ("pi04",), v_of="second")
    both = ("-i", first, "-i", second)
    before = {name: tower.tower.run(name, LIST).stdout for name in ("pi03", "pi04")}

    runs = runs_of(tower)

    bare = check(tower, *both)

    assert bare["exit_code"] == 3
    assert {m["machine"]: m["has_environment"] for m in bare["machines"]} == {
        "pi03": False,
        "pi04": False,
    }
    assert bare["up"]["command"].startswith(f"cosmos up -i {first} -i {second} ")
    assert any("environment" in step for step in bare["up"]["steps"])
    after = {name: tower.tower.run(name, LIST).stdout for name in ("pi03", "pi04")}
    assert after == before  # nothing was changed
    assert runs_of(tower) == runs

    scenario = str(tower.scenario(**QUICK))
    up = tower.cosmos("up", *both, scenario)
    assert up.returncode == 0, up.stdout + up.stderr
    ready = check(tower, *both)
    assert ready["exit_code"] == 0, ready
    assert all(machine["is_ready"] for machine in ready["machines"])
    assert all(machine["round_trip_ms"] > 0 for machine in ready["machines"])

    run = tower.cosmos("run", scenario, *both, "--no-report", "--json")
    document = json.loads(run.stdout)
    assert run.returncode == 0, run.stderr
    kept = yaml.safe_load((tower.runs / document["run"] / "inventory.yaml").read_text())
    assert set(kept["all"]["hosts"]) == {"pi03", "pi04"}  # the merged one

    tower.tower.fault("pi04", "down")
    try:
        lost = check(tower, *both)
    finally:
        tower.tower.fault("pi04", "up")
    assert lost["exit_code"] == 3
    assert [machine["is_ready"] for machine in lost["machines"]] == [True, False]


@pytest.mark.nightly
def test_log_of_a_detached_run_is_followed_on_its_machines(tower: RunTower) -> None:
    tower.choose("pi01", "pi02")
    (tower.scenarios / "talkative.py").write_text(TALKATIVE.read_text())
    changes = {"simulation": "./talkative.py:simulation", "agents": {"count": 2, "tick_hz": 10}}
    scenario = str(tower.scenario(**changes, **QUICK))
    where = ("-i", str(tower.inventory), "--host", "pi02")
    up = tower.cosmos("up", *where, scenario)
    assert up.returncode == 0, up.stdout + up.stderr
    run = tower.cosmos("run", scenario, *where, "--detach", "--json")
    name = json.loads(run.stdout)["run"]

    followed = tower.cosmos("logs", name, "-f", "--json")
    there = tower.cosmos("logs", name, "--json")
    assert tower.cosmos("collect", name, "--quiet").returncode in (0, 5)
    here = tower.cosmos("logs", name, "--json")

    lines = [sorted(done.stdout.splitlines()) for done in (followed, there, here)]
    texts = {json.loads(line)["text"] for line in lines[0]}
    assert [done.returncode for done in (followed, there, here)] == [0, 0, 0]
    assert {"the host begins", "wrong 20", "a word on stderr"} <= texts
    assert lines[0] == lines[1] == lines[2]


@pytest.mark.nightly
def test_machine_that_is_gone_hides_nobody_elses_log(tower: RunTower) -> None:
    tower.choose("pi01", "pi02")
    (tower.scenarios / "talkative.py").write_text(TALKATIVE.read_text())
    changes = {"simulation": "./talkative.py:simulation", "agents": {"count": 2, "tick_hz": 10}}
    scenario = str(tower.scenario(**changes, **QUICK))
    up = tower.cosmos("up", "-i", str(tower.inventory), scenario)
    assert up.returncode == 0, up.stdout + up.stderr
    run = tower.cosmos("run", scenario, "-i", str(tower.inventory), "--detach", "--json")
    name = json.loads(run.stdout)["run"]
    assert tower.cosmos("logs", name, "-f", "--json").returncode == 0

    tower.tower.fault("pi02", "down")
    try:
        done = tower.cosmos("logs", name, "--json")
    finally:
        tower.tower.fault("pi02", "up")

    assert done.returncode == 3
    assert "pi02: its log cannot be read: " in done.stderr
    sources = {json.loads(line)["source"] for line in done.stdout.splitlines()}
    assert "agent-01" in sources and "agent-02" not in sources
    assert tower.cosmos("collect", name, "--quiet").returncode in (0, 5)
