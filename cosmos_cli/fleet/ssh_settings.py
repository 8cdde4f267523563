"""
How to log in at a machine: the inventory's values, then the operator's ssh configuration, then ssh's defaults.

COSMOS_SSH_CONFIG names a file that is read instead of ~/.ssh/config and /etc/ssh/ssh_config.
"""

from __future__ import annotations

import functools
import getpass
import glob
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.known_hosts import SSH_PORT, names_of
from cosmos_cli.fleet.target import Target

CONFIG_VARIABLE = "COSMOS_SSH_CONFIG"
CONFIG_FILES = ("~/.ssh/config", "/etc/ssh/ssh_config")
USER_KNOWN_HOSTS = "~/.ssh/known_hosts ~/.ssh/known_hosts2"
GLOBAL_KNOWN_HOSTS = "/etc/ssh/ssh_known_hosts /etc/ssh/ssh_known_hosts2"
DEFAULT_KEYS = ("~/.ssh/id_ed25519", "~/.ssh/id_ecdsa", "~/.ssh/id_rsa")
INCLUDE_DEPTH_MAX = 16
JUMPS_MAX = 8
TAKES_UNKNOWN_KEYS = ("accept-new", "no", "off")
"""A changed key is refused whatever stands here."""

_INCLUDE = re.compile(r"\s*include(?:\s+|\s*=\s*)(.+)", re.IGNORECASE)
_SECTION = re.compile(r"\s*(?:host|match)(?:\s+|\s*=\s*)", re.IGNORECASE)
_HOP = re.compile(r"(?:ssh://)?(?:(?P<user>[^@]+)@)?(?P<host>\[[^]]+\]|[^:]+)(?::(?P<port>\d+))?/?")


@dataclass(frozen=True, slots=True, kw_only=True)
class SshSettings:
    """All that is decided before a connection is opened."""

    host: str
    port: int
    user: str
    names: tuple[str, ...]
    """Under which its host key is known."""
    key_files: tuple[Path, ...]
    """Private keys that were named for it, or the usual ones."""
    are_keys_named: bool
    """False when nobody named a key: then the ssh agent's come first."""
    identities_only: bool
    """Whether the ssh agent may offer named keys only."""
    agent_socket: str | None
    known_hosts: tuple[Path, ...]
    """The first is where unknown keys are recorded."""
    accepts_new_host_keys: bool
    hashes_known_hosts: bool
    jumps: tuple[Target, ...] = ()
    """Machines on the way, the nearest first."""
    proxy_command: str | None = None
    connect_timeout_s: float | None = None


def settings_of(target: Target) -> SshSettings:
    """
    Return how to log in at a machine.

    Raises:
        InputError: The ssh configuration cannot be read.
    """
    found = _lookup(target)
    host = str(found.get("hostname") or target.address)
    port = target.port or int(found.get("port", SSH_PORT))
    named = [target.key_file] if target.key_file else list(found.get("identityfile", ()))
    named = [name for name in named if name.lower() != "none"]
    command = found.get("proxycommand")
    jumps: tuple[Target, ...] = ()
    if (jump := found.get("proxyjump", "none")).lower() != "none":
        command, jumps = None, _jumps(target.name, jump)
    timeout = found.get("connecttimeout")
    return SshSettings(
        host=host,
        port=port,
        user=target.user or str(found.get("user") or getpass.getuser()),
        names=names_of(host, port, found.get("hostkeyalias")),
        key_files=tuple(Path(name).expanduser() for name in named or DEFAULT_KEYS),
        are_keys_named=bool(named),
        identities_only=bool(target.key_file) or found.get("identitiesonly", "no").lower() == "yes",
        agent_socket=_agent_socket(found.get("identityagent")),
        known_hosts=_known_hosts(found),
        accepts_new_host_keys=found.get("stricthostkeychecking", "ask").lower()
        in TAKES_UNKNOWN_KEYS,
        hashes_known_hosts=found.get("hashknownhosts", "no").lower() == "yes",
        jumps=jumps,
        proxy_command=command,
        connect_timeout_s=float(timeout) if timeout and timeout.isdigit() else None,
    )


