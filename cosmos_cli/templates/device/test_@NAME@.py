"""The driver alone, and in a run."""

import importlib.util
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SPEC = importlib.util.spec_from_file_location("driver", HERE / "@NAME@.py")
driver = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(driver)


def test_driver_reads_what_stands_there(tmp_path):
    file = tmp_path / "load"
    file.write_text("1.25 0.50 0.25 1/100 4711\n")
    device = driver.Driver(driver.DriverParameters(file=str(file)))

    assert device.open() == "load"
    sample = device.read()
    device.close()

    assert sample.values == {"load": 1.25}
    assert sample.taken_s <= time.monotonic()


def test_device_that_is_not_there_is_told(tmp_path):
    device = driver.Driver(driver.DriverParameters(file=str(tmp_path / "none")))

    with pytest.raises(FileNotFoundError):
        device.open()


def test_samples_reach_the_host_in_a_run(tmp_path):
    command = [sys.executable, "-m", "cosmos_cli.app", "run", str(HERE / "@NAME@.yaml")]
    for setting in ("time.duration_s=3", "deadline.max_miss_ratio=1", "hardware.stale_ratio=1"):
        command += ["--set", setting]
    done = subprocess.run(
        [*command, "--runs", str(tmp_path), "--no-report", "--json", "--quiet"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.stdout, done.stderr
    document = json.loads(done.stdout)

    assert done.returncode == 0, document["verdict"]
    assert document["simulation"]["host"]["device_samples"]["agent-01"] > 5
