"""
The variables of machines and groups: which ones COSMoS knows, and which it refuses.

Other variables belong to other tools and pass through. What would change how a machine is reached,
and is not honoured here, is a fault: the same inventory must not mean two things.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cosmos_cli.errors import Fault
from cosmos_cli.models.document import Document, did_you_mean
from cosmos_cli.models.document import Path as ValuePath
from cosmos_cli.models.provision_steps import ProvisionStep, step_faults
from cosmos_cli.models.texts import NOT_EMPTY, DeviceName, Requirement, SystemPackage, like
from cosmos_cli.models.translate import faults_of

ROOT_DEFAULT = "~/cosmos"
PRIORITY = "ansible_group_priority"
"""Of a group, not of its machines: the strongest of groups at the same depth has the highest."""
PROVISION = "cosmos_provision"
GROUP_KEYS = ("hosts", "children", "vars")
SECRET_REFUSED = (
    "expected no secret in an inventory, which is copied to every run's folder: log in with a"
    " key (ssh-copy-id USER@MACHINE; ansible_ssh_private_key_file names it) or the ssh agent,"
    " and let sudo ask for none"
)
SECRET_HIDDEN = "not understood, and not shown here: its name says that it is a secret"

Address = Annotated[str, like(r"[^\s/@\[\],]+", "a host name or an address, and nothing more")]
RootFolder = Annotated[
    str,
    like(
        r"(?!.*/\.\.?(?:/|$))(?!/home/[^/]*$)(?:~|/[A-Za-z0-9._+@-]+)(?:/[A-Za-z0-9._+@-]+)+",
        "a folder of COSMoS's own such as ~/cosmos or /opt/cosmos, of letters, digits and ._+@-",
    ),
]
"""Everything below it may be removed: hence no first level of the file system, and no home."""


class Variables(BaseModel):
    """The variables that COSMoS knows; others pass through untouched."""

    model_config = ConfigDict(extra="allow", frozen=True)

    ansible_host: Address | None = None
    """Address of the machine; its name if not given."""
    ansible_ssh_host: Address | None = None
    """Old name of ansible_host, which it overrides, as in Ansible."""
    ansible_user: Annotated[str, like(r"[^\s:/-][^\s:/]*", "the name of a user")] | None = None
    """Who to log in as."""
    ansible_ssh_user: Annotated[str, like(r"[^\s:/-][^\s:/]*", "the name of a user")] | None = None
    """Old name of ansible_user, which it overrides."""
    ansible_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Port of its SSH server."""
    ansible_ssh_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Old name of ansible_port, which it overrides."""
    ansible_connection: (
        Literal[
            "local",
            "ssh",
            "smart",
            "paramiko",
            "paramiko_ssh",
            "ansible.builtin.local",
            "ansible.builtin.ssh",
        ]
        | None
    ) = None
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
    """Whom sudo makes of us."""
    ansible_become_method: Literal["sudo", "ansible.builtin.sudo"] | None = None
    """How to become root."""

    cosmos_root: RootFolder | None = None
    """Folder on the machine that belongs to COSMoS; ~/cosmos if not given."""
    cosmos_host_address: Address | None = None
    """Address by which this machine reaches the run's host; found out if not given."""
    cosmos_agents: Annotated[int, Field(ge=0)] | None = None
    """Most agents that are placed on this machine; 0 for none."""
    cosmos_devices: tuple[DeviceName, ...] | None = None
    """Devices attached to it, such as sense_hat."""
    cosmos_cpu_affinity: (
        Annotated[tuple[Annotated[int, Field(ge=0, le=4095)], ...], NOT_EMPTY] | None
    ) = None
    """Processors that agents may use there."""
    cosmos_packages: tuple[SystemPackage, ...] | None = None
    """System packages; those of all its groups together."""
    cosmos_requirements: tuple[Requirement, ...] | None = None
    """Python packages; those of all its groups together."""
    cosmos_receive_buffer_bytes: Annotated[int, Field(gt=0, le=2**31 - 1)] | None = None
    """Largest socket receive buffer that the kernel is to grant; as it is if not given."""
    cosmos_realtime_priority: Annotated[int, Field(ge=1, le=99)] | None = None
    """Highest real-time priority that the user may take; as it is if not given."""
    cosmos_cpu_governor: (
        Annotated[str, like(r"[a-z_]+", "a governor such as performance")] | None
    ) = None
    """What decides the processors' clock, such as performance; as it is if not given."""
    cosmos_wifi: bool | None = None
    """false switches the radio off, true on; as it is if not given."""
    cosmos_bluetooth: bool | None = None
    """false switches the radio off, true on; as it is if not given."""
    cosmos_provision: tuple[ProvisionStep, ...] | None = None
    """Further steps of `cosmos up`; those of all its groups, the outermost first."""


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
    faults = [
        document.fault((*path, key), text, at_key=True)
        for key, content in values.items()
        for text in _name_faults(key, content)
    ]
    faults += [
        document.fault(inner, f"templates are not understood, got {text!r}")
        for inner, text in _templates((*path,), values)
    ]
    try:
        Variables.model_validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        errors = error.errors(include_url=False)
        faults += faults_of(document, errors, Variables, below=path)
    steps = step_faults(values.get(PROVISION), folder)
    return faults + [document.fault((*path, PROVISION, *inner), text) for inner, text in steps]


def without_secrets(faults: list[Fault]) -> list[Fault]:
    """Return the faults without what could show a secret on a terminal or in a log: its value, and the line it is on."""
    return [_without_secret(fault) for fault in faults]


def _without_secret(fault: Fault) -> Fault:
    names = re.split(r"[.\[]", fault.path)
    if any(_SECRET.fullmatch(name) for name in names) and fault.text != SECRET_REFUSED:
        return dataclasses.replace(fault, text=SECRET_HIDDEN, source="")
    return dataclasses.replace(fault, source="") if _SECRET_LINE.search(fault.source) else fault


def _name_faults(key: str, value: Any) -> Iterator[str]:
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
        yield f"unknown variable{did_you_mean(key, _OWN_NAMES)}"
    elif not _VARIABLE_NAME.fullmatch(key):
        hint = did_you_mean(key.replace("-", "_"), list(Variables.model_fields))
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
