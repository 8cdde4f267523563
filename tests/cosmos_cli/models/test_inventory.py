import json
from pathlib import Path

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.inventory import load_machines
from cosmos_cli.models.inventory.names import expand, split_port

ROOT = Path(__file__).parents[3]


@pytest.fixture
def read(tmp_path):
    path = tmp_path / "i.yaml"

    def read_text(text):
        path.write_text(text)
        return load_machines(path)

    read_text.path = path
    return read_text


def faults_of(read, text):
    with pytest.raises(InputError) as caught:
        read(text)
    return [(f.line, f.column, f.path, f.text) for f in caught.value.faults]


def test_shipped_tower_has_24_boards_one_with_a_sense_hat_and_this_computer():
    machines = load_machines(ROOT / "inventory/tower.yaml")

    *boards, here = machines
    assert [machine.name for machine in boards] == [f"pi{i:02d}" for i in range(1, 25)]
    assert all(machine.connection == "ssh" for machine in boards)
    assert boards[0].groups == ("all", "tower")
    assert boards[21].groups == ("all", "hwil", "tower")
    assert [machine.name for machine in boards if machine.variables.cosmos_devices] == ["pi22"]
    known = boards[0].variables
    assert (known.user, known.root, known.cosmos_cpu_affinity) == ("pi", "/home/pi/cosmos", (3,))
    assert (known.cosmos_wifi, known.cosmos_receive_buffer_bytes) == (False, 4194304)
    assert [step.kind for step in boards[21].variables.cosmos_provision] == ["line", "command"]
    assert (here.name, here.connection, here.variables.cosmos_agents) == ("here", "local", 0)


def test_shipped_loopback_is_this_computer():
    (machine,) = load_machines(ROOT / "inventory/loopback.yaml")

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

    assert [
        (m.raw_variables["x"], m.raw_variables["y"], m.raw_variables["z"]) for m in machines
    ] == [
        (3, 2, 1),
        (4, 2, 1),
    ]
    assert machines[0].groups == ("all", "outer", "inner")


def test_groups_may_stand_at_the_top_level_beside_all(read):
    (machine,) = read("all: {vars: {x: 1}}\ntower: {hosts: {m1: {ansible_host: 10.0.0.1}}}\n")

    assert (machine.address, machine.groups, machine.raw_variables["x"]) == (
        "10.0.0.1",
        ("all", "tower"),
        1,
    )


def test_other_tools_variables_pass_through(read):
    (machine,) = read("all: {hosts: {m1: {ansible_python_interpreter: /usr/bin/python3}}}\n")

    assert machine.raw_variables["ansible_python_interpreter"] == "/usr/bin/python3"


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("pi", ["pi"]),
        ("pi[1:3]", ["pi1", "pi2", "pi3"]),
        ("pi[08:10]", ["pi08", "pi09", "pi10"]),
        ("pi[0:10:5]", ["pi0", "pi5", "pi10"]),
        ("pi[:2]", ["pi0", "pi1", "pi2"]),
        ("pi[1:7:3]", ["pi1", "pi4", "pi7"]),
        ("pi[a:c]", ["pia", "pib", "pic"]),
        ("pi[y:B]", ["piy", "piz", "piA", "piB"]),
        ("pi[a:g:3]", ["pia", "pid", "pig"]),
        ("r[1:2]-pi[a:b].lab", ["r1-pia.lab", "r1-pib.lab", "r2-pia.lab", "r2-pib.lab"]),
        ("192.168.1.[9:11]", ["192.168.1.9", "192.168.1.10", "192.168.1.11"]),
    ],
)
def test_ranges_are_expanded_with_both_ends(pattern, names):
    assert expand(pattern) == names


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("pi[1-3]", "expected a range such as [01:24], [1:9:2] or [a:f], got [1-3]"),
        ("pi[]", "expected a range such as [01:24], [1:9:2] or [a:f], got []"),
        ("pi[1:3", "expected a range such as pi[01:24], got 'pi[1:3'"),
        ("pi[3:1]", "expected a rising range, got [3:1]"),
        ("pi[f:a]", "expected a rising range, got [f:a]"),
        ("pi[A:a]", "expected a rising range, got [A:a]"),
        ("pi[ab:cd]", "expected two numbers or two letters as ends, got [ab:cd]"),
        ("pi[a:9]", "expected two numbers or two letters as ends, got [a:9]"),
        ("pi[1:3:0]", "expected a step >= 1, got '0' in [1:3:0]"),
        ("pi[1:3:-1]", "expected a step >= 1, got '-1' in [1:3:-1]"),
        ("pi[01:100]", "expected ends of the same width, got [01:100]"),
        ("pi[1:9999999]", "expected at most 5000 machines, got 9999999"),
        ("a[1:999]b[1:999]", "expected at most 5000 machines, got 998001"),
        ("../x", "expected letters, digits, '.', '_' or '-', got '../x'"),
        ("host", "'host' is reserved; give the machine another name"),
        ("hos[s:u]", "'host' is reserved; give the machine another name"),
        (
            "pi01 pi02",
            "expected letters, digits, '.', '_' or '-', got 'pi01 pi02': write a colon after each machine,"
            " and each on its own line",
        ),
        (
            "fe80::1",
            "expected letters, digits, '.', '_' or '-', got 'fe80::1': give the machine a name, and its"
            " address in ansible_host",
        ),
    ],
)
def test_names_that_are_not_understood_are_refused(pattern, message):
    with pytest.raises(ValueError) as caught:
        expand(pattern)

    assert str(caught.value) == message


