"""A host that is ended with its test."""

import pytest
from lockstep_host import HostRun


@pytest.fixture
def start_host(tmp_path):
    """Return a function that starts hosts, each in a folder of its own."""
    started = []

    def start(**options):
        run = HostRun(tmp_path / f"run{len(started)}", **options)
        started.append(run)
        return run

    yield start
    for run in started:
        run.process.kill()
        run.process.wait()
        run.process.stdout.close()
