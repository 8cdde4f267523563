"""`cosmos up` on virtual boards: what it makes, that the second one makes nothing, and everything that can go wrong."""

import pytest
from harness.wheel_cache import begin_cache
from tower import BoardSpec
from up_tower import UpTower

pytestmark = pytest.mark.root

SETTINGS = {
    "cosmos_receive_buffer_bytes": 8388608,
    "cosmos_realtime_priority": 50,
    "cosmos_cpu_governor": "performance",
    "cosmos_wifi": False,
    "cosmos_bluetooth": False,
}
UNIT = "[Unit]\nDescription=beacon\n[Service]\nExecStart=/bin/sleep 1000000\n[Install]\nWantedBy=multi-user.target\n"
STEPS = [
    {"packages": ["cosmos-test-service"]},
    {"service": {"name": "cosmos-test", "enabled": True, "state": "started"}},
    {
        "name": "I2C",
        "line": {
            "path": "/boot/firmware/config.txt",
            "line": "dtparam=i2c_arm=on",
            "regexp": "^#?dtparam=i2c_arm=",
        },
    },
    {"line": {"path": "/etc/new.conf", "line": "a=1", "create": True}},
    {"file": {"content": UNIT, "dest": "/etc/systemd/system/beacon.service"}},
    {"service": {"name": "beacon", "enabled": True, "state": "started"}},
    {"file": {"content": "for root alone\n", "dest": "/etc/alone", "mode": "0600"}},
    {"become": False, "file": {"content": "mine\n", "dest": "~/mine.txt", "mode": "0640"}},
    {"command": {"run": "echo done > /var/once", "creates": "/var/once"}},
    {
        "become": False,
        "command": {"run": "echo more >> ~/log", "unless": "grep -q more ~/log"},
    },
]
BEGUN, GO, GONE_ON = "/dev/shm/begun", "/dev/shm/go", "/dev/shm/gone-on"
PAUSE = {
    "become": False,
    "command": {
        "run": f"touch {BEGUN}; while ! test -e {GO}; do sleep 0.05; done; touch {GONE_ON}",
        "creates": GONE_ON,
    },
}
"""Holds `up` in its midst: before the environment is built and code is sent."""


OLD_PYTHON = """#!/usr/bin/python3 -S
import sys
sys.version_info = (3, 9, 2, "final", 0)
code = sys.argv.index("-c") + 1
program, sys.argv = sys.argv[code], ["-c", *sys.argv[code + 1:]]
exec(program, {"__name__": "__main__"})
"""
"""Says of itself that it is old; a really old one is not to be had here."""


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Return the folder of wheels that the tests of a session share."""
    return begin_cache(tmp_path_factory.mktemp("cache"))


@pytest.fixture
def fleet(tower8, tmp_path, cache):
    return UpTower(tower8, tmp_path, cache)


@pytest.fixture
def own_fleet(make_tower, tmp_path, cache):
    """Return a function that makes a tower of one's own."""
    return lambda *arguments, **options: UpTower(make_tower(*arguments, **options), tmp_path, cache)


def test_second_up_changes_nothing_file_by_file(fleet):
    fleet.write(cosmos_packages=["cosmos-test-hello"], cosmos_provision=STEPS, **SETTINGS)

    first = fleet.up()
    before = {name: fleet.files(name) for name in fleet.tower.boards}
    second = fleet.up()

    assert (first.code, first.failures) == (0, {})
    assert set(first.statuses.values()) == {"changed"}
    assert (second.code, second.document["changed"]) == (0, 0)
    assert set(second.statuses.values()) == {"ok"}
    assert {name: fleet.files(name) for name in fleet.tower.boards} == before
    board = fleet.tower
    assert "performance" in fleet.values("pi03")
    assert board.run("pi04", "cosmos-test-hello").returncode == 0
    assert board.run("pi05", "systemctl is-active beacon cosmos-test").stdout.split() == [
        "active",
        "active",
    ]
    assert board.run("pi06", "tail -1 /boot/firmware/config.txt").stdout == "dtparam=i2c_arm=on\n"
    assert board.run("pi07", "cat ~/mine.txt ~/log").stdout == "mine\nmore\n"


def test_check_shows_the_plan_and_changes_nothing(fleet):
    fleet.write(boards=["pi01"], cosmos_provision=STEPS, **SETTINGS)
    before, values = fleet.files("pi01"), fleet.values("pi01")

    text = fleet.text("--check", "--diff")
    planned = fleet.up("--check")

    assert fleet.files("pi01") == before
    assert fleet.values("pi01") == values
    assert "+dtparam=i2c_arm=on" in text.replace("    ", "")
    assert text.splitlines()[-1].startswith("1 machine: 1 would change, 0 ok, 0 failed in ")
    done = fleet.up()
    assert done.changes("pi01") == planned.changes("pi01")


