"""Devices of boards: made ready by `up`, tried, recorded, and used in a run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest
from device_tower import HOME, DeviceTower
from run_tower import PATIENT
from tower import Tower
from tower.fixtures import need_tower

pytestmark = pytest.mark.root

STEPS = {
    "package cosmos-test-hello: install",
    "command usermod -aG games pi (for the device gauge)",
    "line in /boot/firmware/config.txt: add dtparam=i2c_arm=on (for the device gauge)",
}


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DeviceTower]:
    """Start three boards, and make them ready; what `up` said stands in `first_up`."""
    need_tower()
    with Tower(count=3) as tower:
        made = DeviceTower(
            tower, tmp_path_factory.mktemp("operator"), tmp_path_factory.mktemp("cache")
        )
        made.hang()
        made.plug()
        made.checked = made.up("--check")
        made.first_up = made.up()
        yield made


@pytest.fixture
def tower(ready: DeviceTower) -> Iterator[DeviceTower]:
    ready.hang()
    ready.plug()
    try:
        yield ready
        assert ready.living() == {}, ready.talk
    finally:
        ready.mend()


def changes(told: dict[str, Any]) -> list[str]:
    return [step["title"] for step in told["steps"] if step["changed"]]


def test_up_installs_what_a_device_needs_where_it_hangs_and_once(tower: DeviceTower) -> None:
    first, other = (changes(tower.first_up[name]) for name in (HOME, "pi01"))
    said = tower.tower.run(
        HOME, "id -nG pi; cosmos-test-hello; grep -c i2c_arm=on /boot/firmware/config.txt"
    ).stdout.splitlines()

    assert changes(tower.checked[HOME]) == first
    assert set(first) >= STEPS
    assert any(title.startswith("tree drivers ") for title in first)
    assert set(other) & STEPS == set()
    assert not any(title.startswith("tree drivers ") for title in other)
    assert any("`cosmos reboot -i " in note for note in tower.first_up[HOME]["notes"])
    assert "games" in said[0].split()
    assert said[-1] == "1"
    second = tower.up()
    assert {name: told["status"] for name, told in second.items()} == dict.fromkeys(
        tower.boards, "ok"
    )


def test_a_device_of_a_board_is_tried_and_recorded_from_here(tower: DeviceTower) -> None:
    records = tower.folder / "recorded"

    # Three samples are three twentieths of a second's, but a busy machine may stand still for as long.
    tried = tower.cosmos("devices", "test", "-i", tower.inventory, "--seconds", "3", "--json")
    recorded = tower.cosmos(
        *("devices", "record", "gauge", records, "-i", tower.inventory, "--seconds", "3")
    )
    tower.unplug()
    without = tower.cosmos("devices", "test", "-i", tower.inventory, "--seconds", "1", "--json")

    assert tried.returncode == 0, tried.stderr
    device = json.loads(tried.stdout)["devices"][f"{HOME}/gauge"]
    assert device["status"] in ("ok", "stale")  # as a busy machine may have it at the end
    assert (device["identity"], device["errors"]) == ("g-1", 0)
    assert device["channels"]["level"]["samples"] > 2
    assert recorded.returncode == 0, recorded.stderr
    assert len((records / "level.jsonl").read_text().splitlines()) > 3
    assert without.returncode == 1
    assert "No such file" in without.stderr
    assert "devices-" not in tower.tower.run(HOME, "ls cosmos/state").stdout


def test_a_board_that_is_not_ready_says_up_first(tower: DeviceTower) -> None:
    tower.hang(kind="synthetic", serial="")  # needs another environment than the one there

    tried = tower.cosmos("devices", "test", "-i", tower.inventory)

    assert tried.returncode == 3
    assert f"run `cosmos up -i {tower.inventory}` first" in tried.stderr


def test_a_run_uses_the_device_of_a_board(tower: DeviceTower) -> None:
    time = {"duration_s": 4, "rtf_tolerance": 0.9}
    tower.start(time=time, timeouts=PATIENT, hardware={"lost": 1000})
    code = tower.finish()

    assert code == 0, tower.talk
    numbers = [line[1] for line in tower.samples()]
    # Those before the first word of simulated time have no place in it; after that none is missing.
    assert numbers == list(range(numbers[0], tower.device()["samples"] + 1))
    assert {line[-1] for line in tower.samples()} == {3.5}
