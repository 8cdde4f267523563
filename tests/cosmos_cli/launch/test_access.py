"""recording.access: the modes of all that a run leaves, whatever the umask was."""

import json
import os
import shlex
import stat
import subprocess
import sys
import tarfile

import pytest
import zstandard

from cosmos_cli import app
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.launch.child import RemoteProgram, start_command
from cosmos_cli.launch.machines import MachinePaths

SCENARIO = """\
name: modes
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 1, rtf_tolerance: 100}
deadline: {max_miss_ratio: 1, overrun_ms: 5000}
timeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60, shutdown_s: 60}
"""
MODES = {"private": (0o700, 0o600), "group": (0o750, 0o640), "all": (0o755, 0o644)}


def mode(path):
    return stat.S_IMODE(path.lstat().st_mode)


def cosmos(tmp_path, *arguments, umask, **environment):
    return subprocess.run(
        [sys.executable, "-m", "cosmos_cli.start", *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=tmp_path,
        umask=umask,
        env={
            **{k: v for k, v in os.environ.items() if k != "COSMOS_ACCESS"},
            "COSMOS_STATE_DIR": str(tmp_path / "state"),
            "COSMOS_RUNS": str(tmp_path / "runs"),
            **environment,
        },
    )


def check_modes(run, access):
    folder_mode, file_mode = MODES[access]
    found = {path: mode(path) for path in (run.path, *run.path.rglob("*"))}
    expected = {path: folder_mode if path.is_dir() else file_mode for path in found}
    assert found == expected
    assert mode(run.bundle) == file_mode
    with (
        run.bundle.open("rb") as raw,
        zstandard.ZstdDecompressor().stream_reader(raw) as data,
        tarfile.open(fileobj=data, mode="r|") as archive,
    ):
        assert {member.mode for member in archive} == {file_mode}


@pytest.mark.process
@pytest.mark.parametrize(
    ("umask", "arguments", "environment", "access"),
    [
        (0o000, (), {}, "private"),
        (0o000, ("--set", "time.mode=lockstep"), {}, "private"),
        pytest.param(0o077, (), {"COSMOS_ACCESS": "group"}, "group", marks=pytest.mark.nightly),
        (0o077, ("--set", "recording.access=all"), {"COSMOS_ACCESS": "private"}, "all"),
    ],
)
def test_all_that_a_run_leaves_has_its_access(tmp_path, umask, arguments, environment, access):
    (tmp_path / "s.yaml").write_text(SCENARIO)

    done = cosmos(tmp_path, "run", "s.yaml", *arguments, umask=umask, **environment)

    assert done.returncode == 0, done.stdout + done.stderr
    run = RunDirectory(tmp_path / "runs/0001-modes")
    check_modes(run, access)
    plan = json.loads(run.plan_json.read_bytes())
    assert plan["config"]["recording"]["access"] == access

    again = cosmos(tmp_path, "collect", "1", umask=0o002 if umask else 0o077)

    assert again.returncode == 0, again.stdout + again.stderr
    check_modes(run, access)


def test_environment_that_says_something_else_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COSMOS_ACCESS", "world")
    (tmp_path / "s.yaml").write_text(SCENARIO)

    assert app.run(["run", str(tmp_path / "s.yaml"), "--runs", str(tmp_path / "runs")]) == 2

    err = capsys.readouterr().err
    assert "COSMOS_ACCESS: expected one of private, group, all, got 'world'" in err
    assert not (tmp_path / "runs").exists()


def test_scenario_that_says_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "s.yaml").write_text(SCENARIO + "recording: {access: everybody}\n")

    assert app.run(["validate", str(tmp_path / "s.yaml")]) == 2

    assert "private" in capsys.readouterr().err


def test_validate_tells_the_access(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COSMOS_ACCESS", "group")
    (tmp_path / "s.yaml").write_text(SCENARIO)

    assert app.run(["validate", str(tmp_path / "s.yaml")]) == 0
    assert "readable by the group" in capsys.readouterr().out

    monkeypatch.delenv("COSMOS_ACCESS")
    assert app.run(["validate", str(tmp_path / "s.yaml")]) == 0
    assert "readable" not in capsys.readouterr().out


@pytest.mark.process
@pytest.mark.parametrize("access", MODES)
def test_directory_on_a_machine_has_the_access(tmp_path, access):
    run = tmp_path / "cosmos/runs/0001-modes-00112233"
    (tmp_path / "cosmos").mkdir()
    program = RemoteProgram(
        name="pi01",
        module="no_such_module",
        run_directory=str(run),
        stderr="machines/pi01/stderr.txt",
        access=access,
    )
    paths = MachinePaths(
        root=str(tmp_path / "cosmos"),
        python=sys.executable,
        state=str(tmp_path / "state"),
        base_directory=str(tmp_path),
        variables={},
    )
    command = start_command(program, paths)

    subprocess.run(["/bin/sh", "-c", f"umask 0; {command}"], check=False, timeout=60)

    folder_mode, file_mode = MODES[access]
    assert [mode(path) for path in (run, run / "machines", run / "machines/pi01")] == (
        [folder_mode] * 3
    )
    assert mode(run / "machines/pi01/stderr.txt") == file_mode
    assert shlex.split(command)[0] == "exec"
