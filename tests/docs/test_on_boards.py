"""What the README tells a person with a box of boards to do, done on virtual ones."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from guides import GUIDES, ROOT
from harness.cosmos_command import LOOSE

from cosmos_cli.models.inventory import load_machines

README = GUIDES[0].read_text("utf-8")
BOX = "```yaml\n# box.yaml\n(.*?)```"
TESTED = re.findall(r"<!-- tested on boards -->\n```sh\n(.*?)```", README, flags=re.S)
BOARDS = 2
PATIENCE_S = 240
# Boards that share the processors of one computer may miss ticks; what is shown is the way, not the verdict.
GENTLE = f"cosmos run --duration 5 {' '.join(f'--set {setting}' for setting in LOOSE)} "


def write_box(folder):
    found = re.search(BOX, README, flags=re.S)
    assert found is not None
    path = folder / "box.yaml"
    path.write_text(found.group(1), "utf-8")
    return path


def test_readme_shows_an_inventory_of_24_boards(tmp_path):
    machines = load_machines(write_box(tmp_path))

    assert [machine.name for machine in machines] == [f"pi{n:02d}" for n in range(1, 25)]
    assert machines[0].variables.user == "pi"
    assert machines[0].variables.cosmos_cpu_governor == "performance"


@pytest.mark.root
def test_readmes_commands_work_on_boards_as_they_stand(tmp_path, make_tower):
    """The boards' names are the README's; COSMOS_LIMIT says how many there are."""
    tower = make_tower(count=BOARDS)
    write_box(tmp_path)
    environment = {
        **os.environ,
        **tower.operator_environment(),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "COSMOS_STATE_DIR": str(tmp_path / "state"),
        "COSMOS_RUNS": str(tmp_path / "runs"),
        "COSMOS_LIMIT": ",".join(tower.boards),
    }
    [block] = TESTED
    script = block.replace("scenarios/", f"{ROOT}/scenarios/").replace("cosmos run ", GENTLE)

    done = subprocess.run(
        ["bash", "-exc", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{BOARDS} machines: all answered" in done.stdout
    assert f"{BOARDS} machines: {BOARDS} changed, 0 ok, 0 failed" in done.stdout
    assert done.stdout.count("PASSED") == 2
    left = tower.run("pi01", "ls cosmos/runs").stdout
    assert left == ""
