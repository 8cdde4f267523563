"""
Platform of a machine's interpreter: the architecture, the Python and the C library of a wheel. Pure.

Boards have no internet, so wheels are chosen here, for there.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from packaging import tags
from packaging.requirements import Requirement
from packaging.utils import InvalidWheelFilename, parse_wheel_filename

from cosmos_cli.fleet.failure import FailureKind, MachineFailure

MACHINES = ("x86_64", "aarch64", "armv7l", "armv6l")
"""Architectures that boards have; the last two are 32-bit ARM."""
INTERPRETER_MACHINES: Mapping[bool, Mapping[str, str]] = {
    True: {"x86_64": "x86_64", "amd64": "x86_64", "aarch64": "aarch64", "arm64": "aarch64"},
    False: {
        "armv6l": "armv6l",
        **dict.fromkeys(("armv7l", "armv8l", "aarch64", "arm64"), "armv7l"),
    },
}
"""The architecture of 64-bit interpreters, and of others, by what the kernel calls itself."""
LIBC_MAJOR = 2
LIBC_MINOR_MIN = {"x86_64": 5, "aarch64": 17, "armv7l": 17, "armv6l": 17}
"""The oldest glibc that wheels of an architecture were ever made for."""
LEGACY_TAGS = {17: "manylinux2014", 12: "manylinux2010", 5: "manylinux1"}
RESOLVER_LIBC_MINORS = (17, 28, *range(31, 41))
"""The glibc versions that uv knows as platforms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Platform:
    """Platform that wheels are to run on."""

    python: tuple[int, int]
    machine: str
    """One of `MACHINES`: the interpreter's architecture, which may be less than the kernel can."""
    libc_version: tuple[int, int]

    @property
    def label(self) -> str:
        """Return it in words."""
        libc = ".".join(map(str, self.libc_version))
        return f"Python {self.python_text} on {self.machine} (glibc {libc})"

    @property
    def python_text(self) -> str:
        """Return the version of Python, such as 3.11."""
        return ".".join(map(str, self.python))

    @property
    def is_32_bit(self) -> bool:
        """Whether it is 32-bit ARM, for which few wheels are made."""
        return self.machine.startswith("armv")

    @property
    def resolver_name(self) -> str | None:
        """Return uv's name of the platform; None for one that uv does not know."""
        if self.is_32_bit:
            return None
        minors = [minor for minor in RESOLVER_LIBC_MINORS if minor <= self.libc_version[1]]
        return f"{self.machine}-manylinux_{LIBC_MAJOR}_{minors[-1] if minors else 17}"

    def platform_tags(self) -> tuple[str, ...]:
        """Return the platform tags of the wheels that run there, best first."""
        tags = []
        for minor in range(self.libc_version[1], LIBC_MINOR_MIN[self.machine] - 1, -1):
            tags.append(f"manylinux_{LIBC_MAJOR}_{minor}_{self.machine}")
            if minor in LEGACY_TAGS:
                tags.append(f"{LEGACY_TAGS[minor]}_{self.machine}")
        return (*tags, f"linux_{self.machine}")

    def needs(self, requirement: Requirement, *, extra: str = "") -> bool:
        """Tell whether a requirement's marker, if it has one, holds there."""
        marker = requirement.marker
        return marker is None or marker.evaluate({**self.marker_environment(), "extra": extra})

    def marker_environment(self) -> dict[str, str]:
        """Return what the markers of requirements are judged by there."""
        return {
            "implementation_name": "cpython",
            "implementation_version": f"{self.python_text}.0",
            "os_name": "posix",
            "platform_machine": self.machine,
            "platform_python_implementation": "CPython",
            "platform_release": "",
            "platform_system": "Linux",
            "platform_version": "",
            "python_full_version": f"{self.python_text}.0",
            "python_version": self.python_text,
            "sys_platform": "linux",
            "extra": "",
        }


def platform_of(*, python: Sequence[int], machine: str, bits: int, libc: str) -> Platform:
    """
    Return the platform of a machine from its facts.

    Args:
        python: Version of its interpreter, such as (3, 11, 2).
        machine: What its kernel calls itself (uname -m).
        bits: Of its interpreter: a 64-bit kernel often carries a 32-bit system on a Raspberry Pi.
        libc: What its C library calls itself, such as "glibc 2.36".

    Raises:
        MachineFailure: UNSUPPORTED: there are no wheels for such a machine.
    """
    version = re.fullmatch(rf"glibc {LIBC_MAJOR}\.(\d+)(?:\..*)?", libc)
    if version is None:
        raise MachineFailure(
            FailureKind.UNSUPPORTED,
            f"expected a system with the GNU C library, found {libc or 'another one'}",
            "use a distribution such as Raspberry Pi OS, Debian or Ubuntu there",
        )
    own = INTERPRETER_MACHINES[bits == 64].get(machine)
    if own is None:
        raise MachineFailure(
            FailureKind.UNSUPPORTED,
            f"expected a machine of {', '.join(MACHINES)}, found {machine} with a {bits}-bit Python",
            "install a 64-bit system there" if machine in MACHINES else "",
        )
    return Platform(
        python=(python[0], python[1]),
        machine=own,
        libc_version=(LIBC_MAJOR, int(version[1])),
    )


def greeted_platform(greeting: Mapping[str, Any]) -> Platform:
    """
    Return the platform of a machine from what it said of itself when a `Board` was started there.

    Raises:
        MachineFailure: UNSUPPORTED: there are no wheels for such a machine.
    """
    return platform_of(
        python=[int(part) for part in str(greeting["python"]).split(".")[:2]],
        machine=str(greeting["machine"]),
        bits=int(greeting["bits"]),
        libc=str(greeting["libc"]),
    )


@functools.lru_cache
def wheel_tags(platform: Platform) -> dict[str, int]:
    """Return every tag of the wheels that run on a platform, each with its rank: the lowest is best."""
    platforms = platform.platform_tags()
    found = [str(t) for t in tags.cpython_tags(platform.python, platforms=platforms)]
    interpreter = f"cp{platform.python[0]}{platform.python[1]}"
    found += [str(t) for t in tags.compatible_tags(platform.python, interpreter, platforms)]
    return {tag: rank for rank, tag in reversed(list(enumerate(found)))}


def wheel_rank(filename: str, platform: Platform) -> int | None:
    """Return how well a wheel suits a platform, the lowest best; None when it does not run there."""
    try:
        tags = parse_wheel_filename(filename)[3]
    except InvalidWheelFilename:
        return None
    ranks = [rank for tag in tags if (rank := wheel_tags(platform).get(str(tag))) is not None]
    return min(ranks, default=None)
