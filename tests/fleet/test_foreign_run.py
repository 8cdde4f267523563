"""Boards of other processors, emulated: from bare ones to a collected run, as a user does it."""

from __future__ import annotations

from pathlib import Path

import pytest
import run_tower
from run_tower import RunTower
from tower import BoardSpec
from tower.roots import why_unavailable

ARCHITECTURES = ("arm64", "armhf")
PATIENT = {
    "host_setup_s": 120,
    "agents_ready_s": 120,
    "agent_setup_s": 120,
    "shutdown_s": 60,
    "silence_s": 60,
}
"""An emulated interpreter takes ten times as long to start."""


@pytest.mark.root
@pytest.mark.timeout(1200)  # whichever test needs these systems first waits until they are built
@pytest.mark.nightly
def test_boards_of_other_processors_are_made_ready_run_and_are_collected(
    make_tower, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for reason in filter(None, map(why_unavailable, ARCHITECTURES)):
        pytest.skip(reason)
    monkeypatch.setattr(run_tower, "PATIENCE_S", 500.0)
    boards = [BoardSpec(name=arch, arch=arch) for arch in ARCHITECTURES]
    operator = RunTower(make_tower(count=0, boards=boards), tmp_path, tmp_path / "cache")
    operator.choose()
    changes = {
        "agents": {"count": 2, "tick_hz": 5},
        "time": {"duration_s": 3, "rtf_tolerance": 0.9},
        "timeouts": PATIENT,
    }

    up = operator.cosmos("up", "-i", operator.inventory, operator.scenario(**changes))
    assert "2 machines: 2 changed, 0 ok, 0 failed" in up.stdout, up.stdout + up.stderr
    operator.start("--detach", **changes)
    assert operator.finish() == 0, operator.talk
    operator.wait_until(lambda: operator.living() == {}, "end of the run")
    collect = operator.cosmos("collect", "last")

    assert collect.returncode == 0, collect.stdout + collect.stderr
    assert collect.stdout.startswith("PASSED")
    for arch in ARCHITECTURES:
        assert (operator.directory / "machines" / arch / "manifest.json").exists()
        assert operator.tower.run(arch, "ls cosmos/runs").stdout == ""
