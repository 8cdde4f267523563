"""Several inventories are one, as Ansible unites them; a list of machines and a file of names mean the same to both."""

import importlib.util
import json
import os
import random
import re

import ansible_reading
import pytest
import yaml
from test_inventory_as_ansible import random_inventory

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.fleet.fleet import fleet_of
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.inventory.load import read_inventory

needs_ansible = pytest.mark.skipif(
    importlib.util.find_spec("ansible") is None,
    reason="ansible-core is not installed; it comes with `pip install -e .[dev]`",
)
TOWER = {
    "all": {
        "vars": {"ansible_user": "pi", "v_a": 1},
        "children": {
            "tower": {"hosts": {"pi[01:03]": {}}, "vars": {"v_b": 1}},
            "hwil": {"hosts": {"pi02": {"v_c": 1}}},
        },
    }
}
OTHER = {
    "all": {
        "vars": {"v_a": 2},
        "children": {
            "tower": {"hosts": {"pi04": {"ansible_host": "10.0.0.4"}}, "vars": {"v_b": 2}},
            "lab": {"children": {"hwil": {"vars": {"ansible_group_priority": 9, "v_c": 5}}}},
        },
        "hosts": {"pi01": {"v_c": 2}, "alone": {"v_a": 3}},
    }
}
NESTED = {
    "all": {
        "children": {
            "outer": {"children": {"inner": {"hosts": {"pi01": {}}}}},
            "above": {"hosts": {"pi01": {}}},
        }
    }
}
VARIABLES = {
    "inside/group_vars/inner.yml": {"v_a": 31, "v_b": 31, "v_c": 31},
    "inside/group_vars/all.yml": {"v_d": 31},
    "inside/group_vars/outer.yml": {"v_e": 31},
    "outside/group_vars/outer.yml": {"v_a": 32, "v_d": 32},
    "outside/group_vars/above.yml": {"v_b": 32},
    "outside/group_vars/all.yml": {"v_c": 32, "v_d": 33, "v_e": 32},
    "one/group_vars/tower.yml": {"v_b": 11, "v_d": 1},
    "one/host_vars/pi02.yml": {"v_c": 11},
    "two/group_vars/all.yml": {"v_d": 22},
    "two/group_vars/tower/x.yaml": {"v_d": 23},
    "two/host_vars/pi02.yml": {"v_c": 22},
    "two/host_vars/listed.yml": {"v_c": 24},
}
SCENARIO = "name: s\nsimulation: counter\nagents: {count: 1, tick_hz: 10}\ntime: {duration_s: 1}\n"
CASES = {
    "two files": ["one/i.yaml", "two/i.yaml"],
    "the later wins": ["two/i.yaml", "one/i.yaml"],
    "a folder and a file": ["one", "two/i.yaml"],
    "two folders": ["one", "two"],
    "the same twice": ["one/i.yaml", "one/i.yaml"],
    "first again": ["one/i.yaml", "two/i.yaml", "one/i.yaml"],
    "a file and a list": ["one/i.yaml", "pi02,listed,"],
    "a list and a file": ["pi04:2222,listed,", "two/i.yaml"],
    "a list": ["pi01, pi02:2200 ,pi03"],
    "one machine": ["listed,"],
    "two lists": ["b,a,", "c,a,"],
    "a weaker group's file later": ["inside/i.yaml", "outside/i.yaml"],
    "a stronger group's file later": ["outside/i.yaml", "inside/i.yaml"],
    "a weaker group's file between": ["inside", "outside", "inside"],
}


def write(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump(value, sort_keys=False))


