"""A board that hosts a vehicle with an emulated flight computer is lost and comes back: both are started anew, all else flies on."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest
from harness.emulated_flight import (
    assert_returned,
    assert_untouched,
    count_commands,
    emulated_flight,
    has_commanded,
)
from harness.firmware import needs_emulator
from run_tower import RunTower
from tower import Tower
from tower.fixtures import need_tower

pytestmark = [pytest.mark.root, pytest.mark.nightly, needs_emulator]

LOST, OTHER = "pi02", "pi03"
AGENT, WITH_COMPUTER, WITHOUT = "agent-02", "agent-03", "agent-01"
DURATION_S = 600
EMULATORS = "pgrep -a -f '[q]emu-system-arm' || true"


@pytest.fixture
def tower(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunTower]:
    need_tower()
    with Tower(count=3, boot_delay_s=1.0) as tower:
        folders = [tmp_path_factory.mktemp(name) for name in ("operator", "cache")]
        made = RunTower(tower, *folders)
        made.choose()
        try:
            yield made
        finally:
            made.mend()


@pytest.mark.timeout(600)
@pytest.mark.parametrize("fault", ["crash", "down"])
def test_lost_board_comes_back_with_its_emulator(tower: RunTower, fault: str) -> None:
    program = shutil.which("qemu-system-arm")
    changes = emulated_flight(tower.scenarios, AGENT, WITH_COMPUTER, count=3, duration_s=DURATION_S)
    up = tower.cosmos("up", "-i", tower.inventory, tower.scenario(**changes))
    assert up.returncode == 0, up.stdout + up.stderr
    assert tower.tower.run(LOST, f"test -x {program}", check=False).returncode == 0

    tower.start(**changes)
    tower.wait_until_running()
    tower.wait_until(lambda: has_commanded(tower.directory, AGENT), f"command of {AGENT}")
    tower.tower.fault(LOST, fault)
    tower.wait_for(f"machine {LOST} is lost")
    if fault == "down":
        tower.tower.fault(LOST, "up")
    tower.wait_for(f"{AGENT} has rejoined")
    emulators = tower.tower.run(LOST, EMULATORS).stdout.splitlines()
    before = count_commands(tower.directory, AGENT)
    tower.wait_until(
        lambda: has_commanded(tower.directory, AGENT, before=before),
        f"command of {AGENT} after its return",
    )
    tower.stop()
    code = tower.finish()

    assert code == 3, tower.talk
    document = tower.document
    assert document["status"] == "complete"
    assert document["agents"]["incarnations"] == {AGENT: 2}
    assert f"MACHINES FAILED: {LOST}: machine {LOST} is lost" in tower.verdict
    if fault == "crash":  # a board that only hears nobody closes its devices in order
        lost = next(check for check in document["checks"] if check["name"] == "hardware.lost")
        assert lost["worst"] == f"{AGENT}/mcu"
    assert len(emulators) == 1, emulators
    assert_returned(tower.directory, AGENT)
    assert_untouched(tower.directory, WITH_COMPUTER, AGENT, has_computer=True)
    assert_untouched(tower.directory, WITHOUT, AGENT, has_computer=False)
    for name in tower.boards:
        assert tower.tower.run(name, EMULATORS).stdout == "", name
    assert tower.living() == {}, tower.talk
