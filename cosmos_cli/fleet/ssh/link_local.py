"""
This computer's link-local IPv6 address, as a machine sees it.

Such an address means something on one link alone: a program on the machine that connects to it has to name the
machine's own interface (`fe80::a%eth0`), and that only the machine knows.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from cosmos_cli.fleet.connection import SMALL_BYTES_MAX, Completed
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.fleet.shell import for_login_shell

QUESTION_TIMEOUT_S = 10.0
LINK_LOCAL = re.compile(r"fe[89ab][0-9a-f]:[0-9a-f:]*", re.IGNORECASE)
_SEEN = re.compile(r"(?P<address>[0-9A-Fa-f:]+)%(?P<interface>[A-Za-z0-9_.-]{1,15})")


def address_from(peer: str, *, own: str, at: str) -> str | None:
    """
    Return the address of one machine as another one must name it, None if it has none there.

    Args:
        peer: The address at which the first is reached from here.
        own: This computer's address as the other one sees it, as `address_as_seen` tells.
        at: The address at which the other one is reached from here.
    """
    address, _, link = peer.partition("%")
    if not LINK_LOCAL.fullmatch(address):
        return peer
    _, _, interface = own.partition("%")
    return f"{address}%{interface}" if interface and at.partition("%")[2] == link else None


def address_as_seen(own: str, run: Callable[..., Completed]) -> str:
    """
    Return an address of this computer with the machine's interface, if it is link-local, else as it is.

    Args:
        own: As this computer's end of the connection has it.
        run: Runs a command on the machine; one that does not tell leaves the address as it is.
    """
    if not LINK_LOCAL.fullmatch(own):
        return own
    try:
        said = run(
            for_login_shell('echo "$SSH_CONNECTION"'),
            timeout_s=QUESTION_TIMEOUT_S,
            said_bytes_max=SMALL_BYTES_MAX,
        ).stdout
    except MachineFailure:
        return own
    words = said.decode(errors="replace").strip().rpartition("\n")[2].split()
    seen = _SEEN.fullmatch(words[0]) if words else None
    return seen[0] if seen and seen["address"].lower() == own.lower() else own
