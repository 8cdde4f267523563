"""
A machine, one computer of the inventory, and its variables: which ones COSMoS knows, and which it refuses.

Other variables belong to other tools and pass through. What would change how a machine is reached,
and is not honoured here, is a fault: the same inventory must not mean two things.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError

from cosmos_cli.errors import FAULTS_SHOWN_MAX, Fault
from cosmos_cli.models.connection_kind import (
    CONNECTION_OF_WORD,
    AnsibleConnection,
    ConnectionKind,
)
from cosmos_cli.models.document import Document, did_you_mean
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.inventory.devices import DEVICES, MachineDevice, device_kind_faults
from cosmos_cli.models.inventory.settings import SettingVariables
from cosmos_cli.models.provision_steps import ProvisionStep, step_faults
from cosmos_cli.models.text_forms import NOT_EMPTY, DeviceName, Requirement, SystemPackage, like
from cosmos_cli.models.translate import faults_of

ROOT_DEFAULT = "~/cosmos"
PRIORITY = "ansible_group_priority"
"""Of a group, not of its machines: the strongest of groups at the same depth has the highest."""
PROVISION = "cosmos_provision"
UNITED = "united"
"""Marks a list: a machine has those of all its groups, the outermost first, then its own."""
GROUP_KEYS = ("hosts", "children", "vars")
SECRET_REFUSED = (
    "expected no secret in an inventory, which is copied to every run's folder: log in with a"
    " key (ssh-copy-id USER@MACHINE; ansible_ssh_private_key_file names it) or the ssh agent,"
    " and let sudo ask for none"
)
SECRET_HIDDEN = "not understood, and not shown here: its name says that it is a secret"

_ADDRESS = r"(?![^:]*:\d+$)[^\s/@\[\],]+"
"""Of one colon with digits behind it, those are a port; an address of IPv6 has more colons."""
_ADDRESS_WORDS = "a host name or an address, and nothing more"
Address = Annotated[str, like(_ADDRESS, _ADDRESS_WORDS)]
SshAddress = Annotated[str, like(_ADDRESS, f"{_ADDRESS_WORDS}; a port belongs in ansible_port")]
RootFolder = Annotated[
    str,
    like(
        r"(?!.*/\.\.?(?:/|$))(?!/home/[^/]*$)(?:~|/[A-Za-z0-9._+@-]+)(?:/[A-Za-z0-9._+@-]+)+",
        "a folder of COSMoS's own such as ~/cosmos or /opt/cosmos, of letters, digits and ._+@-",
    ),
]
"""Everything below it may be removed: hence no first level of the file system, and no home."""


class Variables(SettingVariables):
    """The variables that COSMoS knows, settings first, with what follows of several; others are none of its business."""

    ansible_host: SshAddress | None = None
    """Address of the machine; its name if not given."""
    ansible_ssh_host: SshAddress | None = None
    """Old name of ansible_host, which it overrides, as in Ansible."""
    ansible_user: Annotated[str, like(r"[^\s:/-][^\s:/]*", "the name of a user")] | None = None
    """User to log in as."""
    ansible_ssh_user: Annotated[str, like(r"[^\s:/-][^\s:/]*", "the name of a user")] | None = None
    """Old name of ansible_user, which it overrides."""
    ansible_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Port of its SSH server."""
    ansible_ssh_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Old name of ansible_port, which it overrides."""
    ansible_connection: AnsibleConnection | None = None
    """local for this computer; everything else is SSH."""
    ansible_private_key_file: Annotated[str, Field(min_length=1)] | None = None
    """Key to log in with."""
    ansible_ssh_private_key_file: Annotated[str, Field(min_length=1)] | None = None
    """The same under its older and stronger name."""
    ansible_python_interpreter: (
        Annotated[str, like(r"auto(_legacy)?(_silent)?|/\S+|python[0-9.]*", "the path of a Python")]
        | None
    ) = None
    """Python there that makes the virtual environment; looked for if not given, or auto."""
    ansible_become: bool | None = None
    """Whether sudo may be used; false for machines that must do without."""
    ansible_become_user: Literal["root"] | None = None
    """User that sudo makes of us."""
    ansible_become_method: Literal["sudo", "ansible.builtin.sudo"] | None = None
    """Way to become root."""

    cosmos_root: RootFolder | None = None
    """Folder on the machine that belongs to COSMoS; ~/cosmos if not given."""
    cosmos_host_address: Address | None = None
    """Address by which this machine reaches the run's host; found out if not given."""
    cosmos_agents: Annotated[int, Field(ge=0)] | None = None
    """Most agents that are placed on this machine; 0 for none."""
    cosmos_devices: tuple[DeviceName | MachineDevice, ...] | None = None
    """Devices attached to it: a name such as sense_hat, or a mapping with name, kind and parameters."""
    cosmos_cpu_affinity: (
        Annotated[tuple[Annotated[int, Field(ge=0, le=4095)], ...], NOT_EMPTY] | None
    ) = None
    """Processors that agents may use there."""
    cosmos_packages: Annotated[tuple[SystemPackage, ...] | None, UNITED] = None
    """System packages; those of all its groups together."""
    cosmos_requirements: Annotated[tuple[Requirement, ...] | None, UNITED] = None
    """Python packages; those of all its groups together."""
    cosmos_provision: Annotated[tuple[ProvisionStep, ...] | None, UNITED] = None
    """Further steps of `cosmos up`; those of all its groups, the outermost first. Of a `Machine` their `src` is absolute."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """
        Return the variables of a mapping as it was written.

        Raises:
            ValidationError: One of them is not what it should be.
        """
        return cls.model_validate_json(json.dumps(values), strict=True)

    @property
    def address(self) -> str | None:
        """Address of the machine; None for its name."""
        return self.ansible_ssh_host or self.ansible_host

    @property
    def connection(self) -> ConnectionKind:
        """Way to reach the machine."""
        return CONNECTION_OF_WORD[self.ansible_connection or "ssh"]

    @property
    def user(self) -> str | None:
        """User who logs in; None leaves it to the ssh configuration."""
        return self.ansible_ssh_user or self.ansible_user

    @property
    def port(self) -> int | None:
        """Port of its SSH server; None leaves it to the ssh configuration."""
        return self.ansible_ssh_port or self.ansible_port

    @property
    def key_file(self) -> Path | None:
        """Path of a private key here; None leaves it to the ssh configuration and the ssh agent."""
        name = self.ansible_ssh_private_key_file or self.ansible_private_key_file
        return Path(os.path.abspath(os.path.expanduser(name))) if name else None

    @property
    def python(self) -> str | None:
        """Python there that the inventory names; None looks for one."""
        name = self.ansible_python_interpreter
        return None if name is None or name.startswith("auto") else name

    @property
    def may_become_root(self) -> bool:
        """False when the inventory says ansible_become: false."""
        return self.ansible_become is not False

    @property
    def root(self) -> str:
        """Folder of COSMoS there; ~ is the home of who logs in."""
        return self.cosmos_root or ROOT_DEFAULT


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """One computer of the inventory."""

    name: str
    address: str
    connection: ConnectionKind = "ssh"
    groups: tuple[str, ...] = ()
    """Every group it belongs to, the outermost first: later ones win."""
    variables: Variables = field(default_factory=Variables)
    """Those that COSMoS knows: of its groups, the inner winning over the outer, then its own; some lists add up."""
    raw_variables: Mapping[str, Any] = field(default_factory=dict)
    """All of them, as Ansible sees them: no list adds up."""
    positions: Mapping[str, int] = field(default_factory=dict)
    """Its place in each of its groups, from 0: what tower[0] counts."""
    devices_folder: Path = Path()
    """Folder from which its devices' files are found: that of the inventory that lists them."""
    inventory_names: frozenset[str] = field(default=frozenset(), compare=False, repr=False)
    """Machines and groups of its inventory, those without machines and those that --limit leaves out as well."""