@pytest.fixture
def place(tmp_path, monkeypatch):
    write(tmp_path / "one/i.yaml", TOWER)
    write(tmp_path / "two/i.yaml", OTHER)
    write(tmp_path / "inside/i.yaml", NESTED)
    write(tmp_path / "outside/i.yaml", NESTED)
    for name, values in VARIABLES.items():
        write(tmp_path / name, values)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    for name in ("COSMOS_INVENTORY", "COSMOS_LIMIT"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


def listed(capsys, *arguments):
    code = app.run(["inventory", *arguments, "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == 0, answer
    return {m["name"]: (set(m["groups"]), m["vars"]) for m in answer["machines"]}


@pytest.mark.process
@needs_ansible
@pytest.mark.parametrize("sources", CASES.values(), ids=CASES)
def test_several_inventories_are_those_of_ansible(sources, ansible, place, capsys):
    expected = ansible.list_inventory(sources, place)

    assert listed(capsys, *(word for source in sources for word in ("-i", source))) == expected


@pytest.mark.process
@needs_ansible
def test_random_webs_in_several_files_resolve_as_in_ansible(tmp_path):
    requests = []
    for seed in range(60):
        sources = [tmp_path / f"{seed}-{part}" / "i.yaml" for part in range(2 + seed % 2)]
        for part, path in enumerate(sources):
            write(path, _without_circles(random_inventory(1000 * seed + part)))
            chance = random.Random(f"{seed} {part}")
            for kind, names in (("group_vars", ("all", "g0", "g1")), ("host_vars", ("m0", "m1"))):
                for name in names:
                    if chance.random() < 0.4:
                        write(path.parent / kind / f"{name}.yml", {"v_a": chance.randint(0, 999)})
        listed = ["m1,m9,"] if seed % 3 == 0 else []
        given = [*map(str, sources), *listed]
        requests.append({"sources": given, "patterns": ["all[0]", "g0[-1]", "ungrouped"]})
    answers = ansible_reading.resolve_many(requests, tmp_path)
    compared = {"some": 0, "none": 0}

    for request, answer in zip(requests, answers, strict=True):
        inventory = read_inventory(request["sources"])
        told = {
            m.name: [
                sorted(m.groups),
                {key: value for key, value in m.raw_variables.items() if key.startswith("v_")},
            ]
            for m in inventory.machines
        }
        assert told == answer["machines"], request
        for pattern, names in answer["limits"].items():
            assert names_of(inventory, pattern) == names, (request, pattern)
            compared["some" if names else "none"] += 1
    assert compared["some"] >= 100 and compared["none"] >= 40, compared


def names_of(inventory, pattern):
    """Return whom a pattern means; ours refuses what means nobody, to Ansible it is an empty list."""
    try:
        return [machine.name for machine in inventory.select(pattern)]
    except InputError as error:
        assert re.search("means no machine|none is named", str(error)), error
        return []


def _without_circles(inventory):
    """Leave groups side by side: two files could put each of two groups into the other."""
    for group in inventory.values():
        if group and "children" in group:
            del group["children"]
    return inventory


def test_devices_files_are_found_from_the_source_whose_list_counts(place):
    for folder, group in (("inside", "inner"), ("outside", "above"), ("outside", "all")):
        write(place / folder / f"group_vars/{group}.yml", {"cosmos_devices": [folder]})

    folders = {
        tuple(sources): read_inventory(sources).machines[0].devices_folder
        for sources in (["inside", "outside"], ["outside", "inside"])
    }

    assert folders == {
        ("inside", "outside"): place / "outside",
        ("outside", "inside"): place / "inside",
    }


def test_nothing_of_the_first_inventory_is_dropped(place, capsys):
    names = set(listed(capsys, "-i", "one/i.yaml", "-i", "two/i.yaml"))

    assert names == {"pi01", "pi02", "pi03", "pi04", "alone"}


def test_faults_of_every_inventory_are_told_with_their_files(place, capsys):
    (place / "one/i.yaml").write_text("all:\n  hostss: {}\n")
    (place / "two/i.yaml").write_text("all:\n  hosts:\n    pi1: {cosmos_rot: x}\n")

    code = app.run(["inventory", "-i", "one/i.yaml", "-i", "two/i.yaml", "-i", "no,pi[1:2],"])

    error = capsys.readouterr().err
    assert code == 2
    assert "one/i.yaml:2:3: " in error
    assert "two/i.yaml:3:11: " in error
    assert "-i no,pi[1:2],: Ansible knows no ranges" in error


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("a.yaml,b.yaml", "give each file with an -i of its own"),
        ("pi@pi01,", "ansible_user"),
        ("fe80::1,", "give the machine a name"),
        ("host,pi01", "'host' is reserved"),
        ("pi01:0,", "expected a port from 1 to 65535"),
        (",", "expected at least one machine"),
        ("", "expected a file, a folder or a list"),
        ("none.yaml", "no such file"),
    ],
)
def test_source_that_is_none_is_refused(place, capsys, source, words):
    code = app.run(["inventory", "-i", source])

    assert code == 2
    assert words in capsys.readouterr().err


def test_port_of_a_machine_that_is_known_is_not_dropped(place, capsys):
    """Ansible ignores it in silence."""
    code = app.run(["inventory", "-i", "one/i.yaml", "-i", "pi01:2222,"])

    assert code == 2
    assert "-i pi01:2222,: Ansible ignores the port here" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("value", "names"),
    [
        ("one/i.yaml,two/i.yaml", {"pi01", "pi02", "pi03", "pi04", "alone"}),
        ("one/i.yaml", {"pi01", "pi02", "pi03"}),
        ("a,b,", {"a", "b"}),
        ("with, comma.yaml", {"x"}),
    ],
)
def test_variable_of_the_environment_names_several(place, capsys, monkeypatch, value, names):
    write(place / "with, comma.yaml", {"all": {"hosts": {"x": None}}})
    monkeypatch.setenv("COSMOS_INVENTORY", value)

    assert set(listed(capsys)) == names
    assert set(listed(capsys, "-i", "c,")) == {"c"}  # what is given replaces it


