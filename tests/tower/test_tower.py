"""What a board is: its own computer, like a Raspberry Pi where `cosmos` looks, and nothing of ours."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from .setup import CAPABILITIES_DROPPED
from .specification import BoardSpec
from .tower import Tower, TowerError

pytestmark = pytest.mark.root

REAL_SETTINGS = ("net/core/rmem_max", "net/core/rmem_default")


@pytest.fixture(scope="module")
def tower() -> Iterator[Tower]:
    boards = [BoardSpec(name="old", python="old"), BoardSpec(name="bare", python="none")]
    from .fixtures import need_tower

    need_tower()
    with Tower(count=2, boards=boards, boot_delay_s=0.2) as tower:
        yield tower


def read(tower: Tower, name: str, command: str) -> str:
    return tower.run(name, command).stdout.strip()


def test_user_logs_in_and_has_sudo(tower):
    assert read(tower, "pi01", "hostname; id -un; sudo id -un; pwd").split() == [
        "pi01",
        "pi",
        "root",
        "/home/pi",
    ]


def test_looks_like_a_raspberry_pi(tower):
    model = read(tower, "pi01", "tr -d '\\0' < /sys/firmware/devicetree/base/model")
    release = read(tower, "pi01", ". /etc/os-release; echo $ID $VERSION_ID")

    assert model == "Raspberry Pi 4 Model B Rev 1.4"
    assert release == "debian 12"
    assert read(tower, "pi01", "vcgencmd get_throttled") == "throttled=0x0"
    assert int(read(tower, "pi01", "cat /sys/class/thermal/thermal_zone0/temp")) > 20_000
    assert "[all]" in read(tower, "pi01", "cat /boot/firmware/config.txt")
    assert read(tower, "pi01", "cat /sys/class/rfkill/*/type").split() == ["wlan", "bluetooth"]


def test_real_entries_of_sys_show_beside_the_fakes(tower):
    assert "eth0" in read(tower, "pi01", "ls /sys/class/net").split()
    assert read(tower, "pi01", "cat /sys/devices/system/cpu/online")


def test_settings_change_on_the_board_alone_and_until_its_next_boot(make_tower):
    tower = make_tower(count=2, boot_delay_s=0.1)
    assert "overlay /proc/sys overlay" in read(tower, "pi01", "cat /proc/mounts")  # or do no harm
    before = [Path("/proc/sys", name).read_text() for name in REAL_SETTINGS]
    governor = "/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor"

    for name in REAL_SETTINGS:
        tower.run("pi01", f"echo 12345 | sudo tee /proc/sys/{name}")
    tower.run("pi01", f"echo performance | sudo tee {governor}; sudo rfkill block wifi")
    changed = read(
        tower, "pi01", f"cat /proc/sys/net/core/rmem_max {governor}; sudo rfkill list wifi"
    )

    assert changed.split()[:2] == ["12345", "performance"]
    assert "Soft blocked: yes" in changed
    assert [Path("/proc/sys", name).read_text() for name in REAL_SETTINGS] == before
    assert read(tower, "pi02", "cat /proc/sys/net/core/rmem_max") == "212992"
    tower.fault("pi01", "reboot")
    tower.wait_until_on("pi01", 2)
    assert read(tower, "pi01", f"cat /proc/sys/net/core/rmem_max {governor}").split() == [
        "212992",
        "ondemand",
    ]


def test_root_of_a_board_has_no_power_over_the_machine_below(tower):
    """Nothing is tried here that would do harm if it worked: what root may do says enough."""
    shown = read(tower, "pi01", "sudo sh -c 'grep CapBnd: /proc/self/status; ls -l /proc/sys*'")
    allowed = int(shown.split()[1], 16)
    forbidden = [name for name, bit in CAPABILITIES_DROPPED.items() if allowed >> bit & 1]

    assert forbidden == []
    assert {"SYS_ADMIN", "SYS_TIME", "SYS_MODULE", "MKNOD"} <= CAPABILITIES_DROPPED.keys()
    for line in shown.splitlines():
        assert "sysrq-trigger" not in line or line.startswith("c")  # /dev/null, not the trigger
    for command in ("mount -t tmpfs x /mnt", "mknod /tmp/null c 1 3"):
        assert tower.run("pi01", f"sudo {command}", check=False).returncode != 0
    for folder in ("irq", "bus", "fs"):
        assert f" /proc/{folder} proc ro" in read(tower, "pi01", "cat /proc/mounts")


def test_nothing_private_of_this_computer_shows(tower):
    hidden = [Path.home(), Path(__file__), Path.cwd(), Path("/etc/ssh/ssh_host_rsa_key")]
    listing = read(tower, "bare", "sudo ls /home /opt /root /mnt /srv /usr/local/bin /var/log")

    for path in hidden:
        if path != Path("/root"):
            assert tower.run("pi01", f"sudo test -e {path}", check=False).returncode == 1, path
    words = [word for word in listing.split() if not word.endswith(":")]
    assert words == ["pi", "cosmos-test-repo", "apt"]
    accounts = read(tower, "pi01", "sudo cut -d: -f2 /etc/shadow")
    assert set(accounts.split()) == {"*"}


def test_processes_of_boards_are_their_own(tower):
    assert read(tower, "pi01", "ps -o comm= -p 1") == "init"
    own = Path("/proc/self/cmdline").read_text().replace("\0", " ").strip()
    assert own not in read(tower, "pi01", "ps -ww -eo args=")
    assert read(tower, "pi01", "sudo readlink /proc/1/ns/pid") != os.readlink("/proc/self/ns/pid")


def test_boards_reach_operator_and_each_other_and_nothing_else(tower):
    def connect(address: str) -> str:
        code = f"import socket; socket.create_connection(('{address}', 22), 20)"
        return tower.run("pi01", f'python3 -c "{code}"', check=False).stderr

    assert connect(tower.boards["pi02"].address) == ""
    assert "refused" in connect(tower.address) or connect(tower.address) == ""
    assert "unreachable" in connect("192.0.2.1")
    assert read(tower, "pi01", "cat /proc/net/route").count("\n") == 1  # its own network alone
    uplink = tower.state()["uplink"]
    assert Path(f"/proc/sys/net/ipv4/conf/{uplink}/forwarding").read_text().strip() == "0"


def test_python_is_the_distributions_own_with_venv(tower):
    tower.run("pi01", "python3 -m venv /tmp/v && /tmp/v/bin/python -c 'import sys'")
    assert read(tower, "pi01", "command -v python3") == "/usr/bin/python3"


def test_old_python_says_so(tower):
    code = "import sys; print(sys.version_info[:2], sys.version_info < (3, 11), sys.version[:5])"
    assert read(tower, "old", f'python3 -c "{code}"') == "(3, 9) True 3.9.2"
    assert read(tower, "old", "ls /usr/bin/python3*").split() == [
        "/usr/bin/python3",
        "/usr/bin/python3.9",
    ]


def test_bare_board_has_no_python(tower):
    assert tower.run("bare", "python3 -V", check=False).returncode == 127


def test_apt_installs_upgrades_and_removes(tower):
    tower.run("pi01", "sudo apt-get update", timeout_s=120)
    tower.run("pi01", "sudo apt-get install -y cosmos-test-hello", timeout_s=120)
    assert read(tower, "pi01", "cosmos-test-hello") == "hello 1.0"

    tower.fault("pi01", "publish-update")
    tower.run("pi01", "sudo apt-get update && sudo apt-get upgrade -y", timeout_s=120)
    assert read(tower, "pi01", "cosmos-test-hello") == "hello 1.1"

    tower.run("pi01", "sudo apt-get remove -y cosmos-test-hello", timeout_s=120)
    assert tower.run("pi01", "cosmos-test-hello", check=False).returncode == 127
    missing = tower.run("pi01", "sudo apt-get install -y no-such-package", check=False)
    assert missing.returncode == 100


def test_services_are_enabled_started_and_started_again_by_a_boot(make_tower):
    tower = make_tower(count=1, boot_delay_s=0.1)
    tower.run("pi01", "sudo apt-get update; sudo apt-get install -y cosmos-test-service")
    state = "systemctl is-enabled cosmos-test; systemctl is-active cosmos-test.service"

    def ask() -> list[str]:
        return tower.run("pi01", state, check=False).stdout.split()

    assert ask() == ["disabled", "inactive"]
    refused = tower.run("pi01", "systemctl start cosmos-test", check=False)
    assert (refused.returncode, "Access denied" in refused.stderr) == (4, True)
    tower.run("pi01", "sudo systemctl enable --now cosmos-test")
    assert ask() == ["enabled", "active"]
    tower.run("pi01", "sudo reboot", check=False)
    tower.wait_until_on("pi01", 2)
    assert ask() == ["enabled", "active"]
    tower.run("pi01", "sudo systemctl disable --now cosmos-test && sudo systemctl daemon-reload")
    assert ask() == ["disabled", "inactive"]
    unknown = tower.run("pi01", "sudo systemctl start nonsense", check=False)
    assert (unknown.returncode, "not found" in unknown.stderr) == (5, True)


def test_reboot_keeps_the_disk_and_begins_anew_in_all_else(tower):
    before = tower.state()["boards"]["pi02"]
    tower.run("pi02", "echo kept > note; touch /tmp/gone; sudo touch /run/gone; sync -f .")

    started_s = time.monotonic()
    tower.run("pi02", "sudo reboot", check=False)
    after = tower.wait_until_on("pi02", before["boots"] + 1)

    shown = read(
        tower, "pi02", "cat note /proc/sys/kernel/random/boot_id; cut -d. -f1 /proc/uptime"
    )
    assert shown.split()[:2] == ["kept", after["boot_id"]]
    assert after["boot_id"] != before["boot_id"]
    assert int(shown.split()[2]) <= time.monotonic() - started_s
    assert read(tower, "pi02", "ls /tmp; ls /run").split().count("gone") == 0


def test_powered_off_board_stays_off_until_it_is_switched_on(make_tower):
    tower = make_tower(count=1, boot_delay_s=0.0)
    tower.run("pi01", "sudo poweroff", check=False)
    tower.wait_until(lambda board: board["power"] == "off", "pi01", "off")
    with pytest.raises(TowerError, match="expected it to be on"):
        tower.fault("pi01", "sudo")

    tower.fault("pi01", "poweron")

    assert tower.wait_until_on("pi01")["boots"] == 2


def test_clocks_of_a_board_count_from_its_boot(tower):
    code = "import time; print(time.monotonic())"
    assert float(read(tower, "pi01", f'python3 -c "{code}"')) < time.monotonic()


def test_host_keys_are_known_and_differ(tower):
    keys = {line.split()[-1] for line in tower.known_hosts.read_text().splitlines()}
    assert len(keys) == len(tower.boards)


def test_operator_needs_nothing_of_its_own(tower, tmp_path):
    """With no home at all, ssh reaches a board by the tower's own configuration."""
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path)}
    config = tower.operator_environment()["COSMOS_SSH_CONFIG"]
    command = ["ssh", "-F", config, "pi01", "true"]
    assert subprocess.run(command, env=environment, timeout=120, check=False).returncode == 0
    assert list(tmp_path.iterdir()) == []
