"""Standard output that takes nothing: full, closed, or whose reader has gone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from harness.nights import by_night
from harness.synthetic_run import SyntheticRun

from cosmos_cli import app
from cosmos_cli.commands import inject

COSMOS = f"{sys.executable} -m cosmos_cli.app"
TO_NOBODY = ">&3"
"""Into a pipe whose reader has gone before the command begins."""


def shell(command: str) -> subprocess.CompletedProcess[str]:
    begin = "exec 3> >(true); wait $!; "
    return subprocess.run(
        ["bash", "-c", begin + command], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def run_path(tmp_path: Path) -> Path:
    made = SyntheticRun(tmp_path).write()
    made.run.left_result_json.write_text('{"status": "complete"')
    return made.run.path


@pytest.mark.process
@pytest.mark.parametrize("json", ["", "--json"])
@pytest.mark.parametrize(
    ("redirection", "why"),
    [(">/dev/full", "No space left on device"), (">&-", "it is closed")],
)
def test_verdicts_exit_code_survives_an_output_that_takes_nothing(
    run_path: Path, redirection: str, why: str, json: str
) -> None:
    ended = shell(f"{COSMOS} collect {run_path} -q {json} {redirection}")

    assert ended.returncode == 5
    lines = ended.stderr.splitlines()
    assert [line for line in lines if line.startswith("error: ")] == [
        f"error: stdout: {why}; FAILED: host: it ended without a result; was it killed?; "
        f"it stands in {run_path / 'run.json'}"
    ]
    assert "defect" not in ended.stderr


@pytest.mark.process
@pytest.mark.parametrize(("limit", "code"), [(100, 0), (0, 4)])
def test_verdicts_exit_code_survives_talk_that_nothing_takes(
    tmp_path: Path, limit: int, code: int
) -> None:
    """The interpreter ends with 120 where it cannot write what is left of its talk."""
    scenario = tmp_path / "a.yaml"
    check = f"{{name: few, stream: round_trips, field: packet, statistic: max, below: {limit}}}"
    scenario.write_text(f"{TINY}checks: [{check}]\n")

    ended = shell(
        f"{sys.executable} -m cosmos_cli.start run {scenario} --runs {tmp_path / 'runs'} --no-report 2>/dev/full"
    )

    assert ended.returncode == code, ended.stdout


@pytest.mark.process
def test_verdicts_exit_code_survives_a_reader_that_has_gone(run_path: Path) -> None:
    ended = shell(f"{COSMOS} collect {run_path} -q --json {TO_NOBODY}")

    assert ended.returncode == 5
    assert "defect" not in ended.stderr
    assert "Exception ignored" not in ended.stderr


TINY = "name: tiny\nsimulation: counter\nagents: {count: 1, tick_hz: 5}\ntime: {mode: lockstep, duration_s: 1}\n"


@pytest.mark.process
@pytest.mark.parametrize(
    "redirection", by_night([TO_NOBODY, f"{TO_NOBODY} 2>&1", ">&-"], day=[TO_NOBODY])
)
def test_tests_go_on_without_an_output_and_tell_by_their_file_and_code(
    tmp_path: Path, redirection: str
) -> None:
    for name, code in (("a", 1), ("b", 0)):
        (tmp_path / f"{name}.yaml").write_text(f"{TINY}test: {{expect: {{exit_code: {code}}}}}\n")
    junit = tmp_path / "results.xml"

    ended = shell(
        f"{COSMOS} test {tmp_path} -j 1 --runs {tmp_path / 'runs'} --junit {junit} {redirection}"
    )

    assert ended.returncode == 1
    assert 'tests="2"' in junit.read_text()
    assert 'failures="1"' in junit.read_text()
    assert ended.stderr.count("error: ") == ("2>&1" not in redirection)


@pytest.mark.process
@pytest.mark.parametrize(("above", "code"), [(3, 0), (100, 4)])
def test_code_of_judge_survives_a_reader_that_has_gone(
    tmp_path: Path, above: int, code: int
) -> None:
    (tmp_path / "a.yaml").write_text(TINY)
    (tmp_path / "b.yaml").write_text(
        f"{TINY}checks: [{{name: few, stream: round_trips, statistic: count, above: {above}}}]\n"
    )
    shell(f"{COSMOS} run {tmp_path / 'a.yaml'} --runs {tmp_path / 'runs'} -q")

    ended = shell(f"{COSMOS} judge -s {tmp_path / 'b.yaml'} --runs {tmp_path / 'runs'} {TO_NOBODY}")

    assert ended.returncode == code


@pytest.mark.process
@pytest.mark.parametrize("command", ["down --all", "wipe -i {inventory} --yes"])
def test_code_of_what_was_done_survives_a_full_output(tmp_path: Path, command: str) -> None:
    inventory = tmp_path / "here.yaml"
    inventory.write_text("all: {hosts: {here: {ansible_connection: local}}}\n")
    state = f"COSMOS_STATE_DIR={tmp_path}/state COSMOS_RUNS={tmp_path}/runs"

    ended = shell(f"{state} {COSMOS} {command.format(inventory=inventory)} --json >/dev/full")

    assert ended.returncode == 0, ended.stderr
    assert ended.stderr.count("error: stdout: No space left on device; the exit code tells") == 1


@pytest.mark.process
@pytest.mark.parametrize(("redirection", "code"), [(">/dev/full", 1), (TO_NOBODY, 0)])
def test_what_machines_said_is_nowhere_else_and_fails_on_a_full_disk_alone(
    tmp_path: Path, redirection: str, code: int
) -> None:
    inventory = tmp_path / "here.yaml"
    inventory.write_text("all: {hosts: {here: {ansible_connection: local}}}\n")

    ended = shell(
        f"{COSMOS} exec -i {inventory} --json -- 'echo said; touch {tmp_path}/done' {redirection}"
    )

    assert ended.returncode == code, ended.stderr
    assert (tmp_path / "done").exists()


@pytest.mark.parametrize(("refusal", "code"), [(None, 0), ("no such agent", 1)])
def test_code_of_inject_survives_a_full_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refusal: str | None, code: int
) -> None:
    run = SyntheticRun(tmp_path).write().run
    monkeypatch.setattr(inject, "order_action", lambda *given: {"refusal": refusal or ""})
    with open("/dev/full", "w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)

        assert app.run(["inject", str(run.path), "agent-01", "annotate", "text=x"]) == code


@pytest.mark.process
def test_collecting_goes_on_when_nobody_hears_its_talk(run_path: Path) -> None:
    ended = shell(f"{COSMOS} collect {run_path} {TO_NOBODY} 2>&1")

    assert ended.returncode == 5
    assert (run_path / "run.json").exists()


@pytest.mark.process
@pytest.mark.parametrize("redirection", [">/dev/full", ">&-"])
def test_other_commands_end_with_1_and_one_line(redirection: str) -> None:
    ended = shell(f"{COSMOS} schema {redirection}")

    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("error: stdout: ")


@pytest.mark.process
def test_a_reader_that_has_gone_is_told_as_by_a_shell_and_not_as_a_failure() -> None:
    ended = shell(f"{COSMOS} schema {TO_NOBODY}")

    assert (ended.returncode, ended.stderr) == (141, "")


@pytest.mark.process
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_goes_in_the_middle_is_told_also_where_python_does_not_buffer(
    unbuffered: str,
) -> None:
    """Unbuffered, Python takes a write that was cut for a whole one, as containers are often set up."""
    begin = "head -c 1 >/dev/null"
    ended = shell(
        f"PYTHONUNBUFFERED={unbuffered} {COSMOS} schema | {begin}; exit ${{PIPESTATUS[0]}}"
    )

    assert (ended.returncode, ended.stderr) == (141, "")


@pytest.mark.process
def test_a_disk_that_fills_up_in_the_middle_is_told_also_where_python_does_not_buffer(
    tmp_path: Path,
) -> None:
    limit = "ulimit -f 64; trap '' XFSZ"
    ended = shell(f"{limit}; PYTHONUNBUFFERED=1 {COSMOS} schema > {tmp_path / 'schema.json'}")

    assert (tmp_path / "schema.json").stat().st_size == 65_536
    assert (ended.returncode, ended.stderr) == (1, "error: stdout: File too large\n")


@pytest.mark.process
def test_commands_work_without_any_standard_stream(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: counter\nagents: {count: 3}\nsed: 1\n")

    assert shell(f"{COSMOS} validate {tmp_path / 'a.yaml'} <&- >&- 2>&-").returncode == 2


@pytest.mark.process
def test_a_command_that_asks_says_without_a_standard_input_how_to_agree() -> None:
    ended = shell(f"{COSMOS} reboot -i pi07, <&-")

    assert ended.returncode == 2
    assert ended.stderr == "error: reboot 1 machine (pi07): nobody is there to ask; give --yes\n"
