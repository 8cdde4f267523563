from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import expand, load_inventory

ROOT = Path(__file__).parents[3]


@pytest.fixture
def read(tmp_path):
    def read_text(text):
        path = tmp_path / "i.yaml"
        path.write_text(text)
        return load_inventory(path)

    return read_text


def faults_of(read, text):
    with pytest.raises(InputError) as caught:
        read(text)
    return [(f.line, f.column, f.path, f.text) for f in caught.value.faults]


def test_shipped_tower_has_24_machines_one_with_a_sense_hat():
    machines = load_inventory(ROOT / "inventory/tower.yaml")

    assert [machine.name for machine in machines] == [f"pi{i:02d}" for i in range(1, 25)]
    assert machines[0].groups == ("all", "tower")
    assert machines[21].groups == ("all", "hwil", "tower")
    assert machines[21].variables == {
        "ansible_user": "pi",
        "cosmos_root": "/home/pi/cosmos",
        "cosmos_cpu_affinity": [3],
        "cosmos_devices": ["sense_hat"],
    }
    assert all(machine.connection == "ssh" for machine in machines)


def test_shipped_loopback_is_this_computer():
    (machine,) = load_inventory(ROOT / "inventory/loopback.yaml")

    assert (machine.name, machine.address, machine.connection) == ("loopback", "127.0.0.1", "local")


def test_inner_group_wins_over_outer_and_own_variables_over_both(read):
    machines = read(
        "all:\n"
        "  vars: {ansible_user: a, x: 1, y: 1, z: 1}\n"
        "  children:\n"
        "    outer:\n"
        "      vars: {x: 2, y: 2}\n"
        "      children:\n"
        "        inner:\n"
        "          vars: {x: 3}\n"
        "          hosts: {m1: , m2: {x: 4}}\n"
    )

    assert [(m.variables["x"], m.variables["y"], m.variables["z"]) for m in machines] == [
        (3, 2, 1),
        (4, 2, 1),
    ]
    assert machines[0].groups == ("all", "outer", "inner")


def test_groups_may_stand_at_the_top_level_beside_all(read):
    (machine,) = read("all: {vars: {x: 1}}\ntower: {hosts: {m1: {ansible_host: 10.0.0.1}}}\n")

    assert (machine.address, machine.groups, machine.variables["x"]) == (
        "10.0.0.1",
        ("all", "tower"),
        1,
    )


def test_other_tools_variables_pass_through(read):
    (machine,) = read("all: {hosts: {m1: {ansible_python_interpreter: /usr/bin/python3}}}\n")

    assert machine.variables["ansible_python_interpreter"] == "/usr/bin/python3"


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("pi", ["pi"]),
        ("pi[1:3]", ["pi1", "pi2", "pi3"]),
        ("pi[08:10]", ["pi08", "pi09", "pi10"]),
        ("pi[1:7:3]", ["pi1", "pi4", "pi7"]),
        ("r[1:2]-pi[1:2].lab", ["r1-pi1.lab", "r1-pi2.lab", "r2-pi1.lab", "r2-pi2.lab"]),
        ("192.168.1.[9:11]", ["192.168.1.9", "192.168.1.10", "192.168.1.11"]),
    ],
)
def test_ranges_are_expanded_with_both_ends(pattern, names):
    assert expand(pattern) == names


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("pi[a:f]", "expected a range of numbers such as pi[01:24], got 'pi[a:f]'"),
        ("pi[1:3", "expected a range of numbers such as pi[01:24], got 'pi[1:3'"),
        ("pi[3:1]", "expected a rising range of numbers, got [3:1]"),
        ("pi[1:3:0]", "expected a rising range of numbers, got [1:3:0]"),
        ("pi[01:100]", "expected ends of the same width, got [01:100]"),
        ("pi[1:9999999]", "expected a rising range of numbers, got [1:9999999]"),
        ("a[1:999]b[1:999]", "expected at most 5000 machines, got 998001"),
        ("../x", "expected letters, digits, '.', '_' or '-' (`host` is reserved), got '../x'"),
        ("host", "expected letters, digits, '.', '_' or '-' (`host` is reserved), got 'host'"),
    ],
)
def test_names_that_are_not_understood_are_refused(pattern, message):
    with pytest.raises(ValueError) as caught:
        expand(pattern)

    assert str(caught.value) == message


def test_every_fault_is_named_with_its_place(read):
    text = (
        "all:\n"
        "  host: {}\n"
        "  vars: {ansible_user: 3, cosmos_rot: /x, z: '{{ y }}'}\n"
        "  hosts:\n"
        "    pi[b:a]: {}\n"
        "    m1: {ansible_port: 70000, ansible_connection: paramiko}\n"
        "    m2: 5\n"
        "  children: [a]\n"
    )

    assert faults_of(read, text) == [
        (2, 3, "all.host", "unknown key, did you mean hosts?"),
        (3, 24, "all.vars.ansible_user", "expected a text, got 3"),
        (3, 27, "all.vars.cosmos_rot", "unknown variable, did you mean cosmos_root?"),
        (3, 46, "all.vars.z", "templates are not understood, got '{{ y }}'"),
        (5, 5, "all.hosts.pi[b:a]", "expected a range of numbers such as pi[01:24], got 'pi[b:a]'"),
        (6, 24, "all.hosts.m1.ansible_port", "expected <= 65535, got 70000"),
        (
            6,
            51,
            "all.hosts.m1.ansible_connection",
            "expected local or ssh, got 'paramiko'",
        ),
        (7, 9, "all.hosts.m2", "expected a mapping, got 5"),
        (8, 13, "all.children", "expected a mapping, got a list"),
    ]


def test_group_inside_itself_is_refused(read):
    text = "a: {children: {b: {children: {a: {hosts: {m: }}}}}}\n"

    assert faults_of(read, text)[0][2:] == ("a.children.b.children.a", "group a is inside itself")


def test_inventory_without_machines_is_refused(read):
    assert (
        faults_of(read, "all: {vars: {x: 1}}\n")[0][3]
        == "expected at least one machine under hosts"
    )