def test_port_after_a_name_is_split_off_where_ansible_does_it():
    assert split_port("pi[1:3].lab:2222") == ("pi[1:3].lab", 2222)
    assert split_port("pi[1:3]") == ("pi[1:3]", None)
    for pattern in ("pi_:22", "pi[:3]:22", "[1:3]:22"):
        with pytest.raises(ValueError, match="Ansible does not find the port in"):
            split_port(pattern)
    with pytest.raises(ValueError, match="expected a port from 1 to 65535, got 70000"):
        split_port("pi:70000")


def test_every_fault_is_named_with_its_place(read):
    text = (
        "all:\n"
        "  host: {}\n"
        "  vars: {ansible_user: 3, cosmos_rot: /x, z: '{{ y }}', deep: [{a: '{% b %}'}]}\n"
        "  hosts:\n"
        "    pi[b:a]: {}\n"
        "    m1: {ansible_port: 70000, ansible_connection: winrm}\n"
        "    m2: 5\n"
        "    a:\n"
        "  children: [a]\n"
        "a b: {}\n"
        "a: {vars: {ansible_group_priority: x}, hosts: {'m1:22': }}\n"
        "plugin: aws\n"
    )

    assert faults_of(read, text) == [
        (2, 3, "all.host", "unknown key, did you mean hosts?"),
        (3, 24, "all.vars.ansible_user", "expected the name of a user, got 3"),
        (3, 27, "all.vars.cosmos_rot", "unknown variable, did you mean cosmos_root?"),
        (3, 46, "all.vars.z", "templates are not understood, got '{{ y }}'"),
        (3, 68, "all.vars.deep[0].a", "templates are not understood, got '{% b %}'"),
        (5, 5, "all.hosts.pi[b:a]", "expected a rising range, got [b:a]"),
        (6, 24, "all.hosts.m1.ansible_port", "expected <= 65535, got 70000"),
        (
            6,
            51,
            "all.hosts.m1.ansible_connection",
            "expected local, ssh, smart, paramiko, paramiko_ssh, ansible.builtin.local or"
            " ansible.builtin.ssh, got 'winrm'",
        ),
        (7, 9, "all.hosts.m2", "expected a mapping, got 5"),
        (8, 5, "all.hosts.a", "a is a group, too; give one of them another name"),
        (
            9,
            13,
            "all.children",
            "expected a mapping, got a list: write `name:` instead of `- name`",
        ),
        (10, 1, "a b", "expected letters, digits, '_', '-' or '.' in a group's name, got 'a b'"),
        (11, 36, "a.vars.ansible_group_priority", "expected a whole number, got 'x'"),
        (
            11,
            48,
            "a.hosts.m1:22",
            f"Ansible ignores the port here: write it in {read.path}:6, which is first",
        ),
        (12, 1, "plugin", "inventory plug-ins are not run: write what it prints to a file in YAML"),
    ]


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ("no", "Ansible reads no as false: write false, or put a text in quotes"),
        ("On", "Ansible reads On as true: write true, or put a text in quotes"),
        ("0644", "expected a text in quotes, or the number 644, got 0644, which Ansible reads as 420"),
        ("0o17", "expected a text in quotes, or the number 15, got 0o17, which Ansible reads as the text '0o17'"),
        ("1e3", "expected a text in quotes, or the number 1000, got 1e3, which Ansible reads as the text '1e3'"),
        ("-.5", "expected a text in quotes, or the number -0.5, got -.5, which Ansible reads as the text '-.5'"),
        ("12:30", "expected a text in quotes, got 12:30, which Ansible reads as 750"),
        ("1_000", "expected a text in quotes, got 1_000, which Ansible reads as 1000"),
        ("2024-01-01", "expected a text in quotes, got 2024-01-01, which Ansible reads as the date 2024-01-01"),
        ("2024-13-41", "Ansible cannot read 2024-13-41: put it in quotes"),
        ("=", "Ansible cannot read =: put it in quotes"),
    ],
)  # fmt: skip
def test_scalars_that_ansible_reads_otherwise_are_refused(read, written, told):
    text = f"all: {{hosts: {{m: {{deep: [{{x: {written}}}]}}}}}}\n"

    assert faults_of(read, text) == [(1, 30, "all.hosts.m.deep[0].x", told)]


