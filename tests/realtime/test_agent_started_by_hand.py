"""An agent that a person starts by hand, and that its run does not want."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

PATIENCE_S = 60.0


def test_second_one_for_a_seat_is_told_that_it_is_taken(tmp_path):
    path = str(tmp_path / "launch")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(path)
        listener.listen()
        command = [sys.executable, "-P", "-m", "madns_runtime.agent", "--launch", path]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as agent:
            listener.settimeout(PATIENCE_S)
            listener.accept()[0].close()  # as a run does whose agent is there
            _, told = agent.communicate(timeout=PATIENCE_S)

    assert agent.returncode == 1
    assert told == (
        "madns-agent: the run gave nothing to start with: this agent has been started already,"
        " or the run is over\n"
    )