def test_files_of_steps_are_found_beside_the_inventory_that_names_them(place):
    for folder in ("one", "two"):
        (place / folder / "unit.service").write_text(folder)
        write(
            place / folder / "i.yaml",
            {
                folder: {
                    "hosts": {"pi01": None},
                    "vars": {
                        "cosmos_provision": [{"file": {"src": "unit.service", "dest": "/etc/x"}}]
                    },
                }
            },
        )

    (machine,) = load_machines(["one/i.yaml", "two/i.yaml"])

    assert [step.file.src for step in machine.variables.cosmos_provision] == [
        os.path.abspath("one/unit.service"),
        os.path.abspath("two/unit.service"),
    ]


def test_targets_are_remembered_of_all_inventories_and_files_of_names(place):
    sources = ["one/i.yaml", "two/i.yaml", "listed,"]
    (place / "failed").write_text("pi04\n")
    assert [t.address for t in fleet_of(sources, "@failed").targets] == ["10.0.0.4"]

    text = (place / "two/i.yaml").read_text()
    (place / "two/i.yaml").write_text(text.replace("10.0.0.4", "10.0.0.9"))
    assert [t.address for t in fleet_of(sources, "@failed").targets] == ["10.0.0.9"]

    (place / "failed").write_text("pi04\npi02\n")
    assert [t.name for t in fleet_of(sources, "@failed").targets] == ["pi02", "pi04"]


FILES = {
    "names": "pi03\npi01\n",
    "spaces and empty lines": "\n  pi02  \n\n",
    "a group": "tower\n!pi02\n",
    "both": "tower\n&hwil\n",
    "glob": "pi0?\n!pi02\n",
    "place": "tower[0:1]\n",
    "without an end": "pi02",
    "windows": "pi01\r\npi02\r\n",
}


@pytest.mark.process
@needs_ansible
@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
@pytest.mark.parametrize("limit", ["@failed", "@failed,pi03", "pi03:@failed", "@failed:!pi01"])
def test_file_of_names_means_what_it_means_to_ansible(place, text, limit, answers):
    expected = answers[text, limit]
    (place / "failed").write_bytes(text.encode())

    try:
        names = [m.name for m in read_inventory("one/i.yaml").select(limit)]
    except InputError:
        names = []

    assert sorted(names) == sorted(expected)


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What Ansible makes of every file and limit, asked in one process."""
    folder = tmp_path_factory.mktemp("limits")
    write(folder / "i.yaml", TOWER)
    limits = ["@failed", "@failed,pi03", "pi03:@failed", "@failed:!pi01"]
    requests = []
    for index, text in enumerate(FILES.values()):
        (folder / f"failed{index}").write_bytes(text.encode())
        patterns = [limit.replace("@failed", f"@failed{index}") for limit in limits]
        requests.append({"sources": [str(folder / "i.yaml")], "patterns": patterns})
    told = ansible_reading.resolve_many(requests, folder)
    return {
        (text, limit): answer["limits"][limit.replace("@failed", f"@failed{index}")]
        for index, (text, answer) in enumerate(zip(FILES.values(), told, strict=True))
        for limit in limits
    }


def test_comments_in_a_file_of_names_are_left_out(place):
    (place / "failed").write_text("# of `cosmos up`\npi01\n")

    assert [m.name for m in read_inventory("one/i.yaml").select("@failed")] == ["pi01"]


@pytest.mark.parametrize(
    ("text", "limit", "words"),
    [
        ("", "@failed", "got none"),  # to Ansible, all machines
        ("# none\n", "@failed", "got none"),
        ("pi01,pi02\n", "@failed", "failed:1:1: expected one pattern a line"),
        ("pi01\npi01 pi02\n", "@failed", "failed:2:1: expected one pattern a line"),
        ("@failed\n", "@failed", "expected one pattern a line"),
        ("pi77\n", "@failed", "no machine or group is named pi77"),
        ("!\n", "@failed", "expected a name after '!'"),
        ("pi01\n", "!@failed", "by itself"),
        ("pi01\n", "@", "expected the path of a file after @"),
        ("pi01\n", "@no-such", "no such file"),
        ("pi01\n", "@one", "got a folder"),
        ("pi01\n", "@pipe", "got a pipe"),
        ("\udcff\n", "@failed", "UTF-8"),
    ],
)
def test_file_of_names_that_is_none_is_refused(place, text, limit, words):
    (place / "failed").write_bytes(text.encode("utf-8", "surrogateescape"))
    os.mkfifo(place / "pipe")

    with pytest.raises(InputError) as caught:
        read_inventory("one/i.yaml").select(limit)

    assert words in str(caught.value)


@pytest.mark.parametrize("verb", ["ps", "down", "run s.yaml", "plan s.yaml", "doctor"])
def test_limit_without_an_inventory_is_refused(place, capsys, verb):
    (place / "s.yaml").write_text(SCENARIO)

    code = app.run([*verb.split(), "--limit", "pi01"])

    assert code == 2
    assert "no machines without an inventory" in capsys.readouterr().err
