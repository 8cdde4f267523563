"""What lies in the project's tree: the parts that it is known to have, written by hand, and nothing that a program left."""

import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = {
    *(".ci", ".gitignore", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md"),
    *("benchmarks", "cosmos_cli", "docs", "inventory", "madns_runtime", "pyproject.toml"),
    *("scenarios", "tests"),
}
LARGEST_BYTES = 512 * 1024
MADE_BY_PROGRAMS = {".whl", ".gz", ".zip", ".so", ".o", ".elf", ".pyc"}


@pytest.fixture(scope="module")
def files():
    """Files of the project, as git has them."""
    if not (ROOT / ".git").exists():
        pytest.skip("this copy is no git repository")
    told = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True)
    return [Path(name) for name in told.stdout.decode().split("\0") if name]


@pytest.mark.process
def test_top_level_has_its_parts_and_nothing_beside_them(files):
    assert {path.parts[0] for path in files} == PARTS


@pytest.mark.process
def test_no_file_is_what_a_program_left(files):
    there = [path for path in files if (ROOT / path).is_file()]
    assert [str(path) for path in there if path.suffix in MADE_BY_PROGRAMS] == []
    assert [str(p) for p in there if (ROOT / p).stat().st_size > LARGEST_BYTES] == []


@pytest.mark.parametrize(
    ("group", "folder"),
    [("madns.devices", "hardware/kinds"), ("madns.simulations", "simulations")],
)
def test_each_shipped_kind_of_device_and_each_simulation_has_its_line(group, folder):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    place = ROOT / "madns_runtime" / folder
    shipped = {path.stem for path in place.glob("*.py")} - {"__init__"}
    shipped |= {path.parent.name for path in place.glob("*/__init__.py")}

    assert set(project["entry-points"][group]) == shipped
