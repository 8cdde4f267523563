"""
A head start: the ways to machines are opened while the command that will use them is still being imported.

A machine's SSH server needs about as long to begin as this program needs for its libraries; begun first,
both happen at once. Only machines that are known from the last time (`remembered`) and named by a number
are begun with. Whatever fails here fails again, and is told, where the way is wanted.
"""

from __future__ import annotations

import errno
import os
import select
import socket
from collections.abc import Sequence

VERBS = ("ping", "exec", "up")
"""Commands that connect to every machine at once."""
WAYS_MAX = 64
SILENT = ("--help",)
INVENTORY = ("-i", "--inventory", "COSMOS_INVENTORY")
LIMIT = ("-l", "--limit", "COSMOS_LIMIT")

_ways: dict[tuple[str, int], socket.socket] = {}


def begin(arguments: Sequence[str]) -> None:
    """
    Begin to connect to the machines that a command line means, if they are known; waits for nothing.

    Args:
        arguments: What stands behind `cosmos`.
    """
    if not arguments or arguments[0] not in VERBS or any(word in arguments for word in SILENT):
        return
    inventory = option(arguments, INVENTORY)
    if not inventory:
        return
    # Imported here: commands that work on no fleet need none of it.
    from pathlib import Path

    from cosmos_cli.errors import CosmosError
    from cosmos_cli.fleet.remembered import key_of, recall
    from cosmos_cli.fleet.ssh_settings import settings_of

    targets = recall(key_of(Path(inventory), option(arguments, LIMIT))) or ()
    for target in targets[:WAYS_MAX]:
        try:
            settings = settings_of(target) if target.connection == "ssh" else None
        except (CosmosError, OSError):
            return  # told, with its place, by the command itself
        if settings is not None and not settings.jumps and settings.proxy_command is None:
            _begin_one(settings.host, settings.port)


def option(arguments: Sequence[str], names: tuple[str, str, str]) -> str | None:
    """Return an option's value: behind its short or long name, or of its variable; None if it has none."""
    short, long, variable = names
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        if word == "--":
            break
        if word in (short, long):
            return following
        if word.startswith(f"{long}="):
            return word.partition("=")[2]
    return os.environ.get(variable) or None


def take(host: str, port: int, *, timeout_s: float) -> socket.socket | None:
    """
    Return the way to a machine if it was begun, open; None if it was not.

    Raises:
        OSError: As connecting would.
    """
    way = _ways.pop((host, port), None)
    if way is None:
        return None
    try:
        poll = select.poll()
        poll.register(way, select.POLLOUT)
        if not poll.poll(timeout_s * 1e3):
            raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        number = way.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if number:
            raise OSError(number, os.strerror(number))
    except OSError:
        way.close()
        raise
    return way


def close() -> None:
    """Close what nobody took."""
    while _ways:
        _ways.popitem()[1].close()


def _begin_one(host: str, port: int) -> None:
    """Begin one way; a name is left to who may wait for its address."""
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
        _ways[host, port] = way
    else:
        way.close()
