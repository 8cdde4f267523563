"""The simulation as a whole, in lockstep: as fast as this computer can, and the same each time."""

import json
import subprocess
import sys
from pathlib import Path

SCENARIO = Path(__file__).parents[1] / "@NAME@.yaml"


def run(folder, *settings):
    """Run the scenario in lockstep, and return its exit code and run.json."""
    command = [sys.executable, "-m", "cosmos_cli.app", "run", str(SCENARIO), "--json", "--quiet"]
    for setting in ("time.mode=lockstep", *settings):
        command += ["--set", setting]
    done = subprocess.run(
        [*command, "--runs", str(folder)], capture_output=True, text=True, timeout=300
    )
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def test_rovers_reach_their_marks_and_all_that_is_recorded_is_declared(tmp_path):
    code, document = run(tmp_path)

    assert (code, document["status"]) == (0, "complete"), document["verdict"]
    assert [text for text in document["remarks"] if "declared" in text] == []
    assert {check["name"] for check in document["checks"]} >= {"error_m"}
    page = (tmp_path / document["run"] / "report.html").read_text(encoding="utf-8")
    assert "Positions of all rovers" in page


def test_run_of_one_seed_repeats_to_the_bit(tmp_path):
    first, second = (run(tmp_path, "time.duration_s=2", "parameters.error_max_m=9") for _ in "ab")

    assert (first[0], second[0]) == (0, 0), (first[1]["verdict"], second[1]["verdict"])
    assert first[1]["records_sha256"] == second[1]["records_sha256"]
