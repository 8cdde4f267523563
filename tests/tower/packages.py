"""A tiny apt repository on every board: with it `apt-get` really works, without any network."""

from __future__ import annotations

import hashlib
import subprocess
from dataclasses import dataclass, field
from pathlib import Path

INDEX = "Packages"
NEWER_INDEX = "Packages.newer"
"""The index of a repository in which a newer version has appeared."""
UNIT = """[Unit]
Description=A service to be enabled and started

[Service]
ExecStart=/bin/sleep infinity

[Install]
WantedBy=multi-user.target
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Package:
    """A package to be built: its files by path."""

    name: str
    version: str
    files: dict[str, str] = field(default_factory=dict)

    @property
    def file_name(self) -> str:
        return f"{self.name}_{self.version}_all.deb"

    @property
    def control(self) -> str:
        return (
            f"Package: {self.name}\nVersion: {self.version}\nArchitecture: all\n"
            "Maintainer: COSMoS tests <tests@localhost>\nPriority: optional\nSection: misc\n"
            "Description: package for tests of provisioning\n"
        )


def _hello(version: str) -> Package:
    script = f"#!/bin/sh\necho hello {version}\n"
    return Package(
        name="cosmos-test-hello", version=version, files={"usr/bin/cosmos-test-hello": script}
    )


HELLO, HELLO_NEWER = _hello("1.0"), _hello("1.1")
SERVICE = Package(
    name="cosmos-test-service",
    version="1.0",
    files={"lib/systemd/system/cosmos-test.service": UNIT},
)


def write_repository(folder: Path, scratch: Path) -> None:
    """Build the packages and both indexes into *folder*."""
    folder.mkdir(parents=True, exist_ok=True)
    old = _build(HELLO, folder, scratch) + _build(SERVICE, folder, scratch)
    (folder / INDEX).write_text(old)
    (folder / NEWER_INDEX).write_text(old + _build(HELLO_NEWER, folder, scratch))


def _build(package: Package, folder: Path, scratch: Path) -> str:
    """Build one package and return its entry in the index."""
    tree = scratch / f"{package.name}_{package.version}"
    for path, text in {**package.files, "DEBIAN/control": package.control}.items():
        target = tree / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text)
        target.chmod(0o755 if "/bin/" in path else 0o644)
    target = folder / package.file_name
    command = ["dpkg-deb", "--root-owner-group", "-Zgzip", "--build", str(tree), str(target)]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    content = target.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    place = f"Filename: ./{package.file_name}\nSize: {len(content)}\nSHA256: {digest}\n"
    return f"{package.control}{place}\n"
