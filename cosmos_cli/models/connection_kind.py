"""Kinds of connection, and Ansible's words for them. Light: read where an inventory's models are not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

ConnectionKind = Literal["local", "ssh"]
"""Way to reach a machine: it is this computer, or one over SSH; `fleet/open_connection.py` opens each."""
AnsibleConnection = Literal[
    "local",
    "ssh",
    "smart",
    "paramiko",
    "paramiko_ssh",
    "ansible.builtin.local",
    "ansible.builtin.ssh",
]
CONNECTION_OF_WORD: Mapping[AnsibleConnection, ConnectionKind] = {
    "local": "local",
    "ssh": "ssh",
    "smart": "ssh",
    "paramiko": "ssh",
    "paramiko_ssh": "ssh",
    "ansible.builtin.local": "local",
    "ansible.builtin.ssh": "ssh",
}
"""Kind of connection that each value of ansible_connection means."""
