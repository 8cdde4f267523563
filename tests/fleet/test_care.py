"""`cosmos doctor`, `reboot` and `packages` over real SSH on virtual boards."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tower import Tower
from tower.fixtures import need_tower

import madns_runtime.processes

pytestmark = pytest.mark.root

PATIENCE_S = 120.0
NAMES = ("pi01", "pi02", "pi03")
HELLO = "cosmos-test-hello"
REGISTER = """
import subprocess, sys, time
{source}
register("0007-iridium10", "supervisor", "pi01", "/home/pi/cosmos/runs/0007-iridium10-aabbccdd")
time.sleep(600)
"""


CONNECT_S = 90


class Care:
    """The commands on three boards."""

    def __init__(self, tower: Tower, folder: Path) -> None:
        self.tower = tower
        self.folder = folder
        self.inventory = tower.write_inventory(folder / "inventory.yaml")
        self.environment = {
            **os.environ,
            **tower.operator_environment(),
            "COSMOS_RUNS": str(folder / "runs"),
            "COSMOS_STATE_DIR": str(folder / "state"),
        }

    def be_patient(self) -> None:
        """Wait longer for connections: a board whose disk is full may be slow to say a word on a busy machine."""
        config = self.folder / "ssh_config"
        given = Path(self.environment["COSMOS_SSH_CONFIG"]).read_text()
        config.write_text(f"ConnectTimeout {CONNECT_S}\n{given}")
        self.environment["COSMOS_SSH_CONFIG"] = str(config)

    def start(self, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "cosmos_cli.app", *words, "-i", str(self.inventory)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environment,
        )

    def cosmos(self, *words: str) -> tuple[int, dict[str, Any]]:
        """Run a command with --json and return its exit code and answer."""
        process = self.start(*words, "--json")
        out, talk = process.communicate(timeout=PATIENCE_S)
        assert out, talk
        return process.returncode, json.loads(out)

    def boots(self, name: str) -> int:
        return int(self.tower.state()["boards"][name]["boots"])


@pytest.fixture(scope="module")
def own_tower() -> Iterator[Tower]:
    need_tower()
    with Tower(count=len(NAMES)) as tower:
        yield tower


@pytest.fixture
def care(own_tower: Tower, tmp_path: Path) -> Care:
    own_tower.reflash()
    return Care(own_tower, tmp_path)


def findings(answer: dict[str, Any], machine: str) -> dict[str, str]:
    """Return the worst level of each check of a machine."""
    levels = ("ok", "note", "warning", "error")
    found: dict[str, str] = {}
    (told,) = [item for item in answer["machines"] if item["machine"] == machine]
    for item in told["findings"]:
        before = found.get(item["check"], "ok")
        found[item["check"]] = max(before, item["level"], key=levels.index)
    return found


def test_doctor_finds_what_is_wrong_with_each_board(care: Care) -> None:
    tower = care.tower
    tower.fault("pi01", "throttle", "0x50005")
    tower.fault("pi01", "temperature", 85)
    tower.fault("pi02", "fill", 20)
    tower.run("pi03", "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/*governor")
    tower.run("pi03", "echo 8388608 | sudo tee /proc/sys/net/core/rmem_max")
    nobody = ".".join([*tower.address.split(".")[:2], "250", "250"])
    care.inventory = tower.write_inventory(
        care.inventory, machines={"pi01": {"cosmos_host_address": nobody}}
    )

    code, answer = care.cosmos("doctor")

    first, second, third = (findings(answer, name) for name in NAMES)
    assert code == 1
    assert (first["throttled"], first["temperature"], first["udp"]) == ("error", "error", "error")
    assert (first["governor"], first["receive_buffer"]) == ("warning", "warning")
    assert second["disk_space"] == "error"
    # A busy computer may lose one of the fifty datagrams: that is a warning.
    assert second["udp"] in ("ok", "warning")
    assert (second["throttled"], second["udp_unasked"]) == ("ok", "ok")
    assert (third["governor"], third["receive_buffer"]) == ("ok", "ok")
    assert "error" not in third.values()
    assert {found["realtime"] for found in (first, second, third)} <= {"ok", "warning"}
    assert findings(answer, "this computer")["uv"] in ("ok", "warning")


def test_doctor_finds_a_worn_card_and_a_bad_cable(care: Care) -> None:
    care.tower.fault("pi01", "ro")
    care.tower.fault("pi02", "udploss", 10)

    code, answer = care.cosmos("doctor", "--limit", "pi01:pi02")

    worn = findings(answer, "pi01")
    assert code == 1
    assert "error" in (worn["disk_writable"], worn.get("disk_write"))
    assert findings(answer, "pi02")["udp"] == "warning"


def test_machine_that_cannot_be_asked_hides_nobody(care: Care) -> None:
    care.tower.fault("pi02", "freeze")

    code, answer = care.cosmos("doctor", "--limit", "pi01:pi02")

    failures = {item["machine"]: item["failure"] for item in answer["machines"]}
    assert code == 3
    assert failures["pi02"]["kind"] in ("frozen", "unreachable", "timeout")
    assert failures["pi01"] is None
    assert findings(answer, "pi01")["udp"] in ("ok", "warning")  # as above


@pytest.mark.nightly
def test_reboot_waits_until_each_is_back(care: Care) -> None:
    before = {name: care.boots(name) for name in NAMES}

    code, answer = care.cosmos("reboot", "--yes")

    assert code == 0
    assert {name: care.boots(name) for name in NAMES} == {n: b + 1 for n, b in before.items()}
    assert all(m["status"] == "back" and 0 < m["back_s"] < 60 for m in answer["machines"])
    state = care.tower.state()["boards"]
    assert {m["machine"]: m["boot_id"] for m in answer["machines"]} == {
        name: state[name]["boot_id"] for name in NAMES
    }


@pytest.mark.nightly
def test_board_with_a_run_or_without_sudo_is_not_rebooted(care: Care) -> None:
    before = {name: care.boots(name) for name in NAMES}
    source = Path(madns_runtime.processes.__file__).read_text()
    program = source.replace("from __future__ import annotations\n", "")
    program = "from __future__ import annotations\n" + REGISTER.format(source=program)
    care.tower.run("pi01", f"echo {shlex.quote(program)} > /tmp/member.py")
    care.tower.run(
        "pi01",
        "COSMOS_STATE_DIR=~/cosmos/state setsid -f python3 /tmp/member.py </dev/null >/dev/null 2>&1;"
        " until ls ~/cosmos/state/processes/*.json; do sleep 0.1; done",
    )
    care.tower.fault("pi02", "no-sudo")

    code, answer = care.cosmos("reboot", "--yes")

    failures = {item["machine"]: item["failure"] for item in answer["machines"]}
    assert code == 3
    assert failures["pi01"]["kind"] == "busy"
    assert "0007-iridium10 lives there" in failures["pi01"]["text"]
    assert failures["pi02"]["kind"] == "no_sudo"
    assert failures["pi03"] is None
    assert {name: care.boots(name) - before[name] for name in NAMES} == {
        "pi01": 0,
        "pi02": 0,
        "pi03": 1,
    }

    code, _ = care.cosmos("reboot", "--yes", "--force", "--limit", "pi01")

    assert (code, care.boots("pi01") - before["pi01"]) == (0, 1)


@pytest.mark.nightly
def test_board_that_does_not_come_back_in_time_failed(make_tower, tmp_path: Path) -> None:
    tower = make_tower(count=1, boot_delay_s=60.0)

    code, answer = Care(tower, tmp_path).cosmos("reboot", "--yes", "--timeout", "3")

    (machine,) = answer["machines"]
    assert code == 3
    assert machine["failure"]["kind"] == "timeout"
    assert machine["failure"]["text"].startswith("not back in 3 s")


def test_packages_come_change_and_go_and_nothing_changes_twice(care: Care) -> None:
    def told(*words: str) -> list[tuple[str | None, str | None]]:
        code, answer = care.cosmos("packages", *words)
        assert code == 0
        assert {m["machine"] for m in answer["machines"]} == set(NAMES)
        return [(c["old"], c["new"]) for m in answer["machines"] for c in m["changes"]]

    assert told("install", HELLO) == [(None, "1.0")] * 3
    assert care.tower.run("pi02", HELLO).returncode == 0
    assert told("install", HELLO) == []
    care.tower.fault("pi02", "publish-update")
    assert told("upgrade") == [("1.0", "1.1")]
    assert told("upgrade") == []
    assert sorted(told("remove", HELLO, "--check")) == [("1.0", None)] * 2 + [("1.1", None)]
    assert sorted(told("remove", HELLO)) == [("1.0", None)] * 2 + [("1.1", None)]
    assert told("remove", HELLO) == []


def test_troubles_of_apt_are_told_in_words(care: Care) -> None:
    tower = care.tower
    care.be_patient()
    tower.run("pi01", "sudo touch /var/lib/dpkg/updates/0001")
    tower.fault("pi02", "fill", 1)
    tower.fault("pi03", "no-sudo")

    code, answer = care.cosmos("packages", "install", HELLO)

    machines = {machine["machine"]: machine for machine in answer["machines"]}
    assert code == 3
    assert machines["pi01"]["changes"] == [{"name": HELLO, "old": None, "new": "1.0"}]
    assert machines["pi01"]["notes"] == [
        "finished an interrupted installation: dpkg --configure -a"
    ]
    assert machines["pi02"]["failure"]["kind"] == "disk_full"
    assert machines["pi03"]["failure"]["kind"] == "no_sudo"

    code, answer = care.cosmos("packages", "install", "numpy", "--limit", "pi01")

    assert code == 3
    assert "have no numpy" in answer["machines"][0]["failure"]["text"]
    assert "`requirements` of the scenario" in answer["machines"][0]["failure"]["advice"]


@pytest.mark.nightly
def test_apt_of_somebody_else_is_waited_for(care: Care) -> None:
    hold = "import fcntl,time; f=open('/var/lib/dpkg/lock-frontend','w'); fcntl.lockf(f,2); print(1,flush=True); time.sleep(4)"
    care.tower.run("pi01", "sudo apt-get update")
    care.tower.run(
        "pi01",
        f"sudo setsid -f python3 -c {shlex.quote(hold)} </dev/null >/tmp/held 2>&1;"
        " until grep -q 1 /tmp/held; do sleep 0.1; done",
    )

    code, answer = care.cosmos("packages", "install", HELLO, "--limit", "pi01")

    assert (code, answer["changed"]) == (0, 1)
