"""`cosmos run` as a person meets it: what it prints where, what it leaves, what it ends with."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml
from harness.waiting import wait_until

from cosmos_cli.app import run as cosmos
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory, alone
from cosmos_cli.launch.execute import RunOptions, manual_agents, plan_of
from cosmos_cli.models.loading import load_scenario

DRIVER = Path(__file__).parents[2] / "harness" / "launch_driver.py"
PATIENCE_S = 120.0
SCENARIO = """\
# A comment that a person wrote.
name: tiny
simulation: counter
agents: {count: 2, tick_hz: 20}
time: {duration_s: 1}
timeouts: {agents_ready_s: 120, silence_s: 30, complete_s: 60}
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.yaml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Yield an environment of its own, and see to it that nothing lives afterwards."""
    marker = str(tmp_path / "state")
    yield {
        **os.environ,
        "COSMOS_STATE_DIR": marker,
        "COSMOS_RUNS": str(tmp_path / "runs"),
        "COSMOS_FAKE_NOTES": str(tmp_path / "notes"),
    }
    survivors = [process for process in psutil.process_iter() if _is_marked(process, marker)]
    assert survivors == []


def _is_marked(process: psutil.Process, marker: str) -> bool:
    try:
        is_dead = process.status() == psutil.STATUS_ZOMBIE
        return not is_dead and process.environ().get("COSMOS_STATE_DIR") == marker
    except psutil.Error:
        return False


def start(environment: dict[str, str], *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(DRIVER), "cosmos", "run", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE_S)
    return process.returncode, out, err


def wait_for_note(environment: dict[str, str], text: str) -> None:
    notes = Path(environment["COSMOS_FAKE_NOTES"])
    wait_until(lambda: notes.exists() and text in notes.read_text(), f"note {text!r}")


def run_json(environment: dict[str, str]) -> dict[str, object]:
    (path,) = Path(environment["COSMOS_RUNS"]).glob("*/run.json")
    return dict(json.loads(path.read_text()))


@pytest.mark.process
def test_real_run_passes_and_says_where_the_evidence_lies(
    environment: dict[str, str], scenario: Path
) -> None:
    process = subprocess.run(
        [sys.executable, "-m", "cosmos_cli.app", "run", str(scenario), "--json"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE_S,
    )

    # Whether the budget holds depends on the machine that tests; that the run ended well does not.
    document = json.loads(process.stdout)
    assert process.returncode in (0, 4), process.stderr
    assert document == run_json(environment)
    assert document["status"] == "complete"
    assert document["exit_code"] == process.returncode
    assert document["agents"]["lost"] == []
    last_line = process.stderr.splitlines()[-1]
    assert last_line.endswith(f"| {Path(environment['COSMOS_RUNS']) / '0001-tiny'}")


@pytest.mark.process
def test_ctrl_c_ends_with_130_and_a_collected_run(
    environment: dict[str, str], scenario: Path
) -> None:
    environment["COSMOS_FAKE"] = json.dumps({"host": {"runs_s": 60}})
    process = start(environment, str(scenario))
    wait_for_note(environment, "launched [")
    process.send_signal(signal.SIGINT)

    code, out, err = finish(process)

    directory = Path(environment["COSMOS_RUNS"]) / "0001-tiny"
    assert code == 130, err
    assert out.startswith("INTERRUPTED")
    assert out.endswith(f"| {directory}\n")
    assert run_json(environment)["status"] == "interrupted"
    assert run_json(environment)["exit_code"] == 130
    assert directory.with_name("0001-tiny.tar.zst").exists()


@pytest.mark.process
def test_second_ctrl_c_still_collects_what_is_on_disk(
    environment: dict[str, str], scenario: Path
) -> None:
    stuck = {"runs_s": 60, "ignores_stop": True, "ignores_sigterm": True}
    environment["COSMOS_FAKE"] = json.dumps({"host": stuck})
    process = start(environment, str(scenario))
    wait_for_note(environment, "launched [")
    process.send_signal(signal.SIGINT)
    wait_for_note(environment, "told")
    process.send_signal(signal.SIGINT)

    code, _, err = finish(process)

    directory = Path(environment["COSMOS_RUNS"]) / "0001-tiny"
    assert code == 130, err
    assert run_json(environment)["status"] == "interrupted"
    assert not (directory / "report.html").exists()
    assert (directory / "manifest.json").exists()


@pytest.mark.process
def test_run_that_was_ended_at_once_is_interrupted_also_if_its_collection_was_cut_off(
    environment: dict[str, str], scenario: Path
) -> None:
    stuck = {"runs_s": 60, "ignores_stop": True, "ignores_sigterm": True}
    environment["COSMOS_FAKE"] = json.dumps({"host": stuck})
    process = start(environment, str(scenario))
    wait_for_note(environment, "launched [")
    (folder,) = Path(environment["COSMOS_RUNS"]).glob("0001-tiny")
    with alone(RunDirectory(folder)):  # the collection waits
        process.send_signal(signal.SIGINT)
        wait_for_note(environment, "told")
        process.send_signal(signal.SIGINT)
        wait_until(lambda: "interrupted" in run_json(environment), "word in run.json")
        process.send_signal(signal.SIGINT)
        code, _, err = finish(process)
    again = subprocess.run(
        [sys.executable, "-m", "cosmos_cli.start", "collect", str(folder), "--json"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=PATIENCE_S,
    )

    assert code == 130, err
    assert "interrupted while collecting" in err
    assert again.returncode == 5, again.stderr  # of the records, which this host did not leave
    assert json.loads(again.stdout)["status"] == run_json(environment)["status"] == "interrupted"
    assert run_json(environment)["exit_code"] == 130
    assert "killed" not in str(run_json(environment)["verdict"])


@pytest.mark.process
def test_closed_terminal_ends_with_the_code_of_the_summary(
    environment: dict[str, str], scenario: Path
) -> None:
    environment["COSMOS_FAKE"] = json.dumps({"host": {"runs_s": 60}})
    ours, terminal = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, str(DRIVER), "cosmos", "run", str(scenario)],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        env=environment,
        start_new_session=True,
        # As a terminal's window does for its shell: whoever leads the session hears of its end.
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )
    os.close(terminal)
    wait_for_note(environment, "launched [")
    os.close(ours)

    assert process.wait(PATIENCE_S) == 130
    assert run_json(environment)["exit_code"] == 130


@pytest.mark.process
def test_reader_that_has_left_does_not_change_the_exit_code(
    environment: dict[str, str], scenario: Path
) -> None:
    environment["COSMOS_FAKE"] = json.dumps({"host": {"runs_s": 60}})
    process = start(environment, str(scenario))
    wait_for_note(environment, "launched [")
    assert process.stdout is not None
    process.stdout.close()
    process.send_signal(signal.SIGTERM)

    assert process.wait(PATIENCE_S) == 130
    assert process.stderr is not None
    process.stderr.close()


@pytest.mark.process
@pytest.mark.parametrize(("option", "is_written"), [("--report", True), ("--no-report", False)])
def test_report_is_written_unless_it_is_not_wanted(
    environment: dict[str, str], scenario: Path, option: str, is_written: bool
) -> None:
    finish(start(environment, str(scenario), option))

    directory = Path(environment["COSMOS_RUNS"]) / "0001-tiny"
    assert (directory / "report.html").exists() is is_written


@pytest.mark.process
def test_killed_host_fails_the_run_and_names_it(
    environment: dict[str, str], scenario: Path
) -> None:
    environment["COSMOS_FAKE"] = json.dumps({"host": {"runs_s": 60, "killed_after_s": 0.2}})

    code, out, err = finish(start(environment, str(scenario)))

    assert code == 1
    assert out.startswith("FAILED")
    assert "was killed by SIGKILL before the run was over" in err
    assert "last words of the host" in err


@pytest.mark.process
def test_quiet_run_prints_the_verdict_alone(environment: dict[str, str], scenario: Path) -> None:
    _, out, err = finish(start(environment, str(scenario), "--quiet"))

    assert err == ""
    assert len(out.splitlines()) == 1


@pytest.mark.process
def test_closed_standard_output_does_not_cost_the_evidence(
    environment: dict[str, str], scenario: Path
) -> None:
    process = start(environment, str(scenario))
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    process.stderr.close()

    process.wait(PATIENCE_S)

    assert run_json(environment)["status"] == "complete"


@pytest.mark.process
def test_scenario_is_kept_as_it_was_run(environment: dict[str, str], scenario: Path) -> None:
    finish(start(environment, str(scenario)))
    finish(start(environment, str(scenario), "--set", "seed=7", "--duration", "2.5"))

    runs = Path(environment["COSMOS_RUNS"])
    assert (runs / "0001-tiny" / "scenario.yaml").read_text() == SCENARIO
    text = (runs / "0002-tiny" / "scenario.yaml").read_text()
    resolved = yaml.safe_load(text)
    assert "#   --set seed=7\n#   --set time.duration_s=2.5\n" in text
    assert (resolved["seed"], resolved["time"]["duration_s"]) == (7, 2.5)
    plan = json.loads((runs / "0002-tiny" / "plan.json").read_text())
    assert plan["config"]["seed"] == 7


@pytest.mark.process
def test_agents_are_started_by_hand_by_their_second_names_too(tmp_path: Path) -> None:
    scenario = load_scenario(Path(__file__).parents[3] / "scenarios/iridium10.yaml")
    agents, names = zip(*list(scenario.labels.names.items())[:2], strict=True)

    def chosen(*manual: str) -> list[str]:
        options = RunOptions(runs=tmp_path, manual=manual)
        return manual_agents(options, plan_of(scenario, options), scenario.labels)

    assert chosen(names[1], agents[0]) == list(agents)
    assert scenario.labels.named(agents[0]) == f"{agents[0]} ({names[0]})"
    with pytest.raises(InputError, match="--manual IRIDIUM 0: no such agent"):
        chosen("IRIDIUM 0")


def test_unknown_manual_agent_is_bad_input_and_makes_no_run(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"

    code = cosmos(["run", str(scenario), "--runs", str(runs), "--manual", "agent-9"])

    assert code == 2
    assert (
        "--manual agent-9: no such agent; there are agent-01, agent-02" in capsys.readouterr().err
    )
    assert not runs.exists()


def test_faulty_scenario_is_bad_input_and_makes_no_run(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs"

    code = cosmos(["run", str(scenario), "--runs", str(runs), "--duration", "-1"])

    assert code == 2
    assert "--duration: expected > 0" in capsys.readouterr().err
    assert not runs.exists()


@pytest.mark.parametrize("error", [TypeError("a defect"), OSError(28, "No space left on device")])
def test_run_that_cannot_begin_leaves_no_folder(
    scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("cosmos_cli.launch.execute.begin_run", fail)
    code = cosmos(["run", str(scenario), "--runs", str(tmp_path / "runs")])

    assert code != 0
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.parametrize(
    "override",
    [
        "recording.not_finite_max=100000000000000000000",
        "network.receive_buffer_bytes=0xffffffffffffffffffff",
        "scheduling.cpu_affinity=[99999999999999999999999]",
        "parameters.big=-99999999999999999999999",
    ],
)
def test_whole_number_beyond_64_bits_is_bad_input(
    scenario: Path, capsys: pytest.CaptureFixture[str], override: str
) -> None:
    assert cosmos(["validate", str(scenario), "--set", override]) == 2
    said = capsys.readouterr().err
    assert f"--set {override.partition('=')[0]}: expected a whole number from -2^63" in said