def test_scalars_that_mean_the_same_in_both_readings_or_are_quoted_are_taken(read):
    (machine,) = read(
        "all: {hosts: {m: {x: ['no', \"0644\", !!str 0644, 1.5, true, 0x10, off-line]}}}\n"
    )

    assert machine.raw_variables["x"] == ["no", "0644", "0644", 1.5, True, 16, "off-line"]


def test_what_pyyaml_refuses_is_refused(read):
    text = "all:\n  hosts: {a: {x: &l [1]}, b: {x: &l [2]}}\n"

    assert faults_of(read, text)[0][:2] == (2, 34)
    assert faults_of(read, text)[0][3].startswith("expected each anchor once")


def test_group_among_the_machines_is_told_from_its_keys(read):
    text = "all:\n  hosts:\n    m1:\n    tower:\n      hosts: {m2: }\n      vars: {x: 1}\n"

    faults = faults_of(read, text)

    assert [fault[:3] for fault in faults] == [
        (5, 7, "all.hosts.tower.hosts"),
        (6, 7, "all.hosts.tower.vars"),
    ]
    assert "put the group under children" in faults[0][3]


def test_key_that_ansible_reads_otherwise_is_refused(read):
    faults = faults_of(read, "all: {hosts: {m: {on: 1}}}\n")

    assert faults[0][3] == "Ansible reads on as true: write true, or put a text in quotes"


def test_scalar_behind_several_aliases_is_told_once_and_no_consequence_is(read):
    text = "all: {hosts: {a: &a {cosmos_wifi: no}, b: *a, c: *a}}\n"

    assert [fault[3] for fault in faults_of(read, text)] == [
        "Ansible reads no as false: write false, or put a text in quotes"
    ]


@pytest.mark.parametrize(
    "name",
    ["ansible_password", "ansible_ssh_pass", "ansible_become_password", "ansible_become_pass",
     "ansible_ssh_private_key_passphrase", "ansible_private_key"],
)  # fmt: skip
def test_secret_is_refused_and_never_shown(read, name):
    with pytest.raises(InputError) as caught:
        read(f"all: {{hosts: {{m: {{{name}: swordfish, ansible_port: 0}}}}}}\n")

    assert len(caught.value.faults) == 2
    assert "expected no secret in an inventory" in str(caught.value)
    assert "ssh agent" in str(caught.value)
    assert "swordfish" not in str(caught.value)
    assert "swordfish" not in json.dumps(caught.value.details())


@pytest.mark.parametrize("value", ["0644", "'{{ 0644 }}'", "\n      0644", "[0644]"])
@pytest.mark.parametrize(
    "place", ["ansible_password", "ansible_password_file: x\n    deep:\n      ansible_become_pass"]
)
def test_secret_is_not_shown_by_a_fault_of_its_own_value(read, place, value):
    with pytest.raises(InputError) as caught:
        read(
            f"all:\n  hosts: {{m: }}\n  vars:\n    {place}: {value}\n".replace(
                "\n      0644", "\n        0644"
            )
        )

    assert "0644" not in str(caught.value)
    assert "0644" not in json.dumps(caught.value.details())


