"""
Whatever a file that a user names turns out to be, a command tells it at once and never hangs.

Real processes: a pipe that is opened by mistake holds its reader for ever.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from madns_runtime.simulations import constellation

pytestmark = pytest.mark.process

COSMOS = (sys.executable, "-m", "cosmos_cli.app")
DEADLINE_S = 120
MEMORY_KIB = 3 * 1024 * 1024
REPOSITORY = Path(constellation.__file__).parents[3]

SCENARIO = """
name: odd
simulation: counter
agents: {count: 1}
"""
ORBITS = """
name: odd
simulation: constellation
agents: {count: 1}
parameters:
  satellites: {elements: odd}
"""
FLIGHT = """
name: odd
simulation: constellation
agents: {count: 10}
parameters:
  satellites: {elements: iridium10.tle}
  flight: ./odd:Flight
"""
INVENTORY = """
all:
  hosts: {pi01: {}}
  vars:
    cosmos_provision:
      - file: {src: odd, dest: /etc/odd}
"""
KINDS = {
    "pipe": "expected a file, got a pipe",
    "device": "expected a file, got a device",
}


@pytest.fixture(params=list(KINDS))
def told(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Make `odd`, which has no end or no beginning, and return what is told of it."""
    if request.param == "pipe":
        os.mkfifo(tmp_path / "odd")
    else:
        (tmp_path / "odd").symlink_to("/dev/zero")
    return KINDS[request.param]


def answer(folder: Path, *arguments: str) -> tuple[int, str]:
    """Return exit code and words of a command that may use little memory."""
    limited = f'ulimit -v {MEMORY_KIB}; exec "$@"'
    done = subprocess.run(
        ["sh", "-c", limited, "sh", *COSMOS, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def test_a_scenario(tmp_path: Path, told: str) -> None:
    code, words = answer(tmp_path, "validate", "odd")

    assert (code, told in words) == (2, True), words
    assert words.startswith("odd: ")


def test_element_sets(tmp_path: Path, told: str) -> None:
    (tmp_path / "a.yaml").write_text(ORBITS)
    code, words = answer(tmp_path, "validate", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert "parameters.satellites.elements" in words


def test_a_plugin(tmp_path: Path, told: str) -> None:
    (tmp_path / "odd").rename(tmp_path / "odd.py")
    (tmp_path / "a.yaml").write_text(SCENARIO.replace("counter", "./odd.py:simulation"))
    code, words = answer(tmp_path, "validate", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert "a.yaml:3:13: simulation: " in words


def test_flight_software(tmp_path: Path, told: str) -> None:
    (tmp_path / "a.yaml").write_text(FLIGHT)
    shutil.copy(REPOSITORY / "scenarios/data/iridium10.tle", tmp_path)
    code, words = answer(tmp_path, "validate", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert "parameters.flight" in words


def test_an_inventory(tmp_path: Path, told: str) -> None:
    code, words = answer(tmp_path, "inventory", "-i", "odd")

    assert (code, told in words) == (2, True), words


def test_a_file_of_variables(tmp_path: Path, told: str) -> None:
    (tmp_path / "group_vars").mkdir()
    (tmp_path / "odd").rename(tmp_path / "group_vars/all")
    (tmp_path / "a.yaml").write_text("all: {hosts: {pi01: {}}}\n")
    code, words = answer(tmp_path, "inventory", "-i", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert "group_vars/all" in words


def test_a_file_that_a_step_sends(tmp_path: Path, told: str) -> None:
    (tmp_path / "a.yaml").write_text(INVENTORY)
    code, words = answer(tmp_path, "inventory", "-i", "a.yaml")

    assert (code, told in words) == (2, True), words
    assert "cosmos_provision" in words


def test_an_ssh_configuration(tmp_path: Path, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COSMOS_SSH_CONFIG", str(tmp_path / "odd"))
    (tmp_path / "a.yaml").write_text("all: {hosts: {pi01: {ansible_host: 127.0.0.1}}}\n")
    code, words = answer(tmp_path, "ping", "-i", "a.yaml")

    assert (code, told in words) == (2, True), words


def test_a_kept_schema(tmp_path: Path, told: str) -> None:
    code, words = answer(tmp_path, "schema", "--check", "--output", "odd")

    assert (code, told in words) == (2, True), words
