"""Ports for servers of tests."""

from __future__ import annotations

import random
import socket

BELOW_EPHEMERAL = range(20_000, 32_000)
"""Linux gives these to nobody who does not ask: a port taken here stays free until its server starts."""
TRIES = 100


def free_port(address: str = "127.0.0.1", kind: int = socket.SOCK_STREAM) -> int:
    """Return a port on which nobody listens, another one in each process that asks."""
    for port in random.SystemRandom().sample(BELOW_EPHEMERAL, TRIES):
        with socket.socket(type=kind) as sock:
            try:
                sock.bind((address, port))
            except OSError:
                continue
            return port
    raise RuntimeError(f"{address}: none of {TRIES} ports is free")
