"""The tests' own home: no key, agent, known_hosts or ssh configuration of whoever runs them is touched."""

from __future__ import annotations

from pathlib import Path

import pytest
from ssh_harness import needs_sshd, write_configuration
from sshd import Sshd


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """A private home, and an ssh configuration that names its known_hosts."""
    folder = tmp_path / "home"
    (folder / ".ssh").mkdir(parents=True, mode=0o700)
    configuration = folder / ".ssh" / "config"
    write_configuration(configuration)
    monkeypatch.setenv("HOME", str(folder))
    monkeypatch.setenv("COSMOS_SSH_CONFIG", str(configuration))
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    for name in ("SSH_AUTH_SOCK", "COSMOS_INVENTORY", "COSMOS_LIMIT", "COSMOS_FORKS"):
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def known_hosts(home) -> Path:
    return home / ".ssh" / "known_hosts"


@pytest.fixture(scope="module")
def sshd(tmp_path_factory):
    """One real server for a module's tests, with a key of each kind."""
    needs_sshd()
    with Sshd(tmp_path_factory.mktemp("sshd"), kinds=("ed25519", "ecdsa", "rsa")) as server:
        yield server


@pytest.fixture
def own_sshd(tmp_path):
    """A server for one test, which may hurt it."""
    needs_sshd()
    with Sshd(tmp_path / "sshd") as server:
        yield server


@pytest.fixture
def known(sshd, known_hosts):
    """The module's server, its key known."""
    known_hosts.write_text(sshd.known_hosts_line(), encoding="utf-8")
    return sshd
