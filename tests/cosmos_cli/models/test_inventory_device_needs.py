"""Which devices' needs count on a machine, and what is refused of what kinds declare."""

import pytest

from cosmos_cli.models.device_kinds import needs_faults
from cosmos_cli.models.device_needs import needs_of_machines
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.loading import load_scenario
from madns_runtime.hardware.contract import Needs

pytestmark = pytest.mark.process  # kinds of one's own are asked in a process of their own

DRIVER = """
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Needs

class Gauge(Device):
    kind = DeviceKind(
        name="gauge", summary="a gauge", channels=(Channel(name="level"),), needs_hardware=False,
        needs=Needs(packages=("gauge-tools",), requirements=("gaugelib>=2",)),
    )
"""


@pytest.fixture
def needs(tmp_path):
    """Return a function from lists of devices, by machine, to their needs."""

    def find(scenario=None, **devices):
        (tmp_path / "gauge.py").write_text(DRIVER)
        lines = [f"    {name}: {{cosmos_devices: {listed}}}\n" for name, listed in devices.items()]
        path = tmp_path / "inventory.yaml"
        path.write_text("all:\n  hosts:\n" + "".join(lines))
        file = None
        if scenario is not None:
            head = "name: small\nsimulation: counter\nagents: {count: 2, tick_hz: 10}\n"
            (tmp_path / "small.yaml").write_text(f"{head}hardware: {scenario}\n")
            file = load_scenario(tmp_path / "small.yaml")
        return needs_of_machines(load_machines([str(path)]), file)

    return find


def test_mappings_count_and_bare_names_are_labels(needs):
    found = needs(pi01="[{name: hat, kind: sense_hat}]", pi02="[sense_hat]", pi03="[a_label]")

    assert found["pi01"].packages == ("sense-hat",)
    assert found["pi01"].sees_system
    assert found["pi01"].groups["i2c"] == ("hat",)
    assert found["pi02"].packages == found["pi03"].packages == ()


def test_a_bare_name_that_a_scenario_uses_counts(needs):
    found = needs("{use: [{devices: [sense_hat]}]}", pi01="[sense_hat]", pi02="[a_label]")

    assert found["pi01"].packages == ("sense-hat",)
    assert found["pi02"].packages == ()


def test_devices_of_the_scenario_count_on_every_machine(needs):
    scenario = "{devices: [{name: level, kind: './gauge.py:Gauge', agents: [agent-01]}]}"

    found = needs(scenario, pi01="[a_label]", pi02="[a_label]")

    assert [each.requirements for each in found.values()] == [("gaugelib>=2",)] * 2
    assert found["pi01"].driver_files == ()  # it lies in the scenario's folder


def test_drivers_beside_the_inventory_are_named(needs):
    found = needs(pi01="[{name: level, kind: './gauge.py:Gauge'}]", pi02="[a_label]")

    assert found["pi01"].packages == ("gauge-tools",)
    assert found["pi01"].driver_files == ("./gauge.py:Gauge",)
    assert found["pi02"].driver_files == ()


def test_a_device_whose_needs_are_not_known_is_told(needs):
    found = needs(pi01="[{name: again, kind: playback, parameters: {directory: not-there}}]")

    (text,) = found["pi01"].faults
    assert text.startswith("device again: what it needs is not known: ")


def test_needs_that_would_be_strange_commands_are_refused():
    needs = Needs(
        packages=("gauge-",),
        groups=("i2c; reboot",),
        boot_lines=("a\nb",),
        files=("dev/x",),
        requirements=("--index-url x",),
        system_modules=("os system",),
        exclusive=("",),
    )

    found = needs_faults(needs)

    assert [text.split(":")[0] for text in found] == [
        "packages",
        "groups",
        "boot_lines",
        "files",
        "requirements",
        "system_modules",
        "exclusive",
    ]
    assert needs_faults(Needs(packages=("a1",) * 65)) == ["packages: expected at most 64, got 65"]
