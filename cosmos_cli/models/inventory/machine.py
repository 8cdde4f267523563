"""A machine: one computer of the inventory, with everything that was said about it resolved."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cosmos_cli.models.inventory.variables import ROOT_DEFAULT
from cosmos_cli.models.provision_steps import ProvisionStep


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """One computer of the inventory."""

    name: str
    address: str
    connection: Literal["local", "ssh"] = "ssh"
    groups: tuple[str, ...] = ()
    """Every group it belongs to, the outermost first: later ones win."""
    variables: Mapping[str, Any] = field(default_factory=dict)
    """All variables, as Ansible sees them: of its groups, the inner winning over the outer, then its own."""
    packages: tuple[str, ...] = ()
    """System packages that its groups and itself ask for, together."""
    requirements: tuple[str, ...] = ()
    """Python packages that its groups and itself ask for, together."""
    provision: tuple[ProvisionStep, ...] = ()
    """Steps of all its groups, the outermost first, then its own; their `src` is absolute."""
    positions: Mapping[str, int] = field(default_factory=dict)
    """Its place in each of its groups, from 0: what tower[0] counts."""

    @property
    def user(self) -> str | None:
        """Who logs in; None leaves it to the ssh configuration."""
        return self._text("ansible_ssh_user", "ansible_user")

    @property
    def port(self) -> int | None:
        """Port of its SSH server; None leaves it to the ssh configuration."""
        return self._number("ansible_ssh_port", "ansible_port")

    @property
    def key_file(self) -> Path | None:
        """Path of a private key here; None leaves it to the ssh configuration and the ssh agent."""
        name = self._text("ansible_ssh_private_key_file", "ansible_private_key_file")
        return Path(os.path.abspath(os.path.expanduser(name))) if name else None

    @property
    def python(self) -> str | None:
        """Python there that the inventory names; None looks for one."""
        name = self._text("ansible_python_interpreter")
        return None if name is None or name.startswith("auto") else name

    @property
    def may_become_root(self) -> bool:
        """False when the inventory says ansible_become: false."""
        return self._first("ansible_become") is not False

    @property
    def root(self) -> str:
        """Folder of COSMoS there; ~ is the home of who logs in."""
        return self._text("cosmos_root") or ROOT_DEFAULT

    @property
    def host_address(self) -> str | None:
        """Address by which it reaches the run's host; None to find it out."""
        return self._text("cosmos_host_address")

    @property
    def agents_max(self) -> int | None:
        """Most agents that are placed here; None for no bound."""
        return self._number("cosmos_agents")

    @property
    def devices(self) -> tuple[str, ...]:
        """Devices attached to it."""
        return tuple(self._first("cosmos_devices") or ())

    @property
    def cpu_affinity(self) -> tuple[int, ...]:
        """Processors that agents may use; empty for all."""
        return tuple(self._first("cosmos_cpu_affinity") or ())

    @property
    def receive_buffer_bytes(self) -> int | None:
        """Largest socket receive buffer that its kernel is to grant; None to leave it."""
        return self._number("cosmos_receive_buffer_bytes")

    @property
    def realtime_priority(self) -> int | None:
        """Highest real-time priority that the user may take; None to leave it."""
        return self._number("cosmos_realtime_priority")

    @property
    def cpu_governor(self) -> str | None:
        """What decides the processors' clock; None to leave it."""
        return self._text("cosmos_cpu_governor")

    @property
    def wifi(self) -> bool | None:
        """Whether its Wi-Fi is to be on; None to leave it."""
        return self._flag("cosmos_wifi")

    @property
    def bluetooth(self) -> bool | None:
        """Whether its Bluetooth is to be on; None to leave it."""
        return self._flag("cosmos_bluetooth")

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return {
            "name": self.name,
            "address": self.address,
            "connection": self.connection,
            "groups": list(self.groups),
            "variables": dict(self.variables),
        }

    def _first(self, *names: str) -> Any:
        """Return the first variable of these that has a value."""
        for name in names:
            if self.variables.get(name) is not None:
                return self.variables[name]
        return None

    def _text(self, *names: str) -> str | None:
        value = self._first(*names)
        return None if value is None else str(value)

    def _number(self, *names: str) -> int | None:
        value = self._first(*names)
        return None if value is None else int(value)

    def _flag(self, name: str) -> bool | None:
        value = self._first(name)
        return None if value is None else bool(value)
