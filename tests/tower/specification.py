"""What a tower is made of, before any of it exists. Pure."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

BOARDS_MAX = 250
NATIVE = "native"
"""A board whose lower layer is this computer's own system."""
ARCHITECTURES = (NATIVE, "amd64", "arm64", "armhf")
PYTHONS = ("real", "old", "none")


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSpec:
    """
    One board to be made.

    Args:
        name: Host name, at most 32 letters, digits and dashes.
        arch: `native`, or a Debian architecture whose root is built once (see roots.py).
        python: `real`, `old` (its only python3 says 3.9) or `none`.
    """

    name: str
    arch: str = NATIVE
    python: str = "real"

    def __post_init__(self) -> None:
        letters = self.name.replace("-", "")
        if not (letters.isascii() and letters.isalnum() and len(self.name) <= 32):
            raise ValueError(f"board name: expected letters, digits and dashes, got {self.name!r}")
        if self.arch not in ARCHITECTURES:
            raise ValueError(f"{self.name}: arch is one of {ARCHITECTURES}, got {self.arch!r}")
        if self.python not in PYTHONS:
            raise ValueError(f"{self.name}: python is one of {PYTHONS}, got {self.python!r}")

    def to_mapping(self) -> dict[str, str]:
        """Return it as plain data."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerSpec:
    """
    A tower to be made.

    Args:
        boards: In the order of their addresses.
        boot_delay_s: Time between a board's going away in a reboot and the start of its next boot.
        disk_mib: Size of each board's disk; only what is written takes memory.
        network: `10.77`: the first two numbers of its /16; None takes the one of the index.
        index: Which of the computer's towers this is; None takes the first that is free.
    """

    boards: Sequence[BoardSpec]
    boot_delay_s: float = 1.0
    disk_mib: int = 1024
    network: str | None = None
    index: int | None = None

    def __post_init__(self) -> None:
        names = [board.name for board in self.boards]
        if not 1 <= len(names) <= BOARDS_MAX:
            raise ValueError(f"expected 1 to {BOARDS_MAX} boards, got {len(names)}")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"board named twice: {', '.join(twice)}")
        if self.disk_mib < 64:
            raise ValueError(f"disk: expected at least 64 MiB, got {self.disk_mib}")

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> TowerSpec:
        """Read what `to_mapping` wrote."""
        boards = tuple(BoardSpec(**board) for board in mapping["boards"])
        return cls(**{**mapping, "boards": boards})


def name_boards(count: int, arch: str = NATIVE) -> tuple[BoardSpec, ...]:
    """Return specifications of *count* alike boards: pi01, pi02, ... or arm64-01, ..."""
    prefix = "pi" if arch == NATIVE else f"{arch}-"
    return tuple(
        BoardSpec(name=f"{prefix}{number:02d}", arch=arch) for number in range(1, count + 1)
    )


def debian_architecture() -> str:
    """Return Debian's name of this computer's architecture."""
    machine = platform.machine()
    return {"x86_64": "amd64", "aarch64": "arm64", "armv7l": "armhf"}.get(machine, machine)
