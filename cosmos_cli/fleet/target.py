"""Address of a machine and login there: what a connection needs of an inventory."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, get_args

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.connection_kind import ConnectionKind
from cosmos_cli.models.inventory_arguments import Given
from cosmos_cli.system.import_turn import IMPORT_TURN

if TYPE_CHECKING:
    # What reads a target from a plan needs no inventory, whose models take long to import.
    from cosmos_cli.models.inventory import Machine

ROOT_FORBIDDEN = "the inventory forbids to become root there (ansible_become: false)"
ROOT_DEFAULT = "~/cosmos"
"""Folder of COSMoS on a machine; ~ is the home of who logs in."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """One machine as a connection sees it; holds no secret and may be written to disk."""

    name: str
    address: str
    """Host name, address, or an alias of the operator's ssh configuration."""
    connection: ConnectionKind = "ssh"
    user: str | None = None
    """User who logs in; None leaves it to the ssh configuration."""
    port: int | None = None
    key_file: str | None = None
    """Path of a private key here; None leaves it to the ssh configuration and the ssh agent."""
    python: str | None = None
    """Interpreter there; None looks for one."""
    may_become_root: bool = True
    """False when the inventory says ansible_become: false."""
    root: str = ROOT_DEFAULT
    """Folder of COSMoS there."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for plan.json."""
        return asdict(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Target:
        """
        Read back what `to_mapping` wrote.

        Raises:
            TypeError: It is something else.
        """
        target = cls(**mapping)
        for name, kinds in _KINDS.items():
            value = getattr(target, name)
            if not isinstance(value, kinds) or (name == "port" and isinstance(value, bool)):
                raise TypeError(f"{name}: unexpected {value!r}")
        if target.connection not in get_args(ConnectionKind):
            raise TypeError(f"connection: unexpected {target.connection!r}")
        return target

    @property
    def label(self) -> str:
        """Return the name, and the address where it is another."""
        return self.name if self.address == self.name else f"{self.name} ({self.address})"


_KINDS: Mapping[str, tuple[type, ...]] = {
    **dict.fromkeys(("name", "address", "connection", "root"), (str,)),
    **dict.fromkeys(("user", "key_file", "python"), (str, type(None))),
    "port": (int, type(None)),
    "may_become_root": (bool,),
}


def require_root(target: Target, advice: str) -> None:
    """
    Refuse a machine where nobody may become root.

    Raises:
        MachineFailure: NO_SUDO, with *advice*.
    """
    if not target.may_become_root:
        raise MachineFailure(FailureKind.NO_SUDO, ROOT_FORBIDDEN, advice)


def same_targets(targets: Iterable[Target]) -> dict[str, str]:
    """Return the names of machines that are reached exactly as an earlier one, each with the name of that one."""
    first: dict[tuple[str, int | None, str | None], str] = {}
    found = {}
    for target in targets:
        if target.connection != "local":
            name = first.setdefault((target.address, target.port, target.user), target.name)
            if name != target.name:
                found[target.name] = name
    return found


def target_of(machine: Machine) -> Target:
    """Return how to reach a machine of the inventory."""
    variables = machine.variables
    return Target(
        name=machine.name,
        address=machine.address,
        connection=machine.connection,
        user=variables.user,
        port=variables.port,
        key_file=None if variables.key_file is None else str(variables.key_file),
        python=variables.python,
        may_become_root=variables.may_become_root,
        root=variables.root,
    )


def machines_of(inventory: Given, limit: str | None = None) -> tuple[Machine, ...]:
    """
    Return the machines of an inventory that are meant.

    Raises:
        InputError: With every fault found.
    """
    with IMPORT_TURN:
        from cosmos_cli.models.inventory import load_machines  # takes 0.2 s to import

    return load_machines(inventory, limit)