def no_machine_words(machines: Sequence[Machine], name: str) -> str:
    """Say that *name* is none of *machines*: a group, one that --limit leaves out, or nobody's."""
    if any(name in machine.groups for machine in machines):
        return f"{name} is a group; name one machine"
    if any(name in machine.inventory_names for machine in machines):
        return f"{name} is in the inventory, but --limit leaves it out; let that mean it as well"
    hint = did_you_mean(name, [machine.name for machine in machines])
    return f"no machine is named {name}{hint}"


LOOPBACK = Machine(name="loopback", address="127.0.0.1", connection="local")
"""This computer, where a run without an inventory takes place."""


UNITED_NAMES = tuple(
    name for name, info in Variables.model_fields.items() if UNITED in info.metadata
)
_OWN_NAMES = tuple(name for name in Variables.model_fields if name.startswith("cosmos_"))
_VARIABLE_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_SECRET = re.compile(r"ansible_\w*(?:pass|password|passphrase)|ansible_(?:ssh_)?private_key")
_SSH_OPTIONS = re.compile(
    r"ansible_(?:ssh_(?:common_|extra_)?args|ssh_executable|paramiko_proxy_command|(?:become|sudo)_exe)"
)
_HOST_KEY_CHECKING = re.compile(r"ansible_(?:\w+_)?host_key_checking")
_ELSEWHERE: Mapping[str, str] = {
    "ansible_sudo_user": "ansible_become_user",
    "ansible_su_user": "ansible_become_user",
}
_MAGIC_NAME = re.compile(
    r"groups|group_names|hostvars|inventory_(?:dir|file|hostname(?:_short)?)|play_hosts|playbook_dir"
    r"|role_(?:names?|path|uuid)|ansible_(?:config_file|facts|forks|limit|inventory_sources|play_\w+"
    r"|playbook_python|version|verbosity|check_mode|diff_mode|(?:run|skip)_tags)"
)
_TEMPLATE = re.compile(r"\{[{%#]")
_SECRET_LINE = re.compile(r"ansible_\w*(?:pass|private_key['\"]?\s*:)")


