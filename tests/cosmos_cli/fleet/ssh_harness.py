"""What tests over SSH share: whether there is a server, a configuration of their own, a server as a target."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from sshd import SSHD, Sshd

from cosmos_cli.fleet.target import Target


def needs_sshd() -> None:
    if SSHD is None or shutil.which("ssh-keygen") is None:
        pytest.skip("needs OpenSSH's sshd and ssh-keygen")


def write_configuration(file: Path, *lines: str) -> None:
    """Write an ssh configuration; the lines come before what all tests need."""
    common = (
        "Host *",
        f"  UserKnownHostsFile {file.parent / 'known_hosts'}",
        "  GlobalKnownHostsFile none",
    )
    file.write_text("\n".join((*lines, *common)) + "\n", encoding="utf-8")


def target_of(server: Sshd, **changed) -> Target:
    values = {
        "name": "pi",
        "address": server.address,
        "port": server.port,
        "user": server.user,
        "key_file": str(server.user_key),
    }
    return Target(**(values | changed))