def test_secret_is_not_shown_by_a_fault_of_syntax_either(read):
    with pytest.raises(InputError) as caught:
        read("all:\n  vars: {ansible_password: swordfish, x: [\n")

    assert "swordfish" not in str(caught.value)


@pytest.mark.parametrize("address", ["fe80::1%eth0", "::1", "2001:db8::17:22", "pi01.local"])
def test_address_with_colons_of_its_own_has_no_port(read, address):
    (machine,) = read(f"all: {{hosts: {{m: {{ansible_host: '{address}'}}}}}}\n")

    assert machine.variables.address == address


@pytest.mark.parametrize(
    ("variable", "told"),
    [
        ("ansible_ssh_common_args: -o ProxyJump=x", "write it in your ssh configuration"),
        ("ansible_host_key_checking: false", "host keys are always checked"),
        ("ansible_become_user: admin", "expected root, got 'admin'"),
        ("ansible_become_method: su", "expected sudo or ansible.builtin.sudo, got 'su'"),
        ("ansible_sudo_user: root", "its name is ansible_become_user"),
        ("ansible_shell_type: fish", "expected sh"),
        ("ansible_become: yes please", "expected true or false, got 'yes please'"),
        ("ansible_host: pi@10.0.0.1", "expected a host name or an address, and nothing more"),
        ("ansible_host: 10.0.0.1:2222", "and nothing more; a port belongs in ansible_port"),
        ("ansible_ssh_host: pi01.local:22", "and nothing more; a port belongs in ansible_port"),
        ("cosmos_host_address: 10.0.0.1:4", "expected a host name or an address, and nothing more"),
        ("inventory_hostname: x", "Ansible sets this variable itself"),
        ("cosmos-devices: [x]", "in a variable's name, did you mean cosmos_devices?"),
        ("cosmos_root: /", "expected a folder of COSMoS's own"),
        ("cosmos_root: '~'", "expected a folder of COSMoS's own"),
        ("cosmos_root: /home/pi", "expected a folder of COSMoS's own"),
        ("cosmos_root: /opt/a/../..", "expected a folder of COSMoS's own"),
        ("cosmos_root: /opt/two words", "expected a folder of COSMoS's own"),
        ("cosmos_agents: -1", "expected >= 0, got -1"),
        ("cosmos_realtime_priority: 100", "expected <= 99, got 100"),
        ("cosmos_receive_buffer_bytes: 0", "expected > 0, got 0"),
        ("cosmos_wifi: off-line", "expected true or false, got 'off-line'"),
        ("cosmos_cpu_affinity: []", "expected at least one item, got a list"),
        ("cosmos_devices: sense_hat", "expected a list, got 'sense_hat'"),
        ("cosmos_packages: [i2c-tools-]", "expected the name of a Debian package"),
        ("cosmos_packages: [--purge]", "expected the name of a Debian package"),
        ("cosmos_requirements: [--index-url=x]", "expected a Python requirement"),
        ("cosmos_requirements: [./local.whl]", "expected a Python requirement"),
    ],
)
def test_variable_that_is_not_understood_is_refused(read, variable, told):
    faults = faults_of(read, f"all:\n  vars:\n    {variable}\n  hosts: {{m: }}\n")

    assert len(faults) == 1
    assert faults[0][0] == 3
    assert told in faults[0][3]


@pytest.mark.parametrize(
    "text",
    [
        "a: {children: {b: {children: {a: {hosts: {m: }}}}}}\n",
        "a: {children: {b: }}\nb: {children: {c: }}\nc: {hosts: {m: }, children: {a: }}\n",
        "a: {hosts: {m: }, children: {a: }}\n",
    ],
)
def test_group_inside_itself_is_refused(read, text):
    assert [fault[3] for fault in faults_of(read, text)] == ["group a is inside itself"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: {hosts: {m: }, children: {all: }}", "all holds every group and is inside none"),
        ("a: {hosts: {m: }, children: {ungrouped: }}", "ungrouped holds the machines of no other"),
        ("ungrouped: {hosts: {m: }, children: {a: }}", "ungrouped holds the machines of no other"),
    ],
)
def test_special_groups_keep_their_place(read, text, told):
    assert told in faults_of(read, text)[0][3]


