"""Prepares a tower: takes an index and a network, and builds layers, disks and boards in private mounts."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from . import cleaning, kernel, pretend, roots
from .base import write_base, write_python
from .board import Board, Surroundings
from .disk import Disk, make_template
from .keys import generate_key
from .layer import Layer
from .network import Network, NetworkError, check_network, find_network
from .packages import write_repository
from .places import TOWERS_MAX, Places, lock
from .specification import NATIVE, BoardSpec, TowerSpec


def claim(network: str | None) -> tuple[Places, Network, int]:
    """
    Take a free index and network.

    Args:
        network: The wanted one; None takes that of the index.

    Returns:
        The tower's places, its network, and the descriptor that owns the index.

    Raises:
        NetworkError: The wanted network is in use, or none is free.
    """
    wanted = check_network(network) if network else None
    for index in range(TOWERS_MAX):
        places = Places(index)
        owner = lock(places)
        if owner is None:
            continue
        if any(places.folder.iterdir()):  # left by a tower whose guardian was killed, too
            cleaning.clean(places)
            os.close(owner)
            owner = lock(places)
            if owner is None:
                continue
        free = wanted or find_network(index)
        if free is not None:
            return places, free, owner
        places.remove()
        os.close(owner)
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
    make_template(private / "template", spec.disk_mib)
    boards = {}
    for number, board in enumerate(spec.boards, start=1):
        disk = Disk(private / f"{board.name}.img", private / "disk" / board.name)
        disk.create(private / "template")
        surroundings = Surroundings(
            lowers=layers.of(board),
            sys_layer=private / "sys",
            settings_layer=private / "settings",
            cgroup=groups / board.name,
            log=places.logs / f"{board.name}.log",
        )
        boards[board.name] = Board(
            number, board, network=network, disk=disk, surroundings=surroundings
        )
    _write_identities(boards, places)
    return boards


def write_state(places: Places, state: dict[str, Any], boards: dict[str, Board]) -> None:
    """Write down what a cleaner needs after the supervisor was killed."""
    del boards
    places.state.write_text(json.dumps({**state, "loops_added": []}, indent=1))


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


def _write_identities(boards: dict[str, Board], places: Places) -> None:
    """Give every board a name and a host key, and the operator the means to reach and know them."""
    known, config = [], []
    hosts = "".join(f"{board.address} {name}\n" for name, board in boards.items())
    for name, board in boards.items():
        key = generate_key(name)
        board.disk.mount()
        upper = Layer(board.disk.mount_point / "upper", board.surroundings.lowers[-1])
        upper.add("etc/hostname", name + "\n")
        upper.add("etc/hosts", f"127.0.0.1 localhost\n127.0.1.1 {name}\n{hosts}")
        upper.add("etc/machine-id", os.urandom(16).hex() + "\n")
        upper.add("etc/ssh/ssh_host_ed25519_key", key.private, 0o600)
        upper.add("etc/ssh/ssh_host_ed25519_key.pub", key.public + "\n")
        board.disk.release()
        known.append(f"{board.address},{name} {' '.join(key.public.split()[:2])}\n")
        config.append(f"Host {name}\n    HostName {board.address}\n")
    places.known_hosts.write_text("".join(known))
    config.append(
        f"Host *\n    User pi\n    IdentityFile {places.key}\n    IdentitiesOnly yes\n"
        f"    IdentityAgent none\n    UserKnownHostsFile {places.known_hosts}\n"
        "    GlobalKnownHostsFile /dev/null\n    StrictHostKeyChecking yes\n    PasswordAuthentication no\n"
    )
    places.ssh_config.write_text("".join(config))
