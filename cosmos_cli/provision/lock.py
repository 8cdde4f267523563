"""
Exact content of an environment: every wheel by its hash, and what the distribution must bring. Pure.

`parse_pylock` and `choose` read what the resolver found; nothing here runs a program or opens a file.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any
from urllib.parse import unquote, urlsplit

from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from cosmos_cli.provision.platform import Platform, wheel_rank

KEY_CHARACTERS = 24
DISTRIBUTION_PACKAGES: Mapping[str, str] = {
    "gpiod": "python3-libgpiod",
    "lgpio": "python3-lgpio",
    "lxml": "python3-lxml",
    "matplotlib": "python3-matplotlib",
    "msgpack": "python3-msgpack",
    "numpy": "python3-numpy",
    "orjson": "python3-orjson",
    "pandas": "python3-pandas",
    "picamera2": "python3-picamera2",
    "pillow": "python3-pil",
    "psutil": "python3-psutil",
    "pyyaml": "python3-yaml",
    "rpi-gpio": "python3-rpi.gpio",
    "rtimulib": "python3-rtimulib",
    "scipy": "python3-scipy",
    "sgp4": "python3-sgp4",
    "smbus": "python3-smbus",
    "spidev": "python3-spidev",
}
"""The distribution's names of packages that often have no wheel for a board."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Locked:
    """One wheel of an environment."""

    name: str
    version: str
    sha256: str
    filename: str
    size_bytes: int = 0
    installed_bytes: int = 0
    """Bytes of its files, unpacked."""

    @property
    def dist_info(self) -> str:
        """Name of the folder in it that describes it."""
        return "-".join(self.filename.split("-")[:2]) + ".dist-info"


@dataclass(frozen=True, slots=True, kw_only=True)
class Distributed:
    """A Python package that the machine's own distribution brings, because there is no wheel."""

    name: str
    package: str
    """Name of the system package, such as python3-numpy."""
    specifier: str = ""
    """Versions that will do, such as >=1.24."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lock:
    """Content of an environment."""

    platform: Platform
    wheels: tuple[Locked, ...]
    distributed: tuple[Distributed, ...] = ()
    sees_system: bool = False
    """Whether the Python packages of the distribution can be imported in the environment."""

    @property
    def key(self) -> str:
        """Return the name of the environment: the same content, the same name, whoever made it and when."""
        content = {
            "python": self.platform.python,
            "machine": self.platform.machine,
            "wheels": sorted((w.name, w.version, w.sha256) for w in self.wheels),
            "distributed": sorted((d.name, d.package) for d in self.distributed),
            "sees_system": self.sees_system,
        }
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:KEY_CHARACTERS]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for the cache."""
        return asdict(self)

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Lock:
        """Read back what `to_mapping` wrote."""
        platform = mapping["platform"]
        return cls(
            platform=Platform(
                python=tuple(platform["python"]),
                machine=platform["machine"],
                libc_version=tuple(platform["libc_version"]),
            ),
            wheels=tuple(Locked(**wheel) for wheel in mapping["wheels"]),
            distributed=tuple(Distributed(**each) for each in mapping["distributed"]),
            sees_system=mapping["sees_system"],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class WheelLink:
    """A wheel that an index offers."""

    filename: str
    url: str
    sha256: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A package and version that the resolver decided on, and its wheels for all kinds of machines."""

    name: str
    version: str
    wheels: tuple[WheelLink, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Chosen:
    """A package whose wheel for a platform is known."""

    locked: Locked
    url: str = ""
    """Empty for one that was locked earlier: the index is asked for it by its hash."""


def normal_name(name: str) -> str:
    """Return a package's name as all spellings of it share it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def parse_pylock(text: str, platform: Platform) -> tuple[Candidate, ...]:
    """
    Read a pylock.toml (PEP 751); what its markers exclude from the platform is left out.

    Raises:
        ValueError: It is none.
    """
    environment = platform.marker_environment()
    return tuple(
        Candidate(
            name=normal_name(package["name"]),
            version=package.get("version", ""),
            wheels=tuple(filter(None, map(_link, package.get("wheels", ())))),
        )
        for package in tomllib.loads(text).get("packages", ())
        if not package.get("marker") or Marker(package["marker"]).evaluate(environment)
    )


def choose(
    candidates: Sequence[Candidate], platform: Platform
) -> tuple[tuple[Chosen, ...], tuple[Candidate, ...]]:
    """Return the best wheel of each package for a platform, and the packages that have none for it."""
    chosen, missing = [], []
    for candidate in candidates:
        ranked = [
            (rank, wheel.filename, wheel.url, wheel.sha256)
            for wheel in candidate.wheels
            if (rank := wheel_rank(wheel.filename, platform)) is not None
        ]
        if ranked:
            _, filename, url, sha256 = min(ranked)
            name, version = candidate.name, candidate.version
            locked = Locked(name=name, version=version, sha256=sha256, filename=filename)
            chosen.append(Chosen(locked=locked, url=url))
        else:
            missing.append(candidate)
    return tuple(chosen), tuple(missing)


def with_specifiers(
    distributed: Sequence[Distributed], requirements: Sequence[str], platform: Platform
) -> tuple[Distributed, ...]:
    """Return the same, each with all that *requirements* ask of its version."""
    asked: dict[str, SpecifierSet] = {}
    for requirement in map(Requirement, requirements):
        if platform.needs(requirement):
            name = normal_name(requirement.name)
            asked[name] = asked.get(name, SpecifierSet()) & requirement.specifier
    return tuple(replace(each, specifier=str(asked.get(each.name, ""))) for each in distributed)


def _link(wheel: Mapping[str, Any]) -> WheelLink | None:
    url = wheel.get("url") or wheel.get("path") or ""
    sha256 = wheel.get("hashes", {}).get("sha256")
    if not url or not sha256:
        return None
    filename = wheel.get("name") or unquote(urlsplit(url).path).rpartition("/")[2]
    return WheelLink(filename=filename, url=url, sha256=sha256)