@pytest.mark.nightly
def test_settings_are_made_and_put_back(fleet):
    fleet.write(boards=["pi01"])
    fleet.up()
    before, values = fleet.files("pi01"), fleet.values("pi01")

    fleet.write(boards=["pi01"], **SETTINGS)
    made = fleet.up()
    made_values = fleet.values("pi01")
    fleet.write(boards=["pi01"])
    put_back = fleet.up()

    assert (made.code, len(made.changes("pi01"))) == (0, 5)
    assert "8388608" in made_values
    assert (put_back.code, len(put_back.changes("pi01"))) == (0, 5)
    assert fleet.values("pi01") == values
    names = [line.split()[0] for line in fleet.files("pi01")]
    assert set(names) - {line.split()[0] for line in before} == {
        "/home/pi/cosmos/state/settings.json"
    }
    assert fleet.up().document["changed"] == 0


@pytest.mark.nightly
def test_settings_are_made_again_after_a_restart(fleet):
    fleet.write(boards=["pi01"], **SETTINGS)
    fleet.up()
    boots = fleet.tower.state()["boards"]["pi01"]["boots"]
    fleet.tower.fault("pi01", "reboot")
    fleet.tower.wait_until_on("pi01", boots=boots + 1)

    again = fleet.up()

    assert again.code == 0
    assert "setting cosmos_receive_buffer_bytes: 212992 -> 8388608" in again.changes("pi01")
    assert fleet.up().document["changed"] == 0


def test_each_machine_that_cannot_be_made_ready_says_why_and_the_others_are(fleet):
    tower = fleet.tower
    tower.fault("pi02", "down")
    tower.fault("pi03", "new-host-key")
    tower.fault("pi04", "wrong-key")
    tower.fault("pi05", "no-sudo")
    tower.fault("pi06", "fill", 4096)
    tower.fault("pi07", "ro")
    fleet.write(machines={"pi08": {"ansible_user": "nobody-here"}}, cosmos_wifi=False)
    kinds = {
        "pi02": "unreachable",
        "pi03": "host_key_changed",
        "pi04": "authentication",
        "pi05": "no_sudo",
        "pi06": "disk_full",
        "pi07": "read_only",
        "pi08": "authentication",
    }

    result = fleet.up()

    assert result.code == 3
    assert {name: kind for name, (kind, _) in result.failures.items()} == kinds
    assert result.statuses["pi01"] == "changed"
    assert all(machine["failure"]["advice"] for n, machine in result.machines.items() if n in kinds)
    assert "MB are needed on" in result.failures["pi06"][1]
    assert "cosmos_wifi: on -> off" in result.failures["pi05"][1]

    for name, cure in (
        ("pi02", "up"),
        ("pi03", "own-host-key"),
        ("pi04", "right-key"),
        ("pi05", "sudo"),
        ("pi06", "unfill"),
        ("pi07", "rw"),
    ):
        tower.fault(name, cure)
    fleet.write(cosmos_wifi=False)
    repaired = fleet.up()
    assert (repaired.code, repaired.failures) == (0, {})
    assert fleet.up().document["changed"] == 0


@pytest.mark.nightly
def test_slow_sudo_is_waited_for_and_forbidden_sudo_is_not_asked(fleet):
    fleet.tower.fault("pi01", "slow-sudo", 2)
    fleet.write(
        boards=["pi01", "pi02", "pi03"],
        machines={
            "pi02": {"ansible_become": False},
            "pi03": {"ansible_become": False, "cosmos_wifi": None},
        },
        cosmos_wifi=False,
    )

    result = fleet.up()

    assert result.failures.get("pi01") is None
    assert result.statuses == {"pi01": "changed", "pi02": "failed", "pi03": "changed"}
    assert result.failures["pi02"][0] == "no_sudo"
    assert fleet.tower.run("pi02", "ls -A ~/cosmos", check=False).returncode != 0


def test_closed_firewall_is_told_by_each_machine_that_needs_it_open(fleet):
    fleet.write(boards=["pi01", "pi02"], machines={"pi02": {"cosmos_host_address": "203.0.113.1"}})

    result = fleet.up()

    assert result.code == 3
    assert result.statuses["pi01"] == "changed"
    assert "no UDP from here to 203.0.113.1:" in result.failures["pi02"][1]
    assert "cosmos_host_address" in result.machines["pi02"]["failure"]["advice"]
    assert result.changes("pi02")


def test_old_python_and_no_python_are_told_with_their_cure(own_fleet):
    fleet = own_fleet(count=1, boards=[BoardSpec(name="none", python="none")])
    fleet.tower.run("pi01", f"cat > ~/python3.9 <<'EOF'\n{OLD_PYTHON}EOF\nchmod +x ~/python3.9")
    fleet.write(machines={"pi01": {"ansible_python_interpreter": "/home/pi/python3.9"}})

    result = fleet.up()

    assert result.code == 3
    assert {name: kind for name, (kind, _) in result.failures.items()} == {
        "pi01": "python",
        "none": "python",
    }
    assert "is Python 3.9.2, expected 3.11 or later" in result.failures["pi01"][1]
    assert result.failures["none"][1] == "no Python 3 found"
    assert all(
        "ansible_python_interpreter" in m["failure"]["advice"] for m in result.machines.values()
    )


