"""What the README tells a person to do, done."""

import ast
import re
import subprocess
from pathlib import Path

import pytest
import yaml
from guides import blocks, run
from harness.cosmos_command import LOOSE

from cosmos_cli import app
from cosmos_cli.testing.discovery import find_scenarios

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")
TESTED = re.findall(r"<!-- tested -->\n```sh\n(.*?)```", README, flags=re.S)
PATIENT = " ".join(f"--set {setting}" for setting in LOOSE)


def test_tutorial_runs_from_its_first_command_to_its_last(tmp_path):
    for block in TESTED:
        # A shared machine may miss ticks; what the tutorial shows is the way, not the verdict.
        done = run(block.replace("cosmos run ", f"cosmos run {PATIENT} "), tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr

    assert len(TESTED) == 2
    assert "rover" in done.stdout


@pytest.mark.nightly
def test_tutorials_broken_rover_fails_its_check_with_code_4(tmp_path):
    assert run("cosmos init rover --template plugin --directory rover", tmp_path).returncode == 0
    program = tmp_path / "rover" / "rover.py"
    text = program.read_text("utf-8")
    assert "GAIN_1_S = 1.5" in text
    program.write_text(text.replace("GAIN_1_S = 1.5", "GAIN_1_S = 0.05"), "utf-8")

    done = run(f"cosmos run rover/rover.yaml --no-report {PATIENT}", tmp_path)

    assert done.returncode == 4, done.stderr
    assert "error_m" in done.stdout + done.stderr


def test_readme_shows_the_scenario_as_it_is():
    shown = re.search(r"```yaml\n# scenarios/iridium10.yaml\n(.*?)```", README, flags=re.S)

    assert shown is not None
    actual = yaml.safe_load((ROOT / "scenarios" / "iridium10.yaml").read_text("utf-8"))
    assert yaml.safe_load(shown.group(1)) == actual


def test_readme_shows_the_rovers_step_as_the_tutorial_makes_it(tmp_path):
    (shown,) = blocks(README, "python")
    assert run(TESTED[0].splitlines()[0], tmp_path).returncode == 0
    program = (tmp_path / "rover" / "rover.py").read_text("utf-8")

    methods = [
        inner
        for outer in ast.walk(ast.parse(program))
        if isinstance(outer, ast.ClassDef)
        for inner in outer.body
        if isinstance(inner, ast.FunctionDef) and inner.name == "step"
    ]

    assert ast.unparse(ast.parse(shown)) in map(ast.unparse, methods)
    comments = re.findall(r"#.*", shown)
    assert [comment for comment in comments if comment not in program] == []


def test_every_command_that_the_readme_names_exists(tmp_path):
    named = set(re.findall(r"`cosmos ([a-z]+)", README))
    done = run("cosmos --help", tmp_path, NO_COLOR="1", COLUMNS="200")

    assert named
    assert {name for name in named if not re.search(rf"\b{name}\b", done.stdout)} == set()


def test_every_file_that_the_readme_links_to_exists():
    linked = re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r'src="([^"]+)"', README)

    missing = [link for link in linked if "://" not in link and not (ROOT / link).exists()]
    assert missing == []


def test_make_has_the_readmes_two_targets():
    for target in ("demo", "test"):
        assert f"make {target}" in README
        done = subprocess.run(
            ["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_dry_run_of_make_runs_nothing(tmp_path):
    (tmp_path / "bin").mkdir()
    for tool in ("python", "ruff", "mypy", "lint-imports"):
        (tmp_path / "bin" / tool).write_text(f"#!/bin/sh\necho {tool} >>{tmp_path}/ran\n")
        (tmp_path / "bin" / tool).chmod(0o755)
    for stamp in (".runnable", ".ready"):
        (tmp_path / stamp).touch()

    done = subprocess.run(
        ["make", "-n", "test", f"VENV={tmp_path}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert f"{tmp_path}/bin/mypy" in done.stdout
    assert f"{tmp_path}/bin/python -m pytest --numprocesses 6" in done.stdout
    assert not (tmp_path / "ran").exists()


def test_every_shipped_scenario_that_no_quick_test_runs_is_valid(capsys):
    others = [each for each in shipped() if "quick" not in each.test.tags]
    assert {tag for each in others for tag in each.test.tags} >= {"emulator", "hardware"}
    for scenario in others:
        code, said = app.run(["validate", str(scenario.path)]), capsys.readouterr().err
        is_built = "scenarios/firmware/detumble builds it" not in said
        assert code == (0 if is_built else 2), said
        assert is_built or said.count("error") + said.count("no file") == 1, said


def test_every_shipped_scenario_is_a_test_and_says_what_it_needs():
    for scenario in shipped():
        tags = set(scenario.test.tags)
        assert tags & {"quick", "hardware", "emulator"}, scenario.path
        assert ("quick" in tags) == (not tags & {"hardware", "emulator"}), scenario.path


def shipped():
    found = find_scenarios([ROOT / "scenarios"])
    assert found.faults == []
    assert len(found.outlines) >= 28
    assert {path.parent.name for path in found.others} == {"baselines"}
    return found.outlines
