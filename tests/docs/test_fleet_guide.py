"""docs/fleet.md: its tables are complete and true, and its examples are read as they stand."""

import json
import re

import pytest
import yaml
from guides import FLEET, GUIDES, ROOT, blocks, commands, row_keys

from cosmos_cli import app
from cosmos_cli.errors import ExitCode
from cosmos_cli.fleet.failure import FailureKind
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.ssh.config import KEYWORDS
from cosmos_cli.launch.plan import make_plan
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.inventory.machine import Variables
from cosmos_cli.models.inventory.settings import SETTINGS
from cosmos_cli.models.limit import select_machines
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.machine_facts import SystemPaths
from cosmos_cli.models.provision_steps import KINDS
from cosmos_cli.provision.step import Kind
from cosmos_cli.provision.steps import PLANNERS

INVENTORY, PROVISION, PLACEMENT = blocks(FLEET, "yaml")
SCENARIO = "name: placed\nsimulation: counter\nagents: {count: 12}\n"


def names_of(prefix):
    return {name for name in Variables.model_fields if name.startswith(prefix)}


def machines_of(folder, text):
    path = folder / "inventory.yaml"
    path.write_text(text, "utf-8")
    return load_machines(path)


def test_every_variable_of_cosmos_is_documented_and_no_other():
    own = names_of("cosmos_")
    mentioned = set(re.findall(r"\bcosmos_[a-z_]+", FLEET)) - {"cosmos_cli"}

    assert sorted(row_keys(FLEET, "### COSMoS's variables")) == sorted(own)
    assert mentioned == own


def test_table_of_variables_says_what_is_declared():
    section = FLEET.split("### COSMoS's variables", 1)[1].split("\n#", 1)[0]
    rows = re.findall(r"^\| (`cosmos_[^|]+) \| ([^|]+) \| ([^|]+) \|", section, flags=re.M)
    told = {
        name: (kind, default)
        for names, kind, default in rows
        for name in re.findall(r"cosmos_\w+", names)
    }
    declared = {name: str(field.annotation) for name, field in Variables.model_fields.items()}

    def of(is_it):
        return {name for name, row in told.items() if is_it(*row)}

    def declared_as(part):
        return {name for name in told if part in declared[name]}

    assert of(lambda kind, _: kind.startswith("list")) == declared_as("tuple[")
    assert of(lambda kind, _: kind == "`true`, `false`") == declared_as("bool")
    assert of(lambda kind, _: kind in ("number", "bytes", "1 to 99")) == {
        name for name in declared_as("int") if "tuple[" not in declared[name]
    }
    assert of(lambda _, default: default == "left as it is") == {s.variable for s in SETTINGS}
    assert told["cosmos_root"][1] == f"`{Variables().root}`"


def test_every_variable_of_ansible_that_counts_is_documented_and_no_other():
    assert set(row_keys(FLEET, "### Ansible's variables")) == names_of("ansible_")


def test_every_kind_of_what_up_changes_is_documented_and_no_other():
    assert row_keys(FLEET, "## What up does") == [kind.value for kind in Kind]


def test_every_kind_of_failure_is_documented_and_no_other():
    kinds = [kind.value for kind in FailureKind]

    assert row_keys(FLEET, "## When something fails") == kinds


def test_every_exit_code_is_documented_and_no_other():
    section = FLEET.split("\n## Exit codes\n", 1)[1].split("\n## ", 1)[0]

    assert [int(code) for code in re.findall(r"^\| (\d+) \|", section, flags=re.M)] == list(
        ExitCode
    )


def test_every_kind_of_step_is_documented_and_no_other():
    assert tuple(row_keys(FLEET, "### Steps of one's own")) == KINDS


def test_every_keyword_of_the_ssh_configuration_is_documented_and_no_other():
    told = FLEET.split("Honoured of the ssh configuration:", 1)[1].split("COSMOS_SSH_CONFIG", 1)[0]
    named = {name.lower() for name in re.findall(r"`([A-Za-z]+)`", told)}

    assert named == {"host", "match", "include", *KEYWORDS}


def test_every_file_of_a_setting_is_documented():
    for path in (setting.file(SystemPaths()) for setting in SETTINGS):
        assert path in FLEET or f"`{path.rsplit('/', 1)[1]}`" in FLEET


