"""The inventory of a tower, as YAML that COSMoS and Ansible read."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from .base import USER


def format_inventory(
    addresses: Mapping[str, str],
    key: Path,
    machines: Mapping[str, Mapping[str, Any]],
    variables: Mapping[str, Any],
) -> str:
    """
    Return the text of an inventory.

    Args:
        addresses: Of the boards, by name; they make the group `tower`.
        key: The user's private key.
        machines: Further variables by machine; machines that are no boards get a group of their own.
        variables: Of all machines.
    """
    reach = {"ansible_user": USER, "ansible_ssh_private_key_file": str(key)}
    hosts = {
        name: {"ansible_host": address, **machines.get(name, {})}
        for name, address in addresses.items()
    }
    groups: dict[str, Any] = {"tower": {"hosts": hosts, "vars": reach}}
    others = {name: dict(values) for name, values in machines.items() if name not in addresses}
    if others:
        groups["others"] = {"hosts": others}
    document: dict[str, Any] = {"children": groups}
    if variables:
        document["vars"] = dict(variables)
    return yaml.safe_dump({"all": document}, sort_keys=False)