def _lookup(target: Target) -> Mapping[str, Any]:
    """Return what the ssh configuration says; %p and %r in it are the inventory's port and user if given."""
    config = _configuration()
    if config is None:
        return {}
    options = {}
    if target.user:
        options["user"] = target.user
    if target.port:
        options["port"] = str(target.port)
    return _resolve(config, target.address, options)


def _resolve(config: Any, address: str, given: Mapping[str, str]) -> Mapping[str, Any]:
    from paramiko.config import SSHConfig, SSHConfigDict

    if given:
        first = {"host": ["*"], "config": dict(given)}
        overlaid = SSHConfig()
        overlaid._config = [first, *config._config]  # type: ignore[attr-defined]
        config = overlaid
    found: SSHConfigDict = config.lookup(address)
    return found


def _configuration() -> Any:
    """Return the parsed ssh configuration; None when there is none."""
    named = os.environ.get(CONFIG_VARIABLE)
    files = [Path(name).expanduser() for name in ([named] if named else CONFIG_FILES)]
    if named and not files[0].is_file():
        raise InputError(f"{CONFIG_VARIABLE}: {named}: no such file")
    there = [(str(file), file.stat().st_mtime_ns) for file in files if file.is_file()]
    return _parse(tuple(there)) if there else None


@functools.lru_cache(maxsize=8)
def _parse(files: tuple[tuple[str, int], ...]) -> Any:
    from paramiko.config import SSHConfig
    from paramiko.ssh_exception import ConfigParseError

    config = SSHConfig()
    for file, _ in files:
        try:
            config.parse(_lines(Path(file), 0))
        except (OSError, UnicodeDecodeError, ConfigParseError) as error:
            raise InputError(f"{file}: cannot be read as an ssh configuration: {error}") from error
    return config


def _lines(file: Path, depth: int) -> Iterator[str]:
    """Return a configuration's lines with those of the files it includes, which paramiko does not know."""
    section = "Host *\n"
    for line in file.read_text(encoding="utf-8").splitlines(keepends=True):
        if _SECTION.match(line):
            section = line
        included = _INCLUDE.fullmatch(line.rstrip())
        if included is None:
            yield line
            continue
        for name in included.group(1).split():
            path = os.path.expanduser(name.strip('"'))
            if not os.path.isabs(path):
                path = os.path.join(os.path.expanduser("~/.ssh"), path)
            for found in sorted(glob.glob(path)) if depth < INCLUDE_DEPTH_MAX else ():
                yield from _lines(Path(found), depth + 1)
        yield "\n" + section


def _jumps(name: str, value: str) -> tuple[Target, ...]:
    jumps = []
    for word in value.split(",")[:JUMPS_MAX]:
        match = _HOP.fullmatch(word.strip())
        if match is None:
            raise InputError(f"ProxyJump of {name}: expected [user@]host[:port], got {word!r}")
        port = match["port"]
        address = match["host"].strip("[]")
        jumps.append(
            Target(
                name=address, address=address, user=match["user"], port=int(port) if port else None
            )
        )
    return tuple(jumps)


def _known_hosts(found: Mapping[str, Any]) -> tuple[Path, ...]:
    names: Sequence[str] = [
        *found.get("userknownhostsfile", USER_KNOWN_HOSTS).split(),
        *found.get("globalknownhostsfile", GLOBAL_KNOWN_HOSTS).split(),
    ]
    return tuple(Path(name.strip('"')).expanduser() for name in names)


def _agent_socket(wanted: str | None) -> str | None:
    if wanted is None or wanted == "SSH_AUTH_SOCK":
        return os.environ.get("SSH_AUTH_SOCK")
    if wanted.lower() == "none":
        return None
    if wanted.startswith("$"):
        return os.environ.get(wanted[1:].strip("{}"))
    return os.path.expanduser(wanted)
