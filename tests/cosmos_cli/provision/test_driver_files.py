"""Drivers beside an inventory: which files machines are sent, and where their names are found there."""

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.launch.request import MachineConfig, devices_at
from cosmos_cli.models.device_needs import MachineNeeds
from cosmos_cli.models.inventory import Machine
from cosmos_cli.provision.driver_files import driver_files
from madns_runtime.config import Agents, DeviceLaunch, RunConfig


@pytest.fixture
def folder(tmp_path):
    for name in (
        "fleet/imu.py",
        "fleet/helper.py",
        "fleet/pack/__init__.py",
        "fleet/pack/inner.py",
        "fleet/notes/diary.py",
        "fleet/secret.yaml",
        "fleet/.hidden.py",
        "drivers/bus.py",
        "drivers/table.csv",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"# {name}\n")
    return tmp_path


def files_of(folder, *kinds, sent=()):
    machine = Machine(name="pi01", address="pi01", devices_folder=folder / "fleet")
    return driver_files(machine, MachineNeeds(driver_files=kinds), sent)


def paths(found):
    return [file.path for file in found.tree.files]


def test_python_files_beside_a_driver_and_packages_are_sent_and_nothing_else(folder):
    found = files_of(folder, "./imu.py:Imu")

    assert paths(found) == ["helper.py", "imu.py", "pack/__init__.py", "pack/inner.py"]
    assert found.directory("/there/trees/abc") == "/there/trees/abc"


def test_links_beside_a_driver_that_lead_nowhere_or_to_themselves_are_not_sent(folder):
    before = paths(files_of(folder, "./imu.py:Imu"))
    for name in ("loop.py", "fleet.py"):
        (folder / "fleet" / name).symlink_to("loop.py" if name == "loop.py" else "nowhere.py")

    assert paths(files_of(folder, "./imu.py:Imu")) == before


def test_a_driver_elsewhere_is_found_by_the_same_name(folder):
    found = files_of(folder, "../drivers/bus.py:Bus", "./imu.py:Imu")

    assert paths(found)[0] == "drivers/bus.py"
    assert found.directory("/there/trees/abc") == "/there/trees/abc/fleet"


def test_what_lies_in_the_scenario_s_folder_is_sent_already(folder):
    assert files_of(folder, "./imu.py:Imu", sent=[folder]) is None
    assert files_of(folder) is None


def test_an_absolute_path_is_refused(folder):
    with pytest.raises(InputError, match=r"pi01: /opt/imu.py: expected a path from the inventory"):
        files_of(folder, "/opt/imu.py:Imu")


def launch(folder, kind):
    return DeviceLaunch(name="imu", place="pi01", kind=kind, base_directory=folder, rate_hz=1.0)


def test_a_machine_is_told_where_its_drivers_are():
    config = RunConfig(
        run="r",
        scenario="s",
        simulation="counter",
        base_directory="/here/scenario",
        agents=Agents(count=1),
    )
    place = MachineConfig(
        directory="/runs", base_directory="/there/scenario", driver_directory="/there/drivers"
    )
    devices = [
        launch("/here/fleet", "./imu.py:Imu"),
        launch("/here/scenario/sub", "./imu.py:Imu"),
        launch("/here/fleet", "synthetic"),
    ]

    found = [each.base_directory for each in devices_at(devices, config, place)]

    assert found == ["/there/drivers", "/there/scenario/sub", "/there/scenario"]
