"""What Ansible itself makes of an inventory: the authority that our reading is held against."""

import json
import os
import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent
TIMEOUT_S = 120

RESOLVE_MANY = """
import json, sys
from ansible.inventory.manager import InventoryManager
from ansible.parsing.dataloader import DataLoader
from ansible.vars.manager import VariableManager

answers = []
for request in json.load(sys.stdin):
    loader = DataLoader()
    inventory = InventoryManager(loader=loader, sources=[request["file"]])
    variables = VariableManager(loader=loader, inventory=inventory)
    machines = {}
    for host in inventory.get_hosts("all"):
        values = variables.get_vars(host=host, include_hostvars=False, stage="all")
        machines[host.name] = [
            sorted(group.name for group in host.get_groups()),
            {key: value for key, value in values.items() if key.startswith("v_")},
        ]
    limits = {}
    for pattern in request["patterns"]:
        inventory.subset(pattern)
        try:
            limits[pattern] = [host.name for host in inventory.get_hosts("all")]
        except Exception as error:
            limits[pattern] = "error"
        inventory.subset(None)
    answers.append({"machines": machines, "limits": limits})
json.dump(answers, sys.stdout)
"""


def environment(folder):
    """Return an environment without any configuration of this computer's user."""
    config = folder / "ansible.cfg"
    config.write_text("")
    rest = {key: value for key, value in os.environ.items() if not key.startswith("ANSIBLE_")}
    home = {"ANSIBLE_CONFIG": str(config), "ANSIBLE_HOME": str(folder / "home")}
    return rest | home | {"HOME": str(folder), "LC_ALL": "C.UTF-8"}


def list_inventory(path, folder):
    """Return what `ansible-inventory --list` says of each machine: its groups and its variables."""
    command = [str(BIN / "ansible-inventory"), "-i", str(path), "--list"]
    answer = json.loads(_output(command, folder))
    variables = answer.pop("_meta")["hostvars"]
    members = {name: _members(answer, name) for name in [*answer, "all"]}
    return {
        machine: ({name for name, machines in members.items() if machine in machines}, own)
        for machine in members["all"]
        for own in [variables.get(machine, {})]
    }


def _members(answer, name):
    group = answer.get(name, {})
    found = set(group.get("hosts", ()))
    for child in group.get("children", ()):
        found |= _members(answer, child)
    return found


def list_hosts(path, pattern, folder):
    """Return what `ansible PATTERN --list-hosts` lists."""
    command = [str(BIN / "ansible"), "-i", str(path), pattern, "--list-hosts"]
    lines = _output(command, folder).splitlines()
    return [line.strip() for line in lines if not line.strip().startswith("hosts (")]


def resolve_many(requests, folder):
    """Ask Ansible's own classes about many inventories in one process."""
    command = [sys.executable, "-c", RESOLVE_MANY]
    return json.loads(_output(command, folder, json.dumps(requests)))


def _output(command, folder, stdin=""):
    done = subprocess.run(
        command,
        input=stdin,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env=environment(folder),
        cwd=folder,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
