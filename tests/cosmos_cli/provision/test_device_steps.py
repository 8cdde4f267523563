"""What devices need of a machine, planned: packages, groups, boot configuration, Python packages."""

import dataclasses
import shlex

import pytest
from provision_machines import facts_of, wanted

from cosmos_cli.commands.command_group import load_command
from cosmos_cli.models.device_needs import DeviceNeeds, MachineNeeds
from cosmos_cli.models.inventory import Variables
from cosmos_cli.models.machine_facts import SystemPaths, condition_key
from cosmos_cli.provision.desired import questions
from cosmos_cli.provision.device_steps import membership, reboot_notes
from cosmos_cli.provision.step import Done
from cosmos_cli.provision.steps import notes_of, plan_steps
from cosmos_cli.provision.wheelhouse import EnvironmentNeed
from cosmos_cli.ui import invocation
from madns_runtime.hardware.contract import Needs

CONFIG = "/boot/firmware/config.txt"
HAT = Needs(
    packages=("sense-hat",),
    groups=("i2c", "video"),
    boot_lines=("dtparam=i2c_arm=on",),
    system_modules=("RTIMU",),
)
BUS = Needs(groups=("i2c",), boot_lines=("dtparam=i2c_arm=on",), requirements=("smbus2>=0.4",))


def desired(*needs, **entries):
    devices = tuple(
        DeviceNeeds(device=f"device{number}", kind="k", needs=each)
        for number, each in enumerate(needs)
    )
    return dataclasses.replace(wanted(**entries), needs=MachineNeeds(devices=devices))


def members(**groups):
    return {condition_key(membership(name)): is_member for name, is_member in groups.items()}


def config(text, path=CONFIG):
    return {path: {"kind": "file", "mode": 0o755, "size_bytes": len(text), "text": text}}


def titles(facts, state):
    return [step.title for step in plan_steps(facts, state)]


def test_what_devices_need_is_planned_once_and_says_for_whom():
    facts = facts_of(files=config("arm_64bit=1\n"), conditions=members(i2c=False, video=False))

    steps = plan_steps(facts, desired(HAT, BUS))

    assert [(step.title, step.needs_root) for step in steps] == [
        ("package sense-hat: install", True),
        ("command usermod -aG i2c pi (for the device device0, device1)", True),
        ("command usermod -aG video pi (for the device device0)", True),
        (f"line in {CONFIG}: add dtparam=i2c_arm=on (for the device device0, device1)", True),
    ]


def test_a_machine_that_has_it_all_needs_no_step():
    facts = facts_of(
        files=config("dtparam=i2c_arm=on\n"),
        conditions=members(i2c=True, video=True),
        packages={"sense-hat": "1.4"},
    )

    assert titles(facts, desired(HAT, BUS)) == []


@pytest.mark.parametrize("before", ["#dtparam=i2c_arm=on\n", "dtparam=i2c_arm=off\n"])
def test_a_line_that_is_switched_off_is_changed_not_added(before):
    facts = facts_of(files=config(before), conditions=members(i2c=True))

    (step,) = plan_steps(facts, desired(BUS))

    assert step.change is not None
    assert step.change.after == "dtparam=i2c_arm=on\n"


def test_overlays_stand_beside_each_other():
    facts = facts_of(files=config("dtoverlay=pps-gpio\n"))
    overlay = Needs(boot_lines=("dtoverlay=pwm-2chan",))

    (step,) = plan_steps(facts, desired(overlay))

    assert step.change is not None
    assert step.change.after == "dtoverlay=pps-gpio\ndtoverlay=pwm-2chan\n"


def test_the_configuration_of_older_systems_is_found():
    facts = facts_of(files=config("", "/boot/config.txt"), conditions=members(i2c=True))

    assert titles(facts, desired(BUS)) == [
        "line in /boot/config.txt: add dtparam=i2c_arm=on (for the device device0)"
    ]


def test_a_machine_without_boot_configuration_gets_a_note_and_no_step():
    facts, state = facts_of(conditions=members(i2c=True)), desired(BUS)

    assert titles(facts, state) == []
    (note,) = notes_of(facts, state)
    assert note.startswith("device0: on a Raspberry Pi config.txt would say dtparam=i2c_arm=on")


def test_root_needs_no_group():
    facts = facts_of(
        user={"name": "root", "id": 0, "home": "/root"}, files=config("dtparam=i2c_arm=on\n")
    )

    assert titles(facts, desired(BUS)) == []


def test_what_the_inventory_writes_itself_is_not_written_twice():
    line = {"path": CONFIG, "line": "dtparam=i2c_arm=on"}
    facts = facts_of(files=config(""), conditions=members(i2c=True))

    assert len(titles(facts, desired(BUS, provision=[{"line": line}]))) == 1


def test_machines_are_asked_what_the_plan_needs():
    asked = questions(desired(HAT))

    assert asked["packages"] == ["sense-hat"]
    assert asked["files"][CONFIG] == asked["files"]["/boot/config.txt"] == "text"
    assert set(asked["conditions"]) == {condition_key(membership(name)) for name in HAT.groups}
    assert "/boot/config.txt" not in questions(desired())["files"]


def test_a_changed_boot_configuration_counts_after_a_restart():
    words = ("-i", "my tower.yaml", "--limit", "tower:!pi01", "s.yaml")
    invocation.record("up", words, frozenset({"-i", "--limit"}), has_tail=False)
    facts = facts_of(files=config(""), conditions=members(i2c=True))
    (step,) = plan_steps(facts, desired(BUS))

    (note,) = reboot_notes([Done(step=step, changed=True)], SystemPaths())

    _, verb, *advised = shlex.split(note.split("`")[1])
    read = load_command(verb).make_context(verb, advised).params
    assert (verb, read["inventory"], read["limit"]) == ("reboot", ("my tower.yaml",), "tower:!pi01")
    assert list(reboot_notes([Done(step=step, changed=False)], SystemPaths())) == []


def test_the_environment_has_the_requirements_and_sees_the_system_where_it_must():
    greeting = {"python": "3.11.2", "machine": "aarch64", "bits": 64, "libc": "glibc 2.36"}

    def need(*needs):
        return EnvironmentNeed.of_machine(
            greeting, Variables(), ("pyproj",), is_host=False, needs=desired(*needs).needs
        )

    assert need(BUS).requirements == ("pyproj", "smbus2>=0.4")
    assert (need(BUS).sees_system, need(HAT).sees_system, need().sees_system) == (
        False,
        True,
        False,
    )
