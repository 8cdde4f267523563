"""
Login at a machine: the inventory's values, then the operator's ssh configuration, then ssh's defaults.

COSMOS_SSH_CONFIG names a file that is read instead of ~/.ssh/config and /etc/ssh/ssh_config.
"""

from __future__ import annotations

import functools
import os
import re
import shlex
import threading
from dataclasses import dataclass
from pathlib import Path

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.ssh.config import Values, local_user, read_config
from cosmos_cli.fleet.ssh.known_hosts import SSH_PORT, names_of
from cosmos_cli.fleet.target import Target

CONFIG_VARIABLE = "COSMOS_SSH_CONFIG"
CONFIG_FILES = ("~/.ssh/config", "/etc/ssh/ssh_config")
USER_KNOWN_HOSTS = "~/.ssh/known_hosts ~/.ssh/known_hosts2"
GLOBAL_KNOWN_HOSTS = "/etc/ssh/ssh_known_hosts /etc/ssh/ssh_known_hosts2"
DEFAULT_KEYS = ("~/.ssh/id_ed25519", "~/.ssh/id_ecdsa", "~/.ssh/id_rsa")
JUMPS_MAX = 8
TAKES_UNKNOWN_KEYS = ("accept-new", "no", "off")
"""A changed key is refused whatever stands here."""

TIME_UNITS_S = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86_400, "w": 604_800}
"""Of ssh_config's TIME FORMATS."""
CONNECT_TIMEOUT_S_MAX = 65_535

_READING = threading.Lock()
# Without two ways to read one text: a long wrong one would be tried in all of them.
_TIME = re.compile(r"(?:[0-9]{1,9}[smhdw])+(?:[0-9]{1,9})?|[0-9]{1,9}", re.IGNORECASE)
_TIME_PART = re.compile(r"([0-9]+)([smhdw]?)", re.IGNORECASE)
_HOP = re.compile(
    r"(?:ssh://)?(?:(?P<user>[^@]+)@)?(?P<host>\[[^]]+\]|[^:@]+)(?::(?P<port>\d+))?/?"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SshSettings:
    """All that is decided before a connection is opened."""

    host: str
    port: int
    user: str
    names: tuple[str, ...]
    """Under which its host key is known."""
    key_files: tuple[Path, ...]
    """Private keys that were named for it, or the usual ones; none where what was named is `none`."""
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

    @property
    def where(self) -> str:
        """Return address and port in words."""
        return f"{self.host} port {self.port}"


def settings_of(target: Target) -> SshSettings:
    """
    Return how to log in at a machine.

    Raises:
        InputError: The ssh configuration cannot be read.
    """
    found = _lookup(target)

    def value(keyword: str, default: str = "") -> str:
        return found[keyword][0] if found.get(keyword) else default

    host = value("hostname", target.address)
    port = target.port or _number(value("port", str(SSH_PORT)), "Port")
    listed = [target.key_file] if target.key_file else list(found.get("identityfile", ()))
    named = [name for name in listed if name.lower() != "none"]
    command = value("proxycommand", "none")
    jump = "none" if _is_command_first(found) else value("proxyjump", "none")
    is_direct = jump.lower() == "none"
    timeout = value("connecttimeout", "none")
    return SshSettings(
        host=host,
        port=port,
        user=target.user or value("user") or local_user(),
        names=names_of(host, port, value("hostkeyalias")),
        key_files=tuple(map(_path, named if listed else DEFAULT_KEYS)),
        are_keys_named=bool(named),
        identities_only=bool(target.key_file) or value("identitiesonly").lower() == "yes",
        agent_socket=_agent_socket(value("identityagent", "SSH_AUTH_SOCK")),
        known_hosts=_files(
            value("userknownhostsfile", USER_KNOWN_HOSTS),
            value("globalknownhostsfile", GLOBAL_KNOWN_HOSTS),
        ),
        accepts_new_host_keys=value("stricthostkeychecking").lower() in TAKES_UNKNOWN_KEYS,
        hashes_known_hosts=value("hashknownhosts").lower() == "yes",
        jumps=() if is_direct else _jumps(target.name, jump),
        proxy_command=command if is_direct and command.lower() != "none" else None,
        connect_timeout_s=_timeout_s(timeout),
    )


def _is_command_first(found: Values) -> bool:
    """Tell whether a ProxyCommand, were it none, stands before every ProxyJump: as with ssh, the first of both counts."""
    ways = [keyword for keyword in found if keyword in ("proxyjump", "proxycommand")]
    return ways[:1] == ["proxycommand"]


def _timeout_s(text: str) -> int | None:
    """Return a ConnectTimeout as ssh reads it: seconds, or numbers with units (1m30s); none and 0 are no bound."""
    if text.lower() == "none":
        return None
    if not _TIME.fullmatch(text):
        raise InputError(
            f"ssh configuration: ConnectTimeout: expected a time such as 10 or 1m30s, got {text!r}"
        )
    parts = _TIME_PART.findall(text)
    seconds = sum(int(number) * TIME_UNITS_S[unit.lower()] for number, unit in parts)
    return min(seconds, CONNECT_TIMEOUT_S_MAX) or None


def _number(text: str, keyword: str) -> int:
    if not text.isdigit() or not 0 < int(text) < 65536:
        raise InputError(f"ssh configuration: {keyword}: expected a number, got {text!r}")
    return int(text)


def _lookup(target: Target) -> Values:
    """Return what the ssh configuration says; the inventory's user and port count as given to ssh itself."""
    named = os.environ.get(CONFIG_VARIABLE)
    files = [_path(name) for name in ([named] if named else CONFIG_FILES)]
    if named and not files[0].exists():
        raise InputError(f"{CONFIG_VARIABLE}: {named}: no such file")
    with _READING:
        configuration = _read(tuple(files))
    given = {"user": target.user, "port": str(target.port) if target.port else None}
    return configuration.lookup(target.address, {k: v for k, v in given.items() if v})


_read = functools.lru_cache(maxsize=8)(read_config)
"""Read the configuration once per process."""


def _jumps(name: str, value: str) -> tuple[Target, ...]:
    jumps = []
    for word in value.split(",")[:JUMPS_MAX]:
        match = _HOP.fullmatch(word.strip())
        if match is None:
            raise InputError(f"ProxyJump of {name}: expected [user@]host[:port], got {word!r}")
        address = match["host"].strip("[]")
        port = int(match["port"]) if match["port"] else None
        jumps.append(Target(name=address, address=address, user=match["user"], port=port))
    return tuple(jumps)


def _files(own: str, everybodys: str) -> tuple[Path, ...]:
    """Return the known_hosts files; own ones that are none stay as a place where nothing is recorded."""
    names = [os.devnull if name.lower() == "none" else name for name in shlex.split(own)]
    names += [name for name in shlex.split(everybodys) if name.lower() != "none"]
    return tuple(_path(name) for name in names)


def _path(name: str) -> Path:
    """Return a path; ~ of somebody whom nobody knows stays as it is, and leads nowhere."""
    return Path(os.path.expanduser(name))


def _agent_socket(wanted: str) -> str | None:
    if wanted == "SSH_AUTH_SOCK":
        return os.environ.get(wanted)
    if wanted.lower() == "none":
        return None
    if wanted.startswith("$"):
        return os.environ.get(wanted[1:])
    return os.path.expanduser(wanted)
