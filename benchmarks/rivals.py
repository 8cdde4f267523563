"""
Other fleet tools doing the jobs of benchmarks/fleet.py, each as its own documentation would have it done.

They are installed into a private environment in the cache. pyinfra gets its library's fastest settings
(parallel connections to every board); Ansible gets pipelining, shared connections and a fork a board.
Both find uv on the boards. pyinfra syncs the folders of code and wheels; Ansible unpacks the code from one
archive, since a file at a time takes it minutes.
"""

from __future__ import annotations

import os
import subprocess
import tarfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import uv

HOME = "/home/pi/rival"
PACKAGES = ("pyinfra>=3.5", "ansible-core>=2.17")
TIMEOUT_S = 1800.0
CHECK = "import madns_runtime.agent, numpy"

PYINFRA_DEPLOY = """
from pyinfra.operations import files, server

for folder in ("", "/wheels", "/runs", "/state"):
    files.directory(path="{home}" + folder)
files.sync(src="{code}", dest="{home}/code")
files.sync(src="{wheels}", dest="{home}/wheels")
server.shell(
    "test -e {home}/environment/complete || ({install} && touch {home}/environment/complete)"
)
server.shell("cd {home} && PYTHONPATH=code environment/bin/python -c '{check}'")
"""

PYINFRA_COLLECT = """
from pyinfra import host
from pyinfra.operations import files

for name in {names}:
    files.get(src="{source}/" + name, dest="{target}/" + host.name + "/" + name, create_local_dir=True)
"""

PLAYBOOK = """
- hosts: all
  gather_facts: false
  tasks:
    - file: {{path: "{home}{{{{ item }}}}", state: directory}}
      loop: ["", /code, /wheels, /runs, /state]
    - unarchive: {{src: "{code_archive}", dest: "{home}/code"}}
    - copy: {{src: "{wheels}/", dest: "{home}/wheels/"}}
    - shell: "{install} && touch {home}/environment/complete"
      args: {{creates: "{home}/environment/complete"}}
    - shell: "cd {home} && PYTHONPATH=code environment/bin/python -c '{check}'"
"""

PLAYBOOK_COLLECT = """
- hosts: all
  gather_facts: false
  tasks:
    - fetch: {{src: "{source}/{{{{ item }}}}", dest: "{target}/"}}
      loop: {names}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """What every contender is to do."""

    folder: Path
    """For the contender's own files."""
    inventory: Path
    """YAML, as Ansible and cosmos read it."""
    ssh_config: Path
    known_hosts: Path
    key: Path
    boards: Mapping[str, str]
    """Address by name."""
    code: Path
    """Folder that holds the packages to copy."""
    wheels: Path
    records: str
    """Folder on each board with the records to collect."""

    @property
    def install(self) -> str:
        """Shell command that makes the environment on a board."""
        return (
            f"cd {HOME} && rm -rf environment && /usr/local/bin/uv venv -q environment &&"
            " /usr/local/bin/uv pip install -q --offline --no-index --no-deps"
            " -p environment/bin/python wheels/*.whl"
        )


def install_rivals(cache: Path) -> Path:
    """Return the folder of programs of an environment that holds the other tools."""
    folder = cache / "rivals"
    if not (folder / "bin/ansible-playbook").exists():
        for arguments in (
            ["venv", "-q", "--clear", str(folder)],
            ["pip", "install", "-q", "-p", str(folder / "bin/python"), *PACKAGES],
        ):
            subprocess.run([uv.find_uv_bin(), *arguments], check=True)
    return folder / "bin"


class Pyinfra:
    """https://pyinfra.com: paramiko and gevent, commands planned from facts."""

    name = "pyinfra"

    def __init__(self, job: Job, programs: Path) -> None:
        self._job = job
        self._program = programs / "pyinfra"
        data = {
            "ssh_user": "pi",
            "ssh_key": str(job.key),
            "ssh_known_hosts_file": str(job.known_hosts),
            "ssh_allow_agent": False,
            "ssh_look_for_keys": False,
            "ssh_config_file": str(job.ssh_config),
        }
        hosts = [(name, data) for name in job.boards]
        self._inventory = _write(job.folder / "inventory.py", f"boards = {hosts!r}\n")

    def up(self) -> None:
        """Make every board ready."""
        text = PYINFRA_DEPLOY.format(
            home=HOME,
            code=self._job.code,
            wheels=self._job.wheels,
            install=self._job.install,
            check=CHECK,
        )
        self._run(str(_write(self._job.folder / "deploy.py", text)))

    def exec(self) -> None:
        """Run a command on every board."""
        self._run("exec", "--", "uname", "-n")

    def collect(self, names: tuple[str, ...], target: Path) -> None:
        """Fetch the records *names* of every board."""
        text = PYINFRA_COLLECT.format(names=names, source=self._job.records, target=target)
        self._run(str(_write(self._job.folder / "collect.py", text)))

    def _run(self, *arguments: str) -> None:
        parallel = str(len(self._job.boards))
        command = [self._program, "-y", "--parallel", parallel, self._inventory, *arguments]
        run(command, {}, self._job.folder)


class Ansible:
    """https://github.com/ansible/ansible: a module is sent and started for each task."""

    name = "ansible"

    def __init__(self, job: Job, programs: Path) -> None:
        self._job = job
        self._programs = programs
        self._archive = job.folder / "code.tar"
        with tarfile.open(self._archive, "w") as archive:
            archive.add(job.code, ".")
        self._variables = {
            "ANSIBLE_PIPELINING": "1",
            "ANSIBLE_FORKS": str(len(job.boards)),
            "ANSIBLE_SSH_ARGS": f"-F {job.ssh_config} -o ControlMaster=auto -o ControlPersist=60s",
            "ANSIBLE_SSH_CONTROL_PATH_DIR": str(job.folder / "cp"),
            "ANSIBLE_LOCAL_TEMP": str(job.folder / "tmp"),
            "ANSIBLE_PYTHON_INTERPRETER": "/usr/bin/python3",
        }

    def up(self) -> None:
        """Make every board ready."""
        text = PLAYBOOK.format(
            home=HOME,
            code_archive=self._archive,
            wheels=self._job.wheels,
            install=self._job.install,
            check=CHECK,
        )
        self._play(_write(self._job.folder / "up.yaml", text))

    def exec(self) -> None:
        """Run a command on every board."""
        self._run("ansible", "all", "-m", "command", "-a", "uname -n")

    def collect(self, names: tuple[str, ...], target: Path) -> None:
        """Fetch the records *names* of every board."""
        text = PLAYBOOK_COLLECT.format(names=list(names), source=self._job.records, target=target)
        self._play(_write(self._job.folder / "collect.yaml", text))

    def _play(self, playbook: Path) -> None:
        self._run("ansible-playbook", str(playbook))

    def _run(self, program: str, *arguments: str) -> None:
        command = [self._programs / program, "-i", self._job.inventory, *arguments]
        run(command, self._variables, self._job.folder)


def run(command: list[Any], variables: Mapping[str, str], folder: Path) -> str:
    """Run a program to its good end and return what it printed; anything else ends the benchmark."""
    done = subprocess.run(
        [str(part) for part in command],
        env={**os.environ, **variables},
        cwd=folder,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
        timeout=TIMEOUT_S,
    )
    if done.returncode:
        said = (done.stdout + done.stderr)[-3000:]
        raise SystemExit(f"{Path(str(command[0])).name} ended with {done.returncode}:\n{said}")
    return done.stdout


def _write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path
