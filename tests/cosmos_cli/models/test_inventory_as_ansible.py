"""Our reading of an inventory is Ansible's: the same machines, groups and variables, the same --limit."""

import importlib.util
import json
import random
from pathlib import Path

import ansible_reading
import pytest
import yaml

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.inventory.load import read_inventory

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(
        importlib.util.find_spec("ansible") is None,
        reason="ansible-core is not installed; it comes with `pip install -e .[dev]`",
    ),
]
ROOT = Path(__file__).parents[3]
FOLDER = Path(__file__).parent / "inventories"
FILES = sorted(
    [
        *FOLDER.glob("*.yaml"),
        *FOLDER.glob("*.json"),
        FOLDER / "beside/tower.yaml",
        FOLDER / "folder",
        *(ROOT / "inventory").glob("*.yaml"),
    ]
)


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_machines_groups_and_variables_are_those_of_ansible(path, ansible, tmp_path, capsys):
    expected = ansible.list_inventory(path, tmp_path)

    code = app.run(["inventory", "-i", str(path), "--json"])

    machines = json.loads(capsys.readouterr().out)["machines"]
    assert code == 0
    assert {m["name"]: (set(m["groups"]), m["vars"]) for m in machines} == expected
    assert all(list(machine) == ["name", "groups", "vars"] for machine in machines)


def random_inventory(seed):
    """Return an inventory with a web of groups, some written at several places, and its machines."""
    chance = random.Random(seed)
    names = [f"g{index}" for index in range(chance.randint(1, 7))]
    chance.shuffle(names)
    machines = [f"m{index}" for index in range(chance.randint(1, 6))]
    variables = [f"v_{letter}" for letter in "abcd"]

    def some_variables():
        return {key: chance.randint(0, 999) for key in variables if chance.random() < 0.3}

    def group(position, depth):
        content = {}
        if chance.random() < 0.7:
            content["vars"] = some_variables()
            if chance.random() < 0.3:
                content["vars"]["ansible_group_priority"] = chance.randint(-2, 5)
        if chance.random() < 0.7:
            content["hosts"] = {
                machine: some_variables() or None for machine in machines if chance.random() < 0.4
            }
        below = range(position + 1, len(names))
        if depth < 3 and chance.random() < 0.7:
            content["children"] = {
                names[child]: group(child, depth + 1) for child in below if chance.random() < 0.4
            }
        keys = list(content)
        chance.shuffle(keys)
        return {key: content[key] for key in keys} or None

    whole = {
        name: group(position, 0) for position, name in enumerate(names) if chance.random() < 0.7
    }
    whole["all"] = {"hosts": {machines[0]: some_variables()}, "vars": some_variables()}
    order = list(whole)
    chance.shuffle(order)
    return {name: whole[name] for name in order}


def test_random_webs_of_groups_resolve_as_in_ansible(tmp_path):
    requests = []
    for seed in range(120):
        path = tmp_path / f"{seed}.yaml"
        path.write_text(yaml.safe_dump(random_inventory(seed), sort_keys=False))
        requests.append({"file": str(path), "patterns": []})
    answers = ansible_reading.resolve_many(requests, tmp_path)

    for request, answer in zip(requests, answers, strict=True):
        machines = load_machines(Path(request["file"]))

        assert {
            machine.name: [sorted(machine.groups), dict(machine.raw_variables)]
            for machine in machines
        } == answer["machines"], Path(request["file"]).read_text()


PATTERNS = [
    "all",
    "*",
    "pi01",
    "pi0*",
    "pi?2",
    "tower",
    "tower,chiefs",
    "tower:chiefs",
    "pi01:pi02:lab1",
    "tower:&hwil",
    "tower:!chiefs",
    "!chiefs:tower",
    "!chiefs",
    "&hwil",
    "tower:&hwil:!pi01",
    "!pi0*,tower",
    "t*",
    "*[0]",
    "tower[0]",
    "tower[-1]",
    "tower[1:3]",
    "tower[2:]",
    "tower[0:0]",
    "chiefs[1]",
    "pi*[1:2]",
    "tower[1:3]:&tower[2:5]",
    "~pi0[135]",
    "~(lab|pi1)",
    "~t",
    "ungrouped",
    "all:!ungrouped:!tower",
    "10.0.0.*",
    "lab1, lab2 , pi12",
    "all[3]",
    "spare:pi01",
    "tower:!spare",
]
REFUSED = ["tower[40]", "tower:!all"]


@pytest.fixture(scope="module")
def limits(tmp_path_factory):
    request = {"file": str(FOLDER / "limits.yaml"), "patterns": PATTERNS + REFUSED}
    return ansible_reading.resolve_many([request], tmp_path_factory.mktemp("limits"))[0]["limits"]


@pytest.mark.parametrize("pattern", PATTERNS)
def test_limit_means_what_it_means_to_ansible(pattern, limits):
    selected = read_inventory(FOLDER / "limits.yaml").select(pattern)

    assert sorted(machine.name for machine in selected) == sorted(limits[pattern])


@pytest.mark.parametrize("pattern", REFUSED)
def test_limit_without_a_machine_is_none_for_ansible_too(pattern, limits):
    assert limits[pattern] in ([], "error")
    with pytest.raises(InputError):
        read_inventory(FOLDER / "limits.yaml").select(pattern)


@pytest.mark.parametrize("pattern", ["tower[1:3],lab1", "tower:&hwil", "all:!chiefs"])
def test_limit_lists_the_machines_of_the_ansible_command(pattern, ansible, tmp_path):
    expected = ansible.list_hosts(FOLDER / "limits.yaml", pattern, tmp_path)

    selected = read_inventory(FOLDER / "limits.yaml").select(pattern)

    assert sorted(machine.name for machine in selected) == sorted(expected)
