"""The tests' own servers end with the tests, also when nobody can say goodbye."""

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from ssh_harness import needs_sshd

pytestmark = pytest.mark.process

PATIENCE_S = 60
STARTER = """
import subprocess, sys, time
from pathlib import Path
from sshd import Sshd

with Sshd(Path(sys.argv[1])) as server:
    log_in = ["ssh", "-F", "none", "-p", str(server.port), "-i", str(server.user_key),
        "-o", "StrictHostKeyChecking=no", "-o", "UserKnownHostsFile=/dev/null", "-o", "LogLevel=ERROR",
        f"{server.user}@{server.address}"]
    orphan = "setsid sleep 300 </dev/null >/dev/null 2>&1 & echo $!"
    pid = subprocess.run([*log_in, orphan], capture_output=True, text=True, check=True).stdout
    server.freeze()
    print(server.pid, pid.strip(), flush=True)
    time.sleep(300)
"""


def test_nothing_of_a_server_survives_the_test_process_that_was_killed(tmp_path):
    needs_sshd()
    folder = Path(__file__).parent
    tests = str(folder.parents[1])
    starter = subprocess.Popen(
        [sys.executable, "-c", STARTER, str(tmp_path / "s")],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": tests},
        stdout=subprocess.PIPE,
        text=True,
    )
    with starter:
        assert starter.stdout is not None
        pids = [int(word) for word in starter.stdout.readline().split()]
        assert len(pids) == 2
        assert all(map(psutil.pid_exists, pids))

        starter.kill()

    until_s = time.monotonic() + PATIENCE_S
    while any(map(psutil.pid_exists, pids)) and time.monotonic() < until_s:
        time.sleep(0.05)
    assert [pid for pid in pids if psutil.pid_exists(pid)] == []
