"""What may be asked for, and how the tower is told to others. Nothing is started here."""

from __future__ import annotations

import shutil
import stat
import subprocess
from pathlib import Path

import pytest
import yaml

from cosmos_cli.models.inventory import load_machines

from . import roots
from .inventory import format_inventory
from .keys import generate_key
from .network import Network, NetworkError, check_network
from .packages import HELLO_NEWER, Package
from .specification import BoardSpec, TowerSpec, name_boards


@pytest.mark.parametrize(
    ("board", "told"),
    [
        ({"name": "pi_1"}, "letters, digits and dashes"),
        ({"name": "../etc"}, "letters, digits and dashes"),
        ({"name": "p" * 33}, "letters, digits and dashes"),
        ({"name": "pi01", "arch": "sparc"}, "got 'sparc'"),
        ({"name": "pi01", "python": "2"}, "got '2'"),
    ],
)
def test_impossible_boards_are_refused(board, told):
    with pytest.raises(ValueError, match=told):
        BoardSpec(**board)


@pytest.mark.parametrize(
    ("tower", "told"),
    [
        ({"boards": ()}, "got 0"),
        ({"boards": name_boards(251)}, "got 251"),
        ({"boards": (*name_boards(2), BoardSpec(name="pi02"))}, "named twice: pi02"),
        ({"boards": name_boards(1), "disk_mib": 10}, "at least 64 MiB"),
    ],
)
def test_impossible_towers_are_refused(tower, told):
    with pytest.raises(ValueError, match=told):
        TowerSpec(**tower)


def test_specification_survives_the_way_to_the_supervisor():
    spec = TowerSpec(boards=(*name_boards(2), *name_boards(1, "arm64")), network="10.99")
    assert TowerSpec.from_mapping(spec.to_mapping()) == spec
    assert [board.name for board in spec.boards] == ["pi01", "pi02", "arm64-01"]


def test_addresses_of_all_boards_differ():
    network = Network("10.77")
    boards = range(1, 251)
    assert len({network.address(number) for number in boards} | {network.operator}) == 251
    assert len({network.hardware_address(number) for number in boards}) == 250


@pytest.mark.parametrize("prefix", ["10", "10.77.0", "10.777", "ten.one", "8.8"])
def test_impossible_networks_are_refused(prefix):
    with pytest.raises(NetworkError):
        check_network(prefix)


def test_inventory_means_the_boards_to_cosmos(tmp_path):
    text = format_inventory(
        {"pi01": "10.77.1.1", "pi02": "10.77.1.2"},
        Path("/run/key"),
        {"pi02": {"cosmos_root": "/srv/c"}, "here": {"ansible_connection": "local"}},
        {"cosmos_root": "/home/pi/c"},
    )
    path = tmp_path / "tower.yaml"
    path.write_text(text)

    machines = {machine.name: machine for machine in load_machines(path)}

    assert set(machines) == {"pi01", "pi02", "here"}
    assert machines["pi02"].address == "10.77.1.2"
    assert machines["pi02"].raw_variables["cosmos_root"] == "/srv/c"
    assert machines["pi01"].raw_variables["ansible_user"] == "pi"
    assert machines["here"].raw_variables.get("ansible_user") is None


def test_inventory_without_more_is_plain():
    text = format_inventory({"pi01": "10.77.1.1"}, Path("/run/key"), {}, {})
    assert yaml.safe_load(text)["all"].keys() == {"children"}


@pytest.mark.process
def test_keys_are_what_openssh_reads(tmp_path):
    if shutil.which("ssh-keygen") is None:
        pytest.skip("needs OpenSSH's ssh-keygen")
    pair = generate_key("note")
    path = tmp_path / "key"
    path.write_text(pair.private)
    path.chmod(stat.S_IRUSR)
    command = ["ssh-keygen", "-y", "-f", str(path)]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert shown.split()[:2] == pair.public.split()[:2]


def test_package_is_named_as_apt_expects():
    assert HELLO_NEWER.file_name == "cosmos-test-hello_1.1_all.deb"
    assert "Version: 2\n" in Package(name="x", version="2").control


def test_building_a_root_asks_for_this_computers_own_main_source(monkeypatch):
    answer = "deb http://a b/main\ndeb http://a bookworm main\ndeb http://a bookworm main\n"
    monkeypatch.setattr(
        roots.subprocess,
        "run",
        lambda *_, **__: roots.subprocess.CompletedProcess([], 0, stdout=answer),
    )
    assert roots.debian_sources() == ["deb http://a bookworm main"]
