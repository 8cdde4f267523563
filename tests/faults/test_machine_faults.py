"""What the machine refuses: a port that is taken, a disk that is full."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
from pathlib import Path

import pytest
from fault_harness import Laboratory, Run, check_ending

from madns_runtime.recording.reader import read_stream

pytestmark = pytest.mark.process

DISK = "3M"
"""A tenth of it holds what a run without waste records; a third is the reserve for the summary."""


def test_taken_port_is_named(laboratory):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        run = laboratory.start("--set", f"network.port={port}")
        said = f"FAILED: host: 127.0.0.1:{port}"
        document = check_ending(run, 1, "failed", said, has_records=False)

    assert document["who"] == "host"
    assert "the UDP port is taken" in document["reason"]
    assert laboratory.leftovers() == []


def can_mount() -> bool:
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        return False
    tried = ["unshare", "--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return subprocess.run(tried, capture_output=True, check=False).returncode == 0


def run_on_small_disk(laboratory: Laboratory, *arguments: str, **faults: int) -> tuple[Run, Path]:
    """
    Run with a runs folder that is a tiny disk, and return the run and where its directory was copied to.

    The disk is mounted in a mount namespace of the run's own: the kernel unmounts it with the last of
    its processes, whatever becomes of the test.
    """
    if not can_mount():
        pytest.skip("needs root and mount namespaces")
    laboratory.runs.mkdir()
    kept = laboratory.folder / "kept"
    script = (
        f'mount -t tmpfs -o size={DISK} tmpfs "{laboratory.runs}" || exit 99; "$@"; code=$?;'
        f' cp -r "{laboratory.runs}" "{kept}"; exit $code'
    )
    prefix = ("unshare", "--mount", "sh", "-c", script, "sh")
    run = laboratory.start(*arguments, "--set", "time.duration_s=5", faults=faults, prefix=prefix)
    run.finish()
    return run, kept / "0001-fault"


@pytest.mark.root
@pytest.mark.parametrize(
    ("source", "stream", "faults"),
    [
        ("agent-02", "waves", {"waste_bytes": 100_000}),
        ("host", "echoes", {"host_waste_bytes": 40_000}),
    ],
    ids=["agent", "host"],
)
def test_full_disk_ends_with_5_names_the_source_and_counts_what_was_dropped(
    laboratory, source, stream, faults
):
    run, directory = run_on_small_disk(laboratory, **faults)
    records_due = {"agent-02": 100, "host": 300}

    assert run.finish() == 5, run.describe()
    document = json.loads((directory / "run.json").read_text())
    assert (document["status"], document["exit_code"]) == ("complete", 5)
    gaps = [line for line in document["data"]["missing"] if line.startswith(f"{source}: ")]
    assert len(gaps) == 1
    assert "No space left on device" in gaps[0]
    assert "No space left on device" in run.out
    assert source in run.out
    assert run.out.splitlines()[-1].startswith("DATA INCOMPLETE: ")
    # It was said at once, not only in the end.
    whose = "" if source == "host" else f"{source}: "
    assert f"error: host: {whose}records are being lost: " in run.talk
    folder = directory / ("host" if source == "host" else f"agents/{source}")
    reading = read_stream(folder / f"{stream}.jsonl")
    held = sum(1 for _ in reading.records())
    # What is there is whole, and what is not there is counted.
    assert reading.state.damaged == 0
    assert reading.state.dropped > 0
    assert document["records"]["dropped"] >= reading.state.dropped
    assert held + reading.state.dropped <= records_due[source]
    assert list(directory.rglob("*.part")) == []
    manifest = json.loads((directory / "manifest.json").read_text())["files"]
    assert manifest[f"{folder.relative_to(directory)}/{stream}.jsonl"]["dropped"] > 0


@pytest.mark.root
def test_disk_without_room_for_the_summary_is_bad_input(laboratory):
    if not can_mount():
        pytest.skip("needs root and mount namespaces")
    laboratory.runs.mkdir()
    script = f'mount -t tmpfs -o size=512k tmpfs "{laboratory.runs}" || exit 99; "$@"'
    run = laboratory.start(prefix=("unshare", "--mount", "sh", "-c", script, "sh"))

    assert run.finish() == 2
    assert "cannot make a run directory: No space left on device" in run.talk


@pytest.mark.root
@pytest.mark.parametrize(
    ("source", "faults"),
    [("agent-02", {"waste_bytes": 100_000}), ("host", {"host_waste_bytes": 40_000})],
    ids=["agent", "host"],
)
def test_full_disk_ends_a_lockstep_run_in_good_order_and_is_named(laboratory, source, faults):
    run, directory = run_on_small_disk(laboratory, "--set", "time.mode=lockstep", **faults)

    assert run.finish() == 1, run.describe()
    document = json.loads((directory / "run.json").read_text())
    assert (document["status"], document["who"]) == ("failed", source), run.describe()
    assert "No space left on device" in document["reason"]
    # Nobody was killed: everybody has said what became of the records.
    result = json.loads((directory / "result.json").read_text())
    assert result["not_stopped"] == []
    assert {agent["state"] for agent in result["agents"].values()} == {"stopped"}
    whose = result["records"] if source == "host" else result["agents"][source]["records"]
    assert whose["dropped"] > 0
