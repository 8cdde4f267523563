"""`cosmos up` as a user runs it, on the boards of a tower."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.cosmos_command import CosmosCommand
from harness.waiting import wait_until
from tower import Tower

PATIENCE_S = 180.0
PLACES = "/home/pi /etc /boot/firmware /root /var/lib/dpkg/status /proc/sys/net /sys/class/rfkill"
"""All that `up` may change; contents of the kernel's files are compared by `SHOW_VALUES`."""
LIST = f"sudo find {PLACES} -xdev ! -type d -printf '%p %m %u %s %T@ %i\\n' | LC_ALL=C sort"
FOLDERS = "sudo find /home/pi /etc -xdev -type d | LC_ALL=C sort"
SHOW_VALUES = (
    "cat /proc/sys/net/core/rmem_max /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
    " /sys/class/rfkill/*/soft"
)


@dataclass(frozen=True)
class Result:
    """What `cosmos up --json` came to."""

    code: int
    document: Mapping[str, Any]
    talk: str

    @property
    def machines(self) -> dict[str, Mapping[str, Any]]:
        return {machine["machine"]: machine for machine in self.document["machines"]}

    @property
    def statuses(self) -> dict[str, str]:
        return {name: machine["status"] for name, machine in self.machines.items()}

    @property
    def failures(self) -> dict[str, tuple[str, str]]:
        """The kind and the text of each failure."""
        return {
            name: (machine["failure"]["kind"], machine["failure"]["text"])
            for name, machine in self.machines.items()
            if machine["failure"]
        }

    def changes(self, name: str) -> list[str]:
        return [step["title"] for step in self.machines[name]["steps"] if step["changed"]]


class UpTower:
    """
    A tower, an inventory of it, and the command line.

    Args:
        tower: Its boards.
        folder: For the inventory and the command's own state.
        cache: Of wheels.
    """

    def __init__(self, tower: Tower, folder: Path, cache: Path) -> None:
        self.tower = tower
        self.inventory = folder / "inventory.yaml"
        self.cosmos = CosmosCommand(folder, **tower.operator_environment(), COSMOS_CACHE=str(cache))
        self.write()

    def write(
        self,
        machines: Mapping[str, Mapping[str, Any]] | None = None,
        boards: Sequence[str] | None = None,
        **variables: Any,
    ) -> None:
        self.tower.write_inventory(self.inventory, machines, boards, **variables)

    def start(self, *arguments: str) -> Any:
        return self.cosmos.start("up", "-i", self.inventory, *arguments)

    def finish(self, process: Any) -> Result:
        try:
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
        try:
            document = json.loads(out)
        except ValueError:
            raise AssertionError(f"no JSON; it said: {out}{err}") from None
        if "machines" not in document:
            raise AssertionError(f"no answer of machines: {out}{err}")
        return Result(code=process.returncode, document=document, talk=err)

    def up(self, *arguments: str) -> Result:
        return self.finish(self.start("--json", *arguments))

    def text(self, *arguments: str) -> str:
        """Run it as a person does, and return what it printed as its result."""
        process = self.start(*arguments)
        out, _ = process.communicate(timeout=PATIENCE_S)
        return out

    def files(self, name: str) -> list[str]:
        return self.tower.run(name, LIST).stdout.splitlines()

    def values(self, name: str) -> str:
        return self.tower.run(name, SHOW_VALUES).stdout

    def wait_for_file(self, name: str, path: str) -> None:
        self.wait(lambda: self.tower.run(name, f"test -e {path}", check=False).returncode == 0)

    @staticmethod
    def wait(condition: Callable[[], bool]) -> None:
        wait_until(condition, patience_s=PATIENCE_S)
