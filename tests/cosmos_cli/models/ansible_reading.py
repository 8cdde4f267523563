"""What Ansible itself makes of an inventory: the authority that our reading is held against."""

import json
import os
import subprocess
import sys
from pathlib import Path

TIMEOUT_S = 120

# Importing Ansible takes most of a command's time: it is imported once, and each command is a fork.
COMMANDS = """
import json, os, sys
from ansible.cli.adhoc import AdHocCLI
from ansible.cli.inventory import InventoryCLI

CLASSES = {"ansible": AdHocCLI, "ansible-inventory": InventoryCLI}
for line in sys.stdin:
    request = json.loads(line)
    pid = os.fork()
    if pid == 0:
        os.chdir(request["folder"])
        for descriptor, name in ((1, "said"), (2, "errors")):
            os.dup2(os.open(request[name], os.O_CREAT | os.O_WRONLY | os.O_TRUNC), descriptor)
        code = 70
        try:
            CLASSES[request["words"][0]].cli_executor(request["words"])
        except SystemExit as end:
            code = int(end.code or 0)
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""

RESOLVE_MANY = """
import json, sys
from ansible.inventory.manager import InventoryManager
from ansible.parsing.dataloader import DataLoader
from ansible.vars.manager import VariableManager

answers = []
for request in json.load(sys.stdin):
    loader = DataLoader()
    inventory = InventoryManager(loader=loader, sources=request.get("sources") or [request["file"]])
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


class AnsibleCommands:
    """
    Ansible's own commands, in one process that has imported it. Use it as a context manager.

    Args:
        folder: For its files; nothing of this computer's user is read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __enter__(self) -> "AnsibleCommands":
        self._process = subprocess.Popen(
            [sys.executable, "-c", COMMANDS],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(self._folder),
            cwd=self._folder,
        )
        return self

    def __exit__(self, *_exception: object) -> None:
        self._process.stdin.close()
        self._process.wait(TIMEOUT_S)
        self._process.stdout.close()

    def list_inventory(self, sources, folder, *options):
        """Return what `ansible-inventory --list` says of each machine: its groups and its variables."""
        sources = sources if isinstance(sources, list) else [sources]
        given = [word for source in sources for word in ("-i", str(source))]
        answer = json.loads(self._output(["ansible-inventory", *given, "--list", *options], folder))
        variables = answer.pop("_meta")["hostvars"]
        members = {name: _members(answer, name) for name in [*answer, "all"]}
        return {
            machine: ({name for name, machines in members.items() if machine in machines}, own)
            for machine in members["all"]
            for own in [variables.get(machine, {})]
        }

    def list_hosts(self, path, pattern, folder):
        """Return what `ansible PATTERN --list-hosts` lists."""
        command = ["ansible", "-i", str(path), pattern, "--list-hosts"]
        lines = self._output(command, folder).splitlines()
        return [line.strip() for line in lines if not line.strip().startswith("hosts (")]

    def _output(self, words, folder):
        said, errors = self._folder / "said", self._folder / "errors"
        request = {"words": words, "folder": str(folder), "said": str(said), "errors": str(errors)}
        print(json.dumps(request), file=self._process.stdin, flush=True)
        code = self._process.stdout.readline().strip()
        assert code == "0", errors.read_text() if code else "it ended"
        return said.read_text()


def _members(answer, name):
    group = answer.get(name, {})
    found = set(group.get("hosts", ()))
    for child in group.get("children", ()):
        found |= _members(answer, child)
    return found


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
