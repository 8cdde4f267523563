"""`cosmos facts` tells what machines are like, and nobody's failure hides another's answer."""

from __future__ import annotations

import json
import os
import platform

import pytest
from ssh_harness import needs_sshd
from sshd import Sshd

from cosmos_cli.app import run

pytestmark = pytest.mark.process

NAMES = [
    *(
        "model",
        "architecture",
        "bits",
        "processors",
        "node",
        "kernel",
        "preempt_rt",
        "os",
        "python",
    ),
    *("python_executable", "user", "clock_offset_s", "uptime_s", "boot_id", "disk_total_bytes"),
    *("disk_free_bytes", "memory_total_bytes", "memory_available_bytes", "temperature_c"),
    *("throttled", "receive_buffer_bytes_max", "realtime_priority_max", "governors", "radios"),
    "can_become_root",
]
"""What scripts may rely on: a new name may join them, none may go."""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    needs_sshd()
    with Sshd(tmp_path_factory.mktemp("facts")) as one:
        yield one


@pytest.fixture
def inventory(server, tmp_path, known_hosts, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    known_hosts.write_text(server.known_hosts_line())
    hosts = {
        "pi1": server.variables,
        "here": {"ansible_connection": "local", "ansible_become": False},
        "bad": {"ansible_host": "no-such-machine.invalid"},
    }
    path = tmp_path / "i.yaml"
    path.write_text(json.dumps({"all": {"hosts": hosts}}))
    return str(path)


def test_facts_are_told_of_every_machine_that_answers(inventory, capsys):
    assert run(["facts", "-i", inventory, "--json"]) == 3

    answer = json.loads(capsys.readouterr().out)
    machines = {machine["machine"]: machine for machine in answer["machines"]}
    assert list(answer) == ["machines", "retry", "exit_code"]
    assert [machine["ok"] for machine in answer["machines"]] == [True, True, False]
    assert machines["bad"]["facts"] is None
    assert machines["bad"]["failure"]["kind"] == "unreachable"
    for name in ("pi1", "here"):
        told = machines[name]["facts"]
        assert set(NAMES) <= set(told)
        assert told["architecture"] == platform.machine()
        assert told["processors"] == os.cpu_count()
        assert abs(told["clock_offset_s"]) < 1
    assert machines["here"]["facts"]["can_become_root"] is None  # the inventory forbids to ask


def test_table_has_a_line_for_each_machine_and_a_verdict(inventory, capsys):
    assert run(["facts", "-i", inventory]) == 3

    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("bad  failed  ")
    assert [line.split()[0] for line in lines[1:4]] == ["machine", "pi1", "here"]
    assert lines[4] == "3 machines: 2 answered, 1 failed"


def test_nothing_is_changed_on_a_machine(inventory, capsys, tmp_path):
    home = tmp_path / "untouched"
    home.mkdir()
    text = inventory.replace("i.yaml", "local.yaml")
    with open(text, "w") as file:
        json.dump(
            {
                "all": {
                    "hosts": {
                        "here": {"ansible_connection": "local", "cosmos_root": str(home / "c")}
                    }
                }
            },
            file,
        )

    assert run(["facts", "-i", text]) == 0
    assert list(home.iterdir()) == []
