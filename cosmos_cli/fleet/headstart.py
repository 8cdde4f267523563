"""
A head start: machines are spoken to while the command that wants them is still being imported.

A machine's SSH server needs about as long to begin, and to agree on keys, as this program needs for its
libraries; begun first, both happen at once. Only machines that are known from the last time (`remembered`)
and named by a number are begun with. Nothing is believed or told to a machine here: its host key is judged,
and a login tried, where the way is wanted. Whatever fails here fails again there, and is told.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cosmos_cli.fleet.ssh_settings import SshSettings
    from cosmos_cli.fleet.ssh_transport import SshTransport

VERBS = ("ping", "exec", "up")
"""Commands that connect to every machine at once, and leave nothing to be done here."""
WAYS_MAX = 64
SHORT = {"-i": "--inventory", "-l": "--limit", "-q": "--quiet"}
VARIABLES = {
    "--inventory": "COSMOS_INVENTORY",
    "--limit": "COSMOS_LIMIT",
    "--forks": "COSMOS_FORKS",
}
VALUED = (*VARIABLES, "--timeout", "--host")
FLAGS = ("--accept-new-host-keys", "--check", "--diff", "--json", "--quiet", "--sudo")
"""All options of these commands but --help: at another word nothing is begun, for it may mean anything."""

SWITCH_S = 0.02
"""How long a thread runs before others may: with two for each machine, Python's own 5 ms cost more than they
give. A thread that waits for a machine makes way at once all the same."""


@dataclass(slots=True)
class Way:
    """A way to a machine that was begun."""

    sock: socket.socket
    settings: SshSettings
    transport: SshTransport | None = None
    """What already agrees on keys over it."""


_ways: dict[tuple[str, int], Way] = {}


def begin(arguments: Sequence[str]) -> None:
    """
    Begin to connect to the machines that a command line means, if they are known; waits for nothing.

    Args:
        arguments: What stands behind `cosmos`.
    """
    said = options(arguments) if is_quick(arguments) else None
    if said is None or "--inventory" not in said:
        return
    # Imported here: commands that work on no fleet need none of it.
    from pathlib import Path

    from cosmos_cli.errors import CosmosError
    from cosmos_cli.fleet.pool import FORKS_DEFAULT
    from cosmos_cli.fleet.remembered import key_of, recall
    from cosmos_cli.fleet.ssh_settings import settings_of

    forks = said.get("--forks", str(FORKS_DEFAULT))
    # No machine waits for its turn with a connection that it would close some day.
    ways_max = min(int(forks), WAYS_MAX) if forks.isdecimal() else 0
    targets = recall(key_of(Path(said["--inventory"]), said.get("--limit"))) or ()
    for target in targets[:ways_max]:
        try:
            settings = settings_of(target) if target.connection == "ssh" else None
        except (CosmosError, OSError):
            return  # told, with its place, by the command itself
        if settings is not None and not settings.jumps and settings.proxy_command is None:
            _begin_one(settings)
    if _ways:
        with contextlib.suppress(ModuleNotFoundError):  # an agent's board has the base install only
            _speak()


def is_quick(arguments: Sequence[str]) -> bool:
    """Whether a command line is one of those that every millisecond is told of."""
    return bool(arguments) and arguments[0] in VERBS


def options(arguments: Sequence[str]) -> dict[str, str] | None:
    """
    Return the options of a command line by their long names, those of the environment included.

    As the command itself will read them: the last one counts, and what follows the first word of a
    command for the machines belongs to that. None for a line with any option that is not known here.
    """
    found = {name: os.environ[key] for name, key in VARIABLES.items() if os.environ.get(key)}
    words = iter(arguments[1:])
    for word in words:
        if word == "--" or (arguments[0] == "exec" and not word.startswith("-")):
            break
        if not word.startswith("-"):
            continue
        is_long = word.startswith("--")
        name, equals, value = word.partition("=") if is_long else (word[:2], "", word[2:])
        name = SHORT.get(name, name)
        if name in FLAGS and not (equals or value):
            continue
        found[name] = value if equals or value else next(words, "")
        if name not in VALUED or not found[name]:
            return None
    return found


def take(host: str, port: int, *, timeout_s: float) -> Way | None:
    """
    Return the way to a machine if it was begun, open; None if it was not.

    Raises:
        OSError: As connecting would.
    """
    way = _ways.pop((host, port), None)
    if way is None:
        return None
    if way.transport is not None:
        if way.transport.is_active():
            return way
        way.transport.close()
        way.sock.close()
        return None  # what ended it is told by the next attempt, if it is still so
    try:
        poll = select.poll()
        poll.register(way.sock, select.POLLOUT)
        if not poll.poll(timeout_s * 1e3):
            raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        number = way.sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if number:
            raise OSError(number, os.strerror(number))
    except OSError:
        way.sock.close()
        raise
    return way


def close() -> None:
    """Close what nobody took."""
    while _ways:
        way = _ways.popitem()[1]
        if way.transport is not None:
            way.transport.close()
        way.sock.close()


def _begin_one(settings: SshSettings) -> None:
    """Begin one way; a name is left to who may wait for its address."""
    host, port = settings.host, settings.port
    try:
        numeric = socket.AI_NUMERICHOST
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=numeric
        )[0]
        way = socket.socket(family, kind, protocol)
    except OSError:
        return
    way.setblocking(False)
    if way.connect_ex(address) in (0, errno.EINPROGRESS) and (host, port) not in _ways:
        _ways[host, port] = Way(way, settings)
    else:
        way.close()


def _speak() -> None:
    """Let every machine that is connected by now agree on keys, in a thread of its own."""
    from cosmos_cli.fleet.known_hosts import KnownHosts
    from cosmos_cli.fleet.ssh_transport import make_transport
    from cosmos_cli.fleet.wire import tcp_wire

    sys.setswitchinterval(SWITCH_S)
    poll = select.poll()
    for way in _ways.values():
        poll.register(way.sock, select.POLLOUT)
    connected = {number for number, happened in poll.poll(0) if happened == select.POLLOUT}
    for way in _ways.values():
        if way.sock.fileno() in connected:
            with contextlib.suppress(OSError):
                kinds = KnownHosts(way.settings.known_hosts).kinds(way.settings.names)
                transport = make_transport(tcp_wire(way.sock), kinds)
                transport.begin()
                way.transport = transport
