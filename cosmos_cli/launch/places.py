"""Where the parts of a run live on their machines, and by which address each reaches the host. Pure."""

from __future__ import annotations

import dataclasses
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass

from madns_runtime.config import RunConfig

ANY_ADDRESSES = ("0.0.0.0", "::", "")
LOOPBACK = "127.0.0.1"

SYNC_INTERVAL_S = 5.0
"""Boards lose their power more often than computers do, and their kernel keeps writes back for half a minute."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """What one machine's launch says differently from the operator's own."""

    directory: str
    """The run's, there."""
    base_directory: str | None = None
    """The scenario's folder there; None for as on this computer."""
    cpu_affinity: tuple[int, ...] = ()
    """Processors for the agents; empty for what the scenario says."""
    host_address: str | None = None
    """How it reaches the host; None for where the host says that it listens."""


def config_at(config: RunConfig, place: Place) -> RunConfig:
    """Return what the processes of a run are told at *place*."""
    if place.cpu_affinity:
        scheduling = dataclasses.replace(config.scheduling, cpu_affinity=place.cpu_affinity)
        config = dataclasses.replace(config, scheduling=scheduling)
    if place.base_directory is not None:
        config = dataclasses.replace(config, base_directory=place.base_directory)
        if config.recording.sync_interval_s is None:
            recording = dataclasses.replace(config.recording, sync_interval_s=SYNC_INTERVAL_S)
            config = dataclasses.replace(config, recording=recording)
    return config


def listening_config(config: RunConfig, reached_by: Iterable[str]) -> RunConfig:
    """
    Return the configuration of a host that other machines must reach.

    A scenario that names an address means it. One that does not, or names the loopback, which no other
    machine could reach, has the host listen on all.

    Args:
        config: The run's.
        reached_by: Addresses by which agents will reach the host.
    """
    if says_address(config):
        return config
    is_six = any(":" in address for address in reached_by)
    network = dataclasses.replace(config.network, address="::" if is_six else "0.0.0.0")
    return dataclasses.replace(config, network=network)


def says_address(config: RunConfig) -> bool:
    """Tell whether the scenario names an address that other machines can be told."""
    address = config.network.address
    if address in ANY_ADDRESSES:
        return False
    try:
        return not ipaddress.ip_address(address).is_loopback
    except ValueError:
        return address != "localhost"


def expanded(path: str, home: str) -> str:
    """Return a path of a machine with ~ resolved, as that machine's shell would."""
    if path == "~" or path.startswith("~/"):
        return home.rstrip("/") + path[1:]
    return path
