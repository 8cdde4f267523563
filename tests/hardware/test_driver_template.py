"""The driver that `cosmos init --template device` writes runs as it is, and passes its own test."""

import subprocess
import sys

import pytest
from harness.cosmos_command import CosmosCommand

pytestmark = pytest.mark.process


def test_the_template_passes_its_own_test(tmp_path):
    cosmos = CosmosCommand(tmp_path)

    done = cosmos("init", "my-probe", "--template", "device")
    assert done.returncode == 0, done.stderr
    assert cosmos("validate", "my-probe.yaml").returncode == 0
    names = {path.name for path in tmp_path.iterdir()}
    assert {"my-probe.py", "my-probe.yaml", "test_my-probe.py"} <= names

    tested = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my-probe.py"],
        cwd=tmp_path,
        env=cosmos.environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert tested.returncode == 0, tested.stdout + tested.stderr
    assert "3 passed" in tested.stdout
