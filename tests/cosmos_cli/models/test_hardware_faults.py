"""What is told of devices in scenarios, inventories and plans before anything is run."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.launch.device_plan import plan_devices
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.launch.request import MachineConfig, devices_at
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.loading import ScenarioFile, load_scenario

pytestmark = pytest.mark.process

HEAD = """\
name: devices
simulation: counter
agents: {count: 2}
time: {duration_s: 2}
timeouts: {loading_s: 1}
"""
DRIVER = """
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Le

from madns_runtime.hardware.contract import Channel, Device, DeviceKind

Path(__file__).with_name("pid").write_text(str(os.getpid()))


@dataclass(frozen=True, kw_only=True)
class Parameters:
    gain: Annotated[float, Le(2.0)] = 1.0


class Valve(Device):
    kind = DeviceKind(
        name="valve",
        summary="a valve",
        parameters=Parameters,
        channels=(Channel(name="angle"), Channel(name="valve", direction="out", safe=0.0)),
        rate_hz_max=50.0,
    )


meter = DeviceKind(
    name="meter", summary="a clock", channels=(Channel(name="t"),), device=":Valve", needs_hardware=False
)
"""
VALVE = "{name: valve, kind: ./driver.py:Valve, outputs: true}"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "driver.py").write_text(DRIVER, encoding="utf-8")
    (tmp_path / "hang.py").write_text("while True:\n    pass\n", encoding="utf-8")
    return tmp_path


def load(folder: Path, hardware: str, *overrides: str) -> ScenarioFile:
    path = folder / "scenario.yaml"
    path.write_text(f"{HEAD}hardware:\n{hardware}", encoding="utf-8")
    return load_scenario(path, overrides)


def faults_of(folder: Path, hardware: str, *overrides: str) -> list[tuple[int | None, str]]:
    with pytest.raises(InputError) as caught:
        load(folder, hardware, *overrides)
    return [(fault.line, f"{fault.path}: {fault.text}") for fault in caught.value.faults]


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("{name: a, kind: syntetic}", "kind: no kind of device named 'syntetic', did you mean"),
        ("{name: a, kind: synthetic, parameters: {seed: -4}}", "seed: expected >= 0, got -4"),
        ("{name: a, kind: synthetic, parameters: {sead: 4}}", "unknown key, did you mean seed?"),
        ("{name: a, kind: synthetic, frozen_s: {valu: 1}}", "did you mean value?"),
        ("{name: a, kind: synthetic, frozen_s: {value: 0}}", "value: expected > 0, got 0"),
        ("{name: a, kind: synthetic, hang_s: 0.001}", "hang_s: expected >= 0.1, got 0.001"),
        ("{name: a, kind: synthetic, rate_hz: 5000}", "rate_hz: expected <= 1000"),
        ("{name: a, kind: synthetic, agents: [chief]}", "agents[0]: no agent is named chief"),
        ("{name: a, kind: ./driver.py:Valve, parameters: {gain: 3}}", "gain: expected <= 2, got 3"),
        ("{name: .., kind: synthetic}", "name: expected a name such as sense_hat"),
        ("{name: ../../a, kind: synthetic}", "is a letter or a digit; got '../../a'"),
        ("{name: '', kind: synthetic}", "devices[0].name: expected"),
        ("{name: a, kind: ./driver.py:Valve}", "is bound to a machine: list it in cosmos_devices"),
        ("{name: a, kind: ./hang.py:Valve}", "was not done within 1 s"),
    ],
)
def test_a_scenarios_devices_are_refused_at_their_line(folder: Path, line: str, told: str) -> None:
    (found,) = faults_of(folder, f"  devices:\n    - {line}\n")
    assert found[0] == HEAD.count("\n") + 3
    assert told in found[1]


def test_a_fault_of_a_parameter_stands_at_the_parameter(folder: Path) -> None:
    with pytest.raises(InputError) as caught:
        load(folder, "  devices:\n    - {name: a, kind: synthetic, parameters: {seed: -4}}\n")
    (fault,) = caught.value.faults
    assert fault.source[(fault.column or 0) - 1 :].startswith("-4")


def test_lockstep_refuses_who_follows_the_wall_clock_and_names_both(folder: Path) -> None:
    devices = "  devices: [{name: a, kind: './driver.py:meter'}]\n"
    load(folder, devices)
    (found,) = faults_of(folder, devices, "time.mode=lockstep")
    assert "./driver.py:meter" in found[1] and "lockstep" in found[1]
    load(folder, "  devices: [{name: a, kind: synthetic}]\n", "time.mode=lockstep")


def test_two_devices_of_one_agent_share_no_name(folder: Path) -> None:
    line = "    - {name: a, kind: synthetic}\n"
    (found,) = faults_of(folder, f"  devices:\n{line}{line}")
    assert "agent-01 has a device 'a' already (hardware.devices[0])" in found[1]


def test_agents_and_owner_of_a_use_exist(folder: Path) -> None:
    told = faults_of(folder, "  use: [{devices: [imu], agents: [chief], owner: boss}]\n")
    assert [text.split(":")[0] for _, text in told] == [
        "hardware.use[0].agents[0]",
        "hardware.use[0].owner",
    ]


def test_agents_are_not_looked_for_while_the_simulation_that_gives_second_names_is_missing(
    folder: Path,
) -> None:
    devices = "  devices: [{name: a, kind: synthetic, agents: [chief]}]\n"
    action = (
        "timeline: [{at_s: 1, action: device_fault, device: a, fault: freeze, agents: [chief]}]\n"
    )

    (found,) = faults_of(folder, f"{devices}{action}", "simulation=contre")

    assert found[1].startswith("simulation: no simulation named 'contre', did you mean counter?")


def test_an_owner_that_does_not_use_the_device_is_not_guessed_again(folder: Path) -> None:
    use = "  use: [{devices: [imu], agents: [agent-02], owner: agent-01}]\n"
    (found,) = faults_of(folder, use)
    assert "got 'agent-01', did you mean agent-02?" in found[1]


def test_a_file_of_ones_own_is_not_imported_here(folder: Path) -> None:
    faults_of(folder, "  devices: [{name: a, kind: ./driver.py:Valve}]\n")
    assert int((folder / "pid").read_text()) != os.getpid()


def inventory(folder: Path, *devices: str, connection: str = "local") -> Path:
    folder.mkdir(exist_ok=True)
    lines = "".join(f"        - {device}\n" for device in devices)
    head = f"all:\n  hosts:\n    pi22:\n      ansible_connection: {connection}\n"
    path = folder / "inventory.yaml"
    path.write_text(f"{head}      cosmos_devices:\n{lines}", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "devices",
    [
        ("sense_hat", "{name: sense_hat, kind: synthetic}"),
        ("{name: sense_hat, kind: synthetic}", "sense_hat"),
        ("{name: sense_hat, kind: synthetic}", "{name: sense_hat, kind: synthetic}"),
    ],
)
def test_a_device_is_listed_once_whatever_comes_first(
    folder: Path, devices: tuple[str, str]
) -> None:
    with pytest.raises(InputError) as caught:
        load_machines(inventory(folder, *devices))

    assert [(fault.line, fault.text) for fault in caught.value.faults] == [
        (7, "sense_hat is listed already")
    ]


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("{name: imu, kind: sense_hatt}", "did you mean sense_hat?"),
        ("{name: imu, kind: sense_hat, parameters: {rotation: 45}}", "expected 0, 90, 180 or 270"),
        ("{name: imu, kind: ./driver.py:Valve, parameters: {gain: 3}}", "gain: expected <= 2"),
        ("{name: imu, kind: ./other.py:Valve}", "other.py"),
    ],
)
def test_an_inventorys_devices_are_refused_at_their_line(
    folder: Path, line: str, told: str
) -> None:
    with pytest.raises(InputError) as caught:
        load_machines(inventory(folder, "a_label", line))
    (fault,) = caught.value.faults
    assert (fault.file, fault.line) == (str(folder / "inventory.yaml"), 7)
    assert told in fault.text or told in fault.render()


def plan(folder: Path, inventory: Path, hardware: str, *overrides: str):
    scenario = load(folder, hardware, *overrides)
    machines = load_machines(inventory)
    return plan_devices(scenario, make_plan(scenario.scenario, machines, fault_at=scenario.fault))


def plan_faults(folder: Path, inventory: Path, hardware: str, *overrides: str) -> list[str]:
    with pytest.raises(InputError) as caught:
        plan(folder, inventory, hardware, *overrides)
    assert all(fault.line for fault in caught.value.faults)
    return [fault.text for fault in caught.value.faults]


USE = "  use: [{devices: [valve]}]\n"


def test_files_of_kinds_are_found_beside_the_inventory_that_names_them(
    folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "scenarios"
    other.mkdir()
    (found,) = plan(other, inventory(folder, VALVE), USE)["pi22"]
    assert found.base_directory == str(folder)
    assert found.users == ("agent-01", "agent-02")


def test_outputs_that_several_agents_use_want_an_owner(folder: Path) -> None:
    machines = inventory(folder, VALVE)
    (told,) = plan_faults(folder, machines, f"{USE}  armed: true\n")
    assert "2 agents there use it: name one as its owner" in told
    owned = "  use: [{devices: [valve], owner: agent-02}]\n  armed: true\n"
    (found,) = plan(folder, machines, owned)["pi22"]
    assert (found.owner, found.may_move) == ("agent-02", True)


def test_what_only_the_inventory_can_tell_is_told_by_the_plan(folder: Path) -> None:
    (told,) = plan_faults(folder, inventory(folder, VALVE), "  use: [{devices: [imu]}]\n")
    assert "no machine with agents has a device 'imu' (there are valve)" in told
    twins = [f"{{name: {name}, kind: ./driver.py:Valve, serial: x1}}" for name in ("valve", "b")]
    (told,) = plan_faults(folder, inventory(folder, *twins), USE)
    assert "two devices of pi22 have the serial 'x1'" in told
    fast = inventory(folder, "{name: valve, kind: ./driver.py:Valve, rate_hz: 80}")
    (told,) = plan_faults(folder, fast, USE)
    assert "pi22/valve: expected a rate_hz <= 50" in told


def test_an_agents_own_device_has_another_name_than_one_that_it_uses(folder: Path) -> None:
    own = "  devices: [{name: valve, kind: synthetic, agents: [agent-01]}]\n"
    machines = inventory(folder, VALVE)
    (told,) = plan_faults(folder, machines, f"{USE}{own}")
    assert "agent-01 uses valve of pi22 already (hardware.use): name one otherwise" in told
    other = "  use: [{devices: [valve], agents: [agent-02]}]\n"
    assert len(plan(folder, machines, f"{other}{own}")["pi22"]) == 2

    machines.write_text(machines.read_text().replace("pi22", "agent-01"))
    (told,) = plan_faults(folder, machines, f"{other}{own}")
    assert "valve of agent-01 and of the machine agent-01 have one name" in told


def test_a_driver_that_would_not_be_sent_is_refused(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "scenarios"
    other.mkdir()
    machines = inventory(folder, VALVE, connection="ssh")
    assert plan(other, machines, USE)["pi22"]  # beside the inventory: it is sent
    absolute = f"{{name: valve, kind: '{folder}/driver.py:Valve'}}"
    (told,) = plan_faults(other, inventory(folder, absolute, connection="ssh"), USE)
    assert "expected a path from the inventory's folder" in told


def test_a_machine_finds_files_in_its_own_copy_of_the_scenarios_folder(folder: Path) -> None:
    (folder / "boards").mkdir()
    (folder / "driver.py").rename(folder / "boards" / "driver.py")
    scenario = load(folder, USE)
    devices = plan(folder, inventory(folder / "boards", VALVE, connection="ssh"), USE)["pi22"]
    place = MachineConfig(directory="/run", base_directory="/srv/tree")
    config = scenario.run_config("0001-devices")
    assert [d.base_directory for d in devices_at(devices, config, place)] == ["/srv/tree/boards"]


def test_firmware_that_is_not_there_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    device = "{name: mcu, kind: emulated_mcu, parameters: {firmware: board/own.elf}}"
    path.write_text(f"{HEAD}hardware:\n  devices:\n    - {device}\n")

    with pytest.raises(InputError) as caught:
        load_scenario(path)

    (fault,) = caught.value.faults
    assert fault.line == 8
    assert fault.path == "hardware.devices[0].parameters.firmware"
    assert fault.text == f"no file {tmp_path / 'board/own.elf'}; build it first"
    (tmp_path / "board").mkdir()
    (tmp_path / "board" / "own.elf").write_bytes(b"\x7fELF")
    load_scenario(path)


def test_firmware_of_an_absolute_path_may_be_another_machines(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    device = "{name: mcu, kind: emulated_mcu, parameters: {firmware: /nowhere/own.elf}}"
    path.write_text(f"{HEAD}hardware:\n  devices:\n    - {device}\n")

    load_scenario(path)