@pytest.mark.nightly
def test_whatever_happens_in_the_midst_the_next_up_repairs(fleet):
    tower = fleet.tower
    names = list(tower.boards)
    fleet.write(cosmos_provision=[PAUSE], **SETTINGS)
    boots = {name: board["boots"] for name, board in tower.state()["boards"].items()}

    process = fleet.start("--json")
    for name in names:
        fleet.wait_for_file(name, BEGUN)
    tower.fault("pi02", "down")
    tower.fault("pi03", "freeze")
    tower.fault("pi04", "crash")
    tower.fault("pi05", "fill", 4096)
    tower.fault("pi06", "ro")
    tower.fault("pi07", "cut")
    for name in ("pi01", "pi05", "pi06", "pi07", "pi08"):
        tower.run(name, f"touch {GO}")
    result = fleet.finish(process)

    assert result.code == 3
    assert {name: kind for name, (kind, _) in result.failures.items()} == {
        "pi02": "lost",
        "pi03": "lost",
        "pi04": "lost",
        "pi05": "disk_full",
        "pi06": "read_only",
        "pi07": "lost",
    }
    assert result.statuses["pi01"] == result.statuses["pi08"] == "changed"

    tower.fault("pi02", "up")
    tower.fault("pi03", "thaw")
    tower.wait_until_on("pi04", boots=boots["pi04"] + 1)
    tower.fault("pi05", "unfill")
    tower.fault("pi06", "crash")  # a card that failed works again after a new start
    tower.wait_until_on("pi06", boots=boots["pi06"] + 1)
    for name in ("pi02", "pi03", "pi04", "pi06"):
        fleet.wait(lambda name=name: tower.run(name, f"touch {GO}", check=False).returncode == 0)
    repaired = fleet.up()
    assert (repaired.code, repaired.failures) == (0, {})
    assert fleet.up().document["changed"] == 0
    files = {
        name: {line.split()[0] for line in fleet.files(name) if "/home/pi/cosmos" in line}
        for name in names
    }
    assert all(found == files["pi01"] for found in files.values())


@pytest.mark.nightly
def test_power_and_connections_cut_while_code_and_packages_come_leave_nothing_half(fleet):
    """The moments differ from run to run; what must come of it does not."""
    tower = fleet.tower
    names = list(tower.boards)
    fleet.write(cosmos_provision=[PAUSE], cosmos_packages=["cosmos-test-hello"])
    boots = {name: board["boots"] for name, board in tower.state()["boards"].items()}
    process = fleet.start("--json")
    for name in names:
        fleet.wait_for_file(name, BEGUN)

    for name in names:
        tower.run(name, f"touch {GO}")
    for index, name in enumerate(names):
        tower.fault(name, "cut" if index % 2 else "crash")
    fleet.finish(process)

    for name in names[::2]:
        tower.wait_until_on(name, boots=boots[name] + 1)
    for name in names:
        tower.run(name, f"touch {GO}")
    repaired = fleet.up()
    assert (repaired.code, repaired.failures) == (0, {})
    assert fleet.up().document["changed"] == 0
    for name in names:
        assert tower.run(name, "cosmos-test-hello").returncode == 0
        assert "cosmos-new" not in "".join(fleet.files(name))


def test_edited_scenarios_are_sent_and_old_ones_pruned_once(fleet, tmp_path):
    fleet.write(boards=["pi01"])
    folder = tmp_path / "scenario"
    folder.mkdir()
    scenario = folder / "a.yaml"

    def up(seed):
        scenario.write_text(f"name: a\nsimulation: counter\nagents: {{count: 1}}\nseed: {seed}\n")
        return fleet.up(str(scenario)).changes("pi01")

    first = up(0)
    changes = [up(seed) for seed in range(1, 5)]
    again = up(4)

    assert "tree scenario a" in first[-1]
    assert all(any("tree scenario a" in title for title in each) for each in changes)
    assert [any("prune" in title for title in each) for each in changes] == [
        False,
        False,
        True,
        True,
    ]
    assert again == []


@pytest.mark.nightly
def test_interrupted_command_leaves_what_the_next_one_finishes(fleet):
    fleet.write(boards=["pi01"], cosmos_provision=[PAUSE])
    process = fleet.start("--json")
    fleet.wait_for_file("pi01", BEGUN)
    process.kill()
    process.communicate()
    fleet.tower.run("pi01", f"touch {GO}")

    result = fleet.up()

    assert (result.code, result.failures) == (0, {})
    assert fleet.up().document["changed"] == 0


def test_this_computer_is_left_alone(fleet):
    fleet.write(boards=["pi01"], machines={"here": {"ansible_connection": "local"}}, **SETTINGS)

    result = fleet.up()

    assert result.code == 0
    assert result.machines["here"]["local"] is True
    assert result.machines["here"]["steps"] == []
