"""
Other fleet tools doing the jobs of benchmarks/fleet.py, each as somebody who knows it well would have it done.

They are installed into a private environment in the cache. pyinfra connects to every board at once; Ansible
gets pipelining, shared connections, no gathering of facts and a fork per board. Both find uv on the boards.
Code and wheels travel as one archive, which is sent and unpacked only where its hash differs; the environment
is made, and started for a first time, only then. Records come back as one archive per board.
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

ARCHIVE = f"{HOME}.tar"
"""Of code and wheels, on each board."""
PACKED = "/tmp/records.tar"
"""The same of the records."""

PYINFRA_DEPLOY = """
from pyinfra.operations import files, server

archive = files.put(src="{archive}", dest="{remote}")
server.shell("{unpack} && {install} && {check}", _if=archive.did_change)
"""

PYINFRA_COLLECT = """
from pyinfra import host
from pyinfra.operations import files, server

server.shell("tar -cf {packed} -C {source} .")
files.get(src="{packed}", dest="{target}/" + host.name + ".tar")
"""

PLAYBOOK = """
- hosts: all
  gather_facts: false
  tasks:
    - copy: {{src: "{archive}", dest: "{remote}"}}
      register: archive
    - shell: "{unpack} && {install} && {check}"
      when: archive.changed
"""

PLAYBOOK_COLLECT = """
- hosts: all
  gather_facts: false
  tasks:
    - command: tar -cf {packed} -C {source} .
    - fetch: {{src: "{packed}", dest: "{target}/{{{{ inventory_hostname }}}}.tar", flat: true}}
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

    def deployment(self) -> dict[str, str]:
        """Return what goes into a play: the archive and the shell commands that follow it on a board."""
        archive = self.folder / "payload.tar"
        if not archive.exists():
            with tarfile.open(archive, "w") as packed:
                packed.add(self.code, "code")
                packed.add(self.wheels, "wheels")
        return {
            "archive": str(archive),
            "remote": ARCHIVE,
            "unpack": f"mkdir -p {HOME}/runs {HOME}/state && cd {HOME} && rm -rf code wheels"
            f" && tar -xf {ARCHIVE}",
            "install": "/usr/local/bin/uv venv -q --clear environment &&"
            " /usr/local/bin/uv pip install -q --offline --no-index --no-deps"
            " -p environment/bin/python wheels/*.whl",
            "check": f"PYTHONPATH=code environment/bin/python -c '{CHECK}'",
        }


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
        text = PYINFRA_DEPLOY.format(**self._job.deployment())
        self._run(str(_write(self._job.folder / "deploy.py", text)))

    def exec(self) -> None:
        """Run a command on every board."""
        self._run("exec", "--", "uname", "-n")

    def collect(self, target: Path) -> None:
        """Fetch the records of every board into a folder per board."""
        text = PYINFRA_COLLECT.format(packed=PACKED, source=self._job.records, target=target)
        self._run(str(_write(self._job.folder / "collect.py", text)))
        unpack_records(target)

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
        text = PLAYBOOK.format(**self._job.deployment())
        self._play(_write(self._job.folder / "up.yaml", text))

    def exec(self) -> None:
        """Run a command on every board."""
        self._run("ansible", "all", "-m", "command", "-a", "uname -n")

    def collect(self, target: Path) -> None:
        """Fetch the records of every board into a folder per board."""
        text = PLAYBOOK_COLLECT.format(packed=PACKED, source=self._job.records, target=target)
        self._play(_write(self._job.folder / "collect.yaml", text))
        unpack_records(target)

    def _play(self, playbook: Path) -> None:
        self._run("ansible-playbook", str(playbook))

    def _run(self, program: str, *arguments: str) -> None:
        command = [self._programs / program, "-i", self._job.inventory, *arguments]
        run(command, self._variables, self._job.folder)


def unpack_records(folder: Path) -> None:
    """Unpack what was fetched from each board beside it."""
    for path in folder.glob("*.tar"):
        with tarfile.open(path) as archive:
            archive.extractall(path.with_suffix(""))
        path.unlink()


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
