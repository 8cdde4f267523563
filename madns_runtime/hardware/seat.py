"""A device's place on its machine: what its process, the agents and the guardian share of it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import MachineError
from madns_runtime.hardware.contract import Channel, Device
from madns_runtime.hardware.page import DevicePage


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceSeat:
    """A device's place on its machine: what it shares with others, made before the forks."""

    launch: DeviceLaunch
    make: Callable[[], Device]
    """Makes the driver."""
    channels: tuple[Channel, ...]
    page: DevicePage
    users: Mapping[str, socket.socket]
    """The device's ends of the pairs that it shares with agents, by agent."""
    claims: frozenset[int] = frozenset()
    """Descriptors of the claims on it, which each process keeps that may open it."""

    def check_identity(self, identity: str) -> None:
        """
        Refuse another device in this one's place.

        Raises:
            MachineError: It is not the one that the inventory names.
        """
        expected = self.launch.serial
        if expected and identity != expected:
            raise MachineError(f"expected the device {expected!r}, found {identity!r}")