def test_machine_knows_what_was_said_about_it(read):
    (machine,) = read(
        "all: {hosts: {m: {ansible_ssh_host: 10.0.0.1, ansible_host: 10.0.0.2, ansible_user: pi,\n"
        "  ansible_port: 2222, ansible_private_key_file: /k, ansible_become: false,\n"
        "  ansible_python_interpreter: /usr/bin/python3, ansible_connection: paramiko,\n"
        "  cosmos_root: /opt/cosmos, cosmos_host_address: 10.0.0.9, cosmos_agents: 3,\n"
        "  cosmos_devices: [sense_hat], cosmos_cpu_affinity: [2, 3], cosmos_wifi: false,\n"
        "  cosmos_receive_buffer_bytes: 4194304, cosmos_realtime_priority: 80,\n"
        "  cosmos_cpu_governor: performance, cosmos_bluetooth: true}}}\n"
    )

    known = machine.variables
    assert (machine.address, machine.connection, known.user, known.port) == (
        "10.0.0.1",
        "ssh",
        "pi",
        2222,
    )
    assert (known.key_file, known.python) == (Path("/k"), "/usr/bin/python3")
    assert (known.may_become_root, known.root) == (False, "/opt/cosmos")
    assert (known.cosmos_host_address, known.cosmos_agents) == ("10.0.0.9", 3)
    assert (known.cosmos_devices, known.cosmos_cpu_affinity) == (("sense_hat",), (2, 3))
    assert (known.cosmos_receive_buffer_bytes, known.cosmos_realtime_priority) == (4194304, 80)
    assert (known.cosmos_cpu_governor, known.cosmos_wifi, known.cosmos_bluetooth) == (
        "performance",
        False,
        True,
    )


def test_machine_of_which_nothing_was_said_leaves_it_to_others(read):
    (machine,) = read("all: {hosts: {m: {ansible_python_interpreter: auto}}}\n")

    known = machine.variables
    assert (machine.address, machine.connection) == ("m", "ssh")
    assert (known.user, known.port, known.key_file, known.python) == (None,) * 4
    assert (known.may_become_root, known.root, known.cosmos_agents) == (True, "~/cosmos", None)
    assert (known.cosmos_devices, known.cosmos_cpu_affinity, known.cosmos_provision) == (
        None,
        None,
        (),
    )
    assert (known.cosmos_wifi, known.cosmos_bluetooth, known.cosmos_cpu_governor) == (
        None,
        None,
        None,
    )


def test_priority_of_a_machine_is_refused(read):
    faults = faults_of(read, "all: {hosts: {m: {ansible_group_priority: 3}}}\n")

    assert "expected in the vars of a group" in faults[0][3]


def test_null_takes_back_what_a_group_says(read):
    machines = read(
        "all: {vars: {cosmos_cpu_affinity: [3], cosmos_root: /opt/c}, hosts: {m: {cosmos_cpu_affinity: null, cosmos_root: }}}\n"
    )

    assert (machines[0].variables.cosmos_cpu_affinity, machines[0].variables.root) == (
        None,
        "~/cosmos",
    )


def test_machines_stand_in_the_order_of_the_file(read):
    machines = read(
        "b: {children: {c: {hosts: {m3: , m1: }}}, hosts: {m2: }}\nall: {hosts: {m0: , m1: }}\n"
    )

    assert [machine.name for machine in machines] == ["m3", "m1", "m2", "m0"]


def test_what_groups_want_adds_up_though_variables_replace_each_other(read):
    (machine,) = read(
        "all:\n"
        "  vars:\n"
        "    cosmos_packages: [a1, b1]\n"
        "    cosmos_requirements: [numpy]\n"
        "    cosmos_provision: [{packages: [outer]}]\n"
        "  children:\n"
        "    tower:\n"
        "      vars:\n"
        "        cosmos_packages: [b1, c1]\n"
        "        cosmos_provision: [{packages: [inner]}, {packages: [inner2]}]\n"
        "      hosts:\n"
        "        m:\n"
        "          cosmos_requirements: [scipy]\n"
        "          cosmos_provision: [{packages: [own]}]\n"
    )

    assert machine.variables.cosmos_packages == ("a1", "b1", "c1")
    assert machine.variables.cosmos_requirements == ("numpy", "scipy")
    assert [step.packages for step in machine.variables.cosmos_provision] == [
        ("outer",), ("inner",), ("inner2",), ("own",),
    ]  # fmt: skip
    assert machine.raw_variables["cosmos_provision"] == [{"packages": ["own"]}]
    assert machine.raw_variables["cosmos_packages"] == ["b1", "c1"]