def variable_faults(
    document: Document, path: ValuePath, values: Mapping[str, Any], folder: Path
) -> list[Fault]:
    """
    Return all that is wrong with the variables at *path*.

    Args:
        document: The file they stand in.
        path: Of the mapping that holds them.
        values: That mapping.
        folder: The inventory's.
    """
    faults: list[Fault] = []
    for key, content in values.items():
        has_hints = len(faults) < 2 * FAULTS_SHOWN_MAX
        faults += [
            document.fault((*path, key), text, at_key=True)
            for text in _name_faults(key, content, has_hints=has_hints)
        ]
    faults += [
        document.fault(inner, f"templates are not understood, got {text!r}")
        for inner, text in _templates((*path,), values)
    ]
    try:
        Variables.of(values)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faults += faults_of(document, errors, Variables, below=path)
    else:
        faults += device_kind_faults(document, (*path, DEVICES), values.get(DEVICES), folder)
    steps = step_faults(values.get(PROVISION), folder)
    return faults + [document.fault((*path, PROVISION, *inner), text) for inner, text in steps]


def without_secret(fault: Fault) -> Fault:
    """Return a fault without what could show a secret on a terminal or in a log: its value, and the line it is on."""
    names = re.split(r"[.\[]", fault.path)
    if any(_SECRET.fullmatch(name) for name in names) and fault.text != SECRET_REFUSED:
        return dataclasses.replace(fault, text=SECRET_HIDDEN, source="")
    return dataclasses.replace(fault, source="") if _SECRET_LINE.search(fault.source) else fault


def _name_faults(key: str, value: Any, *, has_hints: bool) -> Iterator[str]:
    if _SECRET.fullmatch(key):
        if value is not None:
            yield SECRET_REFUSED
    elif _SSH_OPTIONS.fullmatch(key):
        yield "not understood: write it in your ssh configuration (~/.ssh/config), which is honoured"
    elif _HOST_KEY_CHECKING.fullmatch(key):
        if value is not True:
            yield "host keys are always checked; --accept-new-host-keys records those of new machines"
    elif key in _ELSEWHERE:
        yield f"not understood: its name is {_ELSEWHERE[key]}"
    elif key == "ansible_shell_type" and value not in (None, "sh"):
        yield "expected sh: machines are reached through a POSIX shell"
    elif key == PRIORITY:
        yield "expected in the vars of a group in the inventory itself: elsewhere it has no effect"
    elif key in GROUP_KEYS:
        yield (
            f"expected a variable, got {key}, a part of a group: put the group under children, or look"
            " at the indentation"
        )
    elif _MAGIC_NAME.fullmatch(key):
        yield "Ansible sets this variable itself and ignores what is written here"
    elif key.startswith("cosmos_") and key not in Variables.model_fields:
        yield f"unknown variable{did_you_mean(key, _OWN_NAMES) if has_hints else ''}"
    elif not _VARIABLE_NAME.fullmatch(key):
        known = list(Variables.model_fields) if has_hints else []
        hint = did_you_mean(key.replace("-", "_"), known)
        yield f"expected letters, digits and '_' in a variable's name{hint if '?' in hint else ''}"


def _templates(path: ValuePath, value: Any) -> Iterator[tuple[ValuePath, str]]:
    if isinstance(value, str) and _TEMPLATE.search(value):
        yield path, value if len(value) <= 60 else value[:57] + "..."
    elif isinstance(value, Mapping):
        for key, item in value.items():
            if _TEMPLATE.search(key):
                yield (*path, key), key
            yield from _templates((*path, key), item)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _templates((*path, index), item)
