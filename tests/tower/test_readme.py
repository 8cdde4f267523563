"""README.md: its commands work as they stand, and its list of faults is the true one."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from .faults import FAULTS
from .fixtures import need_tower
from .places import Places
from .tower import wait_until_gone

README = Path(__file__).with_name("README.md").read_text()
ROOT = Path(__file__).parents[2]
PATIENCE_S = 240


def list_commands() -> list[str]:
    """Return the lines of all `sh` blocks."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    return [line for block in blocks for line in block.splitlines()]


@pytest.mark.root
@pytest.mark.timeout(600)
def test_commands_work(tmp_path):
    """Other towers may run here: COSMOS_TOWER names the one that is meant."""
    need_tower()
    first, *others = list_commands()
    assert first == "python -m tests.tower up 24"
    assert others[-1] == "python -m tests.tower down"
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path}
    with subprocess.Popen(
        [*first.split(), "--json"],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    ) as tower:
        try:
            assert tower.stdout is not None
            places = Places(json.loads(tower.stdout.readline())["tower"])
            key = places.key.read_bytes()
            environment["COSMOS_TOWER"] = str(places.index)
            # One shell, as a reader has: what `eval` sets holds for the commands after it.
            script = "\n".join(["set -eux", *others]).replace("/tmp/", f"{tmp_path}/")
            run = subprocess.run(
                ["sh", "-c", script],
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
                check=False,
            )
            if run.returncode == 0:
                tower.wait(PATIENCE_S)  # the last command was `down`
        finally:
            if tower.poll() is None:
                tower.terminate()
    wait_until_gone(places, key)

    assert run.returncode == 0, run.stderr
    assert len(re.findall(r"^\d+ pi\d\d +10\.", run.stdout, re.MULTILINE)) == 2 * 24
    assert "pi01\nroot\n" in run.stdout
    assert re.search(r"^\d+ pi03 .*, frozen$", run.stdout, re.MULTILINE)
    assert re.search(r"^\d+ pi04 .*, unplugged$", run.stdout, re.MULTILINE)
    assert "load average" in run.stdout
    assert tower.returncode == 0
    assert "pi24" in (tmp_path / "tower.yaml").read_text()


def test_fault_table_is_the_list_of_faults():
    rows = re.findall(r"^\| `([^`]*)` \| (.*) \|$", README, re.MULTILINE)
    expected = [(f"{name} {fault.takes}".strip(), fault.text) for name, fault in FAULTS.items()]
    assert rows[: len(expected)] == expected


def test_every_module_is_described():
    names = {path.name for path in Path(__file__).parent.glob("*.py")}
    described = set(re.findall(r"`(\w+\.py)`", README))
    untold = {name for name in names if not name.startswith(("test_", "__"))} - described
    assert untold == {"console.py"}


def test_every_board_file_is_installed():
    """A file that nothing installs is a leftover."""
    folder = Path(__file__).parent
    source = "".join((folder / name).read_text() for name in ("base.py", "setup.py"))
    for path in (folder / "board_files").iterdir():
        assert f'"{path.name}"' in source, path.name