def test_inventory_without_machines_is_refused(read):
    assert (
        faults_of(read, "all: {vars: {x: 1}}\n")[0][3]
        == "expected at least one machine under hosts"
    )


def test_limit_leaves_the_machines_it_means(read):
    read("tower: {hosts: {m1: , m2: , m3: }}\nspare:\n")

    assert [machine.name for machine in load_machines(read.path, "tower:!m2:!spare")] == [
        "m1",
        "m3",
    ]
    assert len(load_machines(read.path)) == 3


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("i.ini", "[tower]\npi01\n", "expected YAML, got an inventory in INI form; convert it"),
        ("i.ini", "all: {hosts: {pi01: {}}}", "expected a name that ends in .yml, .yaml, .json or has no ending"),
        ("i", "# boards\n[tower]\npi01 ansible_host=10.0.0.1\n", "expected YAML, got an inventory in INI form"),
        ("i.yaml", "pi01 ansible_host=10.0.0.1\n", "expected YAML, got an inventory in INI form"),
        ("i.yaml", "#!/usr/bin/env python3\nprint()\n", "scripts that print an inventory are not run"),
        ("i.yaml", "$ANSIBLE_VAULT;1.1;AES256\n6638\n", "files of ansible-vault are not understood"),
        ("i.yaml", "all: {hosts: {m: {x: !vault abc}}}\n", "expected a plain value, got the tag !vault"),
        ("i.yaml", "[a, b]\n", "expected a mapping (key: value), got a list"),
    ],
)  # fmt: skip
def test_other_kinds_of_inventories_are_refused(tmp_path, name, text, told):
    (tmp_path / name).write_text(text)

    with pytest.raises(InputError) as caught:
        load_machines(tmp_path / name)

    assert told in str(caught.value)


def test_faults_of_variable_files_are_named_with_their_place(tmp_path):
    for folder in ("group_vars/tower", "host_vars"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "i.yaml").write_text("tower: {hosts: {m1: {cosmos_wifi: 3}, m2: }}\n")
    (tmp_path / "group_vars/tower/a.yml").write_text("x: 1\ncosmos_rot: /x\n")
    (tmp_path / "group_vars/tower.yml").write_text("x: 2\n")
    (tmp_path / "host_vars/m1.yml").write_text("- 1\n")
    (tmp_path / "host_vars/m2").write_text("$ANSIBLE_VAULT;1.1;AES256\n")

    with pytest.raises(InputError) as caught:
        load_machines(tmp_path / "i.yaml")

    told = [
        (Path(f.file).relative_to(tmp_path), f.line, f.text.split(":")[0])
        for f in caught.value.faults
    ]
    assert [(str(path), line, text) for path, line, text in told] == [
        ("i.yaml", 1, "expected true or false, got 3"),
        ("group_vars/tower.yml", None, "Ansible reads only 'tower', which stands beside it"),
        ("group_vars/tower/a.yml", 2, "unknown variable, did you mean cosmos_root?"),
        ("host_vars/m1.yml", 1, "expected a mapping (key"),
        ("host_vars/m2", 1, "files of ansible-vault are not understood"),
    ]


def test_folder_without_an_inventory_is_refused(tmp_path):
    (tmp_path / "README.md").write_text("nothing")

    with pytest.raises(InputError, match="expected an inventory file in this folder"):
        load_machines(tmp_path)


def test_machines_are_bounded_over_all_groups_and_counted_once(read):
    text = "a: {hosts: {'m[1:4999]': , n: }}\nb: {hosts: {'m[1:4999]': }}\n"

    assert len(read(text)) == 5000
    assert faults_of(read, text + "c: {hosts: {o: }}\n") == [
        (3, 13, "c.hosts.o", "expected at most 5000 machines")
    ]
