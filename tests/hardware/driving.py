"""Drivers called by hand, as a device's process calls them."""

from __future__ import annotations

import contextlib
import select
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from madns_runtime.hardware.contract import Sample
from madns_runtime.hardware.kind_registry import prepare


@contextlib.contextmanager
def opened(
    kind: str, folder: Path = Path(), *, may_move: bool = True, **parameters: Any
) -> Iterator[Any]:
    """Make and open a device of a kind, and close it at the end."""
    device = prepare(kind, parameters, folder).make()
    device.may_move = may_move
    try:
        device.identity = device.open()
        yield device
    finally:
        device.close()


def frames(device: Any, count: int, channel: str = "received", timeout_s: float = 120.0) -> list:
    """Return so many frames, waiting on the device's descriptor as its process does."""
    found: list = []
    until_s = time.monotonic() + timeout_s
    while len(found) < count:
        sample = device.read()
        if isinstance(sample, Sample):
            found.append(sample.values[channel])
        else:
            left_s = until_s - time.monotonic()
            assert left_s > 0, f"got {found} within {timeout_s:g} s"
            select.select([device.fileno()], [], [], left_s)
    return found
