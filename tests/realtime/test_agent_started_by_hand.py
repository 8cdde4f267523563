"""An agent that a person starts by hand, and that its run does not want."""

from __future__ import annotations

import subprocess
import sys

import pytest

from madns_runtime import private_socket

pytestmark = pytest.mark.process

PATIENCE_S = 60.0


@pytest.mark.parametrize("folder", ["short", "long" * 50])
def test_second_one_for_an_agent_is_told_that_its_place_is_taken(tmp_path, folder):
    (tmp_path / folder).mkdir()
    with private_socket.listen(tmp_path / folder, "launch", 1) as listener:
        path = str(tmp_path / folder / "launch")
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
