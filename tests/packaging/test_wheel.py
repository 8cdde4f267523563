"""The wheel as a board gets it: base install only, in a clean environment."""

import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
AGENT_SIDE = """
import importlib, sys
import madns_runtime.agent
from madns_runtime.plugin.registry import registered_names, resolve, load_half
from pathlib import Path
for name in registered_names():
    load_half(resolve(name, Path(".")), "agent", Path("."))
heavy = {"scipy", "sgp4", "pydantic", "typer", "rich", "yaml", "fabric", "pyarrow", "plotly"}
found = sorted(heavy & {module.partition(".")[0] for module in sys.modules})
assert not found, found
print(",".join(registered_names()))
"""
NO_SOURCE = (".*", "__pycache__", "*.egg-info", "build", "dist", "runs")
HOST_SIDE = "import madns_runtime.simulations.constellation.truth.propagators.scipy_propagator"


def run(*command, cwd=None):
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False, cwd=cwd
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    out = tmp_path_factory.mktemp("wheel")
    # A build writes anew what tells the installed project's name, version and entry points, which other tests read.
    source = out / "source"
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(*NO_SOURCE))
    built = run(sys.executable, "-m", "build", "--wheel", "--outdir", out, source)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def board_python(wheel, tmp_path_factory):
    folder = tmp_path_factory.mktemp("board")
    venv.create(folder)
    python = folder / "bin" / "python"
    here = (sys.executable, "-m", "pip", "--python", python)  # a pip of its own takes seconds
    installed = run(*here, "install", "--quiet", "--no-compile", wheel)
    assert installed.returncode == 0, installed.stderr
    return python


def test_base_install_runs_the_agents_side_and_nothing_of_the_operators(board_python, tmp_path):
    done = run(board_python, "-c", AGENT_SIDE, cwd=tmp_path)

    assert done.returncode == 0, done.stderr
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    shipped = project["entry-points"]["madns.simulations"]
    assert {"constellation", "counter"} <= shipped.keys()
    assert done.stdout.strip() == ",".join(sorted(shipped))


def test_missing_extra_is_one_line_that_names_the_command(board_python, tmp_path):
    done = run(board_python.parent / "cosmos", "--help", cwd=tmp_path)

    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "pip install 'cosmos-madns[host]'" in done.stderr


def test_host_half_without_its_extra_names_the_command(board_python, tmp_path):
    done = run(board_python, "-c", HOST_SIDE, cwd=tmp_path)

    assert done.returncode != 0
    assert "pip install 'cosmos-madns[host]'" in done.stderr


def test_wheel_holds_the_packages_their_data_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0].partition("-")[0] for name in names}

    assert tops == {"cosmos_cli", "madns_runtime", "cosmos_madns"}
    assert any(name.startswith("cosmos_cli/templates/") for name in names)
    assert "madns_runtime/py.typed" in names
