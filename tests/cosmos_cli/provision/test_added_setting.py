"""A setting has one home: with one entry more in one file it is validated, planned, shown, made and put back."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.process, pytest.mark.root]

ROOT = Path(__file__).parents[3]
HOME = "models/inventory/settings.py"
ENTRY = '''
    cosmos_swappiness: Annotated[int, Field(ge=0, le=200)] | None = _declared(
        _sysctl("vm.swappiness", "90-cosmos-swappiness.conf")
    )
    """How readily the kernel swaps; as it is if not given."""
'''
SCRIPT = """
import json, sys
from pathlib import Path
from fake_system import FakeKit, connection_to, make_system, up
from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.provision.up_table import plan_lines

place = Path(sys.argv[1])
kit = FakeKit(make_system(place / "system"))
value = place / "system/proc/sys/vm/swappiness"
value.parent.mkdir(parents=True)
value.write_text("60\\n")
kept = place / "system/etc/sysctl.d/90-cosmos-swappiness.conf"

def machine(line):
    path = place / "inventory.yaml"
    path.write_text(f"all: {{hosts: {{pi01: {{cosmos_root: {place}/cosmos, {line}}}}}}}\\n")
    return load_machines(path)[0]

def do(line="", **options):
    done = up(connection_to(place / "cosmos"), machine(line), kit, **options)
    assert done.failure is None, done.failure
    lines = plan_lines([done], has_diffs="is_check" in options)
    text = kept.read_text().splitlines()[2:] if kept.exists() else None
    return [line for line in lines if "swappiness" in line], value.read_text().strip(), text

try:
    machine("cosmos_swappiness: 201")
    refused = ""
except InputError as error:
    refused = str(error)
print(json.dumps({
    "refused": refused,
    "shown": do("cosmos_swappiness: 10", is_check=True, has_texts=True),
    "made": do("cosmos_swappiness: 10"),
    "again": do("cosmos_swappiness: 10"),
    "undone": do(),
}))
"""


@pytest.fixture
def told(tmp_path):
    """Return what comes of a copy of the command line in which one file has one entry more."""
    if os.geteuid() != 0:
        pytest.skip("needs root: a setting of the machine is root's")
    copy = tmp_path / "copy" / "cosmos_cli"
    shutil.copytree(ROOT / "cosmos_cli", copy, ignore=shutil.ignore_patterns("__pycache__"))
    text = (copy / HOME).read_text("utf-8")
    assert text.count("\n\n\nSETTINGS: ") == 1
    (copy / HOME).write_text(text.replace("\n\n\nSETTINGS: ", f"{ENTRY}\n\nSETTINGS: "), "utf-8")
    places = [copy.parent, Path(__file__).parent, ROOT]
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_one_entry_in_one_file_is_a_setting(told):
    title = "setting cosmos_swappiness: 60 -> 10"

    assert "expected <= 200, got 201" in told["refused"]
    shown, value, kept = told["shown"]
    assert f"  {title} [root]" in shown
    assert any(line.strip().startswith("+# Written by `cosmos up`") for line in shown)
    assert (value, kept) == ("60", None)
    assert told["made"] == [[f"  {title} [root]"], "10", ["vm.swappiness = 10"]]
    assert told["again"][0] == []
    assert told["undone"] == [["  setting cosmos_swappiness: put back 60 [root]"], "60", None]
