"""Prepares a tower: takes an index and a network, and builds layers, disks and boards in private mounts."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from . import cleaning, kernel, pretend, roots
from .base import USER, write_base, write_python
from .board import Board, Surroundings
from .disk import Disk, list_loop_devices, make_template
from .keys import KeyPair, generate_key
from .layer import Layer
from .network import Network, NetworkError, check_network, find_network
from .packages import write_repository
from .places import TOWERS_MAX, Places, lock
from .specification import NATIVE, BoardSpec, TowerSpec

TEMPLATE = "template"


def claim(network: str | None, index: int | None) -> tuple[Places, Network, int]:
    """
    Take a free index and network.

    Args:
        network: The wanted one; None takes that of the index.
        index: The wanted one; None takes the first that is free, with a network that is free.

    Returns:
        The tower's places, its network, and the descriptor that owns the index.

    Raises:
        NetworkError: The wanted network is in use, or none is free.
    """
    wanted = check_network(network) if network else None
    for number in range(TOWERS_MAX) if index is None else (index,):
        places = Places(number)
        owner = lock(places)
        if owner is None:
            continue
        if any(places.folder.iterdir()):  # left by a tower whose guardian was killed, too
            cleaning.clean(places)
            os.close(owner)
            owner = lock(places)
            if owner is None:
                continue
        free = wanted or find_network(number)
        if free is not None:
            places.loops.write_text(json.dumps(sorted(list_loop_devices())))
            return places, free, owner
        places.remove()
        os.close(owner)
    if index is not None:
        raise NetworkError(
            f"tower {index} runs already, or its network is in use; leave out --tower"
        )
    raise NetworkError(f"no free network among {TOWERS_MAX}; `python -m tests.tower status`")


def make_boards(
    spec: TowerSpec, places: Places, network: Network, groups: Path
) -> dict[str, Board]:
    """Build everything that boards stand on, and the boards, switched off."""
    private = places.private
    private.mkdir()
    kernel.mount("tower", private, "tmpfs", kernel.MS_NOATIME, "mode=700,size=100%")
    places.logs.mkdir()
    roots.register_emulators([board.arch for board in spec.boards])
    user_key = generate_key("cosmos-tower")
    places.key.touch(mode=0o600)
    places.key.write_text(user_key.private)
    places.key.with_suffix(".pub").write_text(user_key.public + "\n")
    layers = _Layers(private, user_key.public)
    pretend.write_sys(private / "sys")
    pretend.write_settings(private / "settings")
    template = private / TEMPLATE
    make_template(template, spec.disk_mib)
    boards = {}
    keys = {board.name: generate_key(board.name) for board in spec.boards}
    addresses = {
        board.name: network.address(number) for number, board in enumerate(spec.boards, start=1)
    }
    for number, board in enumerate(spec.boards, start=1):
        boards[board.name] = Board(
            number,
            board,
            network=network,
            disk=Disk(private / f"{board.name}.img", private / "disk" / board.name),
            surroundings=Surroundings(
                lowers=layers.of(board),
                sys_layer=private / "sys",
                settings_layer=private / "settings",
                cgroup=groups / board.name,
                log=places.logs / f"{board.name}.log",
            ),
            identity=_describe(board.name, keys[board.name], addresses),
        )
        boards[board.name].flash(template)
    _write_operator_files(places, keys, addresses)
    return boards


class _Layers:
    """The read-only layers, each built when the first board needs it."""

    def __init__(self, folder: Path, public_key: str) -> None:
        self._folder = folder
        self._public_key = public_key
        self._built: dict[tuple[str, str], tuple[Path, ...]] = {}

    def of(self, board: BoardSpec) -> tuple[Path, ...]:
        """Return the layers below a board's disk, topmost first."""
        wanted = (board.arch, board.python)
        if wanted not in self._built:
            self._built[wanted] = self._build(board)
        return self._built[wanted]

    def _build(self, board: BoardSpec) -> tuple[Path, ...]:
        lower = Path("/") if board.arch == NATIVE else roots.ensure_root(board.arch)
        if board.python == "real":
            base = Layer(self._folder / f"base-{board.arch}", lower)
            write_base(base, self._public_key)
            repository = base.folder / "opt/cosmos-test-repo"
            write_repository(repository, self._folder / f"packages-{board.arch}")
            return (base.folder, lower)
        below = self.of(BoardSpec(name=board.name, arch=board.arch))
        layer = Layer(self._folder / f"python-{board.arch}-{board.python}", lower)
        write_python(layer, board.python)
        return (layer.folder, *below)


def _describe(name: str, key: KeyPair, addresses: Mapping[str, str]) -> dict[str, tuple[str, int]]:
    """Return the files that tell a board from the others: content and mode by path."""
    hosts = "".join(f"{address} {other}\n" for other, address in addresses.items())
    return {
        "etc/hostname": (f"{name}\n", 0o644),
        "etc/hosts": (f"127.0.0.1 localhost\n127.0.1.1 {name}\n{hosts}", 0o644),
        "etc/machine-id": (os.urandom(16).hex() + "\n", 0o644),
        "etc/ssh/ssh_host_ed25519_key": (key.private, 0o600),
        "etc/ssh/ssh_host_ed25519_key.pub": (f"{key.public}\n", 0o644),
    }


def _write_operator_files(
    places: Places, keys: Mapping[str, KeyPair], addresses: Mapping[str, str]
) -> None:
    """Give the operator the means to know the boards and to reach them, with nothing of a user's own."""
    known, config = [], []
    for name, address in addresses.items():
        known.append(f"{address},{name} {' '.join(keys[name].public.split()[:2])}\n")
        config.append(f"Host {name}\n    HostName {address}\n")
    places.known_hosts.write_text("".join(known))
    settings = {
        "User": USER,
        "IdentityFile": places.key,
        "IdentitiesOnly": "yes",
        "IdentityAgent": "none",
        "UserKnownHostsFile": places.known_hosts,
        "GlobalKnownHostsFile": "/dev/null",
        "StrictHostKeyChecking": "yes",
        "PasswordAuthentication": "no",
    }
    config.append("Host *\n" + "".join(f"    {name} {value}\n" for name, value in settings.items()))
    places.ssh_config.write_text("".join(config))