def test_table_of_settings_says_where_each_is_kept():
    heading = "### Settings and how they are put back"
    section = FLEET.split(heading, 1)[1].split("\n#", 1)[0]
    rows = re.findall(r"^\| `(cosmos_\w+)` \| `([^`]+)`", section, flags=re.M)

    assert rows == [(setting.variable, setting.file(SystemPaths())) for setting in SETTINGS]


def test_every_kind_of_planned_step_has_its_place_in_the_order_of_up():
    section = FLEET.split("\n## What up does\n", 1)[1].split("\n#", 1)[0]
    numbers = re.findall(r"^(\d)\. ", section, flags=re.M)

    assert len(numbers) == len(PLANNERS) + 1  # and the check at the end


def test_every_folder_on_a_machine_is_documented_and_no_other():
    layout = Layout("")
    folders = (layout.trees, layout.environments, layout.wheels, layout.runs, layout.state)
    table = FLEET.split("What lies on a machine below", 1)[1].split("\n\nOne", 1)[0]

    assert re.findall(r"^\| `([a-z]+)/`", table, flags=re.M) == list(folders)


def test_example_of_an_inventory_is_one(tmp_path):
    machines = {machine.name: machine for machine in machines_of(tmp_path, INVENTORY)}

    assert len(machines) == 25
    assert machines["pi22"].variables.cosmos_devices == ("sense_hat",)
    assert machines["pi22"].variables.cosmos_receive_buffer_bytes == 4194304
    assert machines["here"].connection == "local"


def test_several_inventories_of_the_guide_are_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inventory").mkdir()
    (tmp_path / "inventory/tower.yaml").write_text(INVENTORY, "utf-8")
    (tmp_path / "lab.yaml").write_text("lab: {hosts: {lab1: }}\n")
    (words,) = [words for words in commands(FLEET) if "lab.yaml" in words]

    assert app.run([*words[1:], "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["machines"]) == 27


def test_every_pattern_of_the_table_means_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "failed.txt").write_text("# again\npi07\npi11\n")
    machines = machines_of(tmp_path, INVENTORY)
    counts = {
        pattern: len(select_machines(machines, pattern))
        for pattern in row_keys(FLEET, "### Some of the machines")
    }

    assert counts == {
        **{"pi07": 1, "tower": 24, "pi0*": 9, "~pi0[1-4]": 4},
        **{"tower,laptop": 25, "tower:laptop": 25, "tower:&hwil": 1, "tower:!hwil": 23},
        "@failed.txt": 2,
        **{"tower[0]": 1, "tower[-1]": 1, "tower[0:3]": 4, "tower[5:]": 19},
    }


def test_example_of_steps_is_valid(tmp_path):
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "beacon.service").write_text("[Unit]\n", "utf-8")
    variables = {"hosts": {"pi01": yaml.safe_load(PROVISION)}}
    [machine] = machines_of(tmp_path, yaml.safe_dump({"all": variables}))

    assert [step.kind for step in machine.variables.cosmos_provision] == [
        "line",
        "file",
        "service",
        "command",
    ]


def test_example_of_placement_does_what_it_says(tmp_path):
    (tmp_path / "placed.yaml").write_text(SCENARIO + PLACEMENT, "utf-8")
    scenario = load_scenario(tmp_path / "placed.yaml").scenario
    plan = make_plan(scenario, machines_of(tmp_path, INVENTORY))

    assert plan.agents_by_machine["pi22"] == ("agent-01",)
    assert plan.agents_by_machine["here"] == tuple(f"agent-{n:02d}" for n in range(2, 6))
    assert sum(map(len, plan.agents_by_machine.values())) == 12


BESIDE = [path for folder in ("tests", "scenarios") for path in (ROOT / folder).rglob("*.md")]


@pytest.mark.parametrize(
    "guide",
    [*GUIDES, ROOT / "CHANGELOG.md", *sorted(BESIDE)],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_every_link_of_a_guide_leads_somewhere(guide):
    linked = re.findall(r"\]\(([^)\s]+)\)", guide.read_text("utf-8"))

    for link in linked:
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = (guide.parent / file) if file else guide
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), flags=re.M)
            anchors = {re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in headings}
            assert anchor in anchors, link
