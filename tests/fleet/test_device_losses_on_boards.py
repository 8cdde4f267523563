"""A board's device that is lost, alone and with its board, comes back, or is used by two: who is named, the end, the evidence."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from device_tower import HOME, DeviceTower
from harness.waiting import wait_until
from run_tower import ENDLESS, PATIENT
from tower import Tower
from tower.fixtures import need_tower

pytestmark = [pytest.mark.root, pytest.mark.nightly]

PATIENCE_S = 120.0
RETURNING = {"on_agent_loss": "continue", "agents": {"count": 3, "tick_hz": 20, "restarts_max": 5}}


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeviceTower]:
    need_tower()
    with Tower(count=3, boot_delay_s=1.0) as tower:
        made = DeviceTower(
            tower, tmp_path_factory.mktemp("operator"), tmp_path_factory.mktemp("cache")
        )
        made.hang()
        made.plug()
        made.up()
        yield made


@pytest.fixture
def tower(ready: DeviceTower) -> Iterator[DeviceTower]:
    ready.plug()
    try:
        yield ready
        assert ready.living() == {}, ready.talk
    finally:
        ready.mend()


def events(tower: DeviceTower) -> list[str]:
    path = tower.directory / "devices" / HOME / "gauge" / "events.jsonl"
    lines = map(json.loads, path.read_text().splitlines()[1:])
    return [line["event"] for line in lines if isinstance(line, dict) and "event" in line]


def test_a_lost_device_ends_the_run_with_3_and_both_names(tower: DeviceTower) -> None:
    tower.start(timeouts=PATIENT)
    tower.wait_until_running()
    tower.unplug()
    code = tower.finish()

    assert code == 3, tower.talk
    assert f"{HOME}/gauge" in tower.verdict
    assert tower.device()["lost"] == 1
    assert tower.samples()


def test_a_lost_device_that_comes_back_breaks_a_check_and_goes_on(tower: DeviceTower) -> None:
    tower.start(hardware={"on_device_loss": "continue"}, time=ENDLESS, timeouts=PATIENT)
    tower.wait_until_running()
    tower.unplug()
    tower.wait_for(f"device {HOME}/gauge: lost")
    tower.plug()
    tower.wait_for(f"device {HOME}/gauge: ok")
    tower.stop()
    code = tower.finish()

    assert code == 4, tower.talk
    device = tower.device()
    assert device["lost"] >= 1
    lost = next(c for c in tower.document["checks"] if c["name"] == "hardware.lost")
    assert (lost["passed"], lost["worst"]) == (False, f"{HOME}/gauge")
    assert events(tower).count("opened") >= 2


def test_a_board_lost_with_its_device_ends_the_run_with_3(tower: DeviceTower) -> None:
    tower.start()
    tower.wait_until_running()
    tower.tower.fault(HOME, "down")
    code = tower.finish()
    tower.tower.fault(HOME, "up")
    tower.cosmos("collect", tower.directory)

    assert code == 3, tower.talk
    assert HOME in tower.talk
    named = [text for text in tower.problems(HOME) if text.startswith(f"machine {HOME} is lost: ")]
    assert [text.endswith(f", with {HOME}/gauge") for text in named] == [True], tower.document
    assert tower.samples()
    wait_until(lambda: tower.living() == {}, patience_s=PATIENCE_S)


def test_a_board_lost_with_its_device_comes_back_with_it(tower: DeviceTower) -> None:
    tower.start(hardware={"on_device_loss": "continue"}, time=ENDLESS, **RETURNING)
    tower.wait_until_running()
    boots = tower.tower.state()["boards"][HOME]["boots"]
    tower.tower.fault(HOME, "crash")  # the power is cut: the device is gone with its file
    tower.tower.wait_until_on(HOME, boots=boots + 1)
    tower.plug()
    tower.wait_for(f"device {HOME}/gauge: ok")
    tower.stop()
    code = tower.finish()

    assert code == 3, tower.talk
    assert f"device {HOME}/gauge: lost: machine {HOME} is lost" in tower.talk
    assert tower.problems(HOME), tower.document
    assert f"{HOME}/gauge" in json.dumps(tower.document["devices"])
    assert tower.samples()


def test_a_second_run_that_opens_the_device_is_refused_by_name(tower: DeviceTower) -> None:
    tower.start(time=ENDLESS, timeouts=PATIENT)
    tower.wait_until_running()
    first = tower.directory
    second = tower.cosmos(
        *("run", tower.scenario(name="other"), "-i", tower.inventory),
        *("--no-report", "--json", "--quiet", "--runs", tower.folder / "others"),
    )
    tried = tower.cosmos("devices", "test", "-i", tower.inventory, "--seconds", "1")
    tower.interrupt()
    tower.finish()

    assert second.returncode == 1, second.stderr
    refused = f"device {HOME}/gauge is in use by run {first.name} (pid "
    assert refused in second.stderr
    assert tried.returncode == 3
    assert refused in tried.stderr
    assert tower.device()["lost"] == 0
    samples = tower.samples()
    assert len(samples) > 5
    assert {line[-1] for line in samples} == {3.5}
