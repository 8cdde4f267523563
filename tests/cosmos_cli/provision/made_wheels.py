"""Wheels made by the test itself, and a folder of them as the only index: no network, a few kilobytes."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import tarfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from cosmos_cli.provision.lock import Lock, Locked
from cosmos_cli.provision.platform import greeted_platform
from cosmos_cli.provision.wheelhouse import Environment

MACHINES = ("x86_64", "aarch64")
RUNTIME = {
    "annotated-types": "py3-none-any",
    "msgpack": "cp{py}-cp{py}-manylinux_2_17_{machine}",
    "numpy": "cp{py}-cp{py}-manylinux_2_28_{machine}",
    "orjson": "cp{py}-cp{py}-manylinux_2_17_{machine}",
    "psutil": "cp36-abi3-manylinux_2_17_{machine}",
}
"""What the runtime needs, with the tags that its real wheels have."""


def make_wheel(
    folder: Path,
    name: str,
    version: str = "99.0",
    *,
    tag: str = "py3-none-any",
    files: Mapping[str, bytes] | None = None,
    requires: Sequence[str] = (),
    entry_points: str = "",
    record: Mapping[str, str] | None = None,
    wheel_version: str = "1.0",
) -> Path:
    """Write a wheel; *record* replaces hashes in its RECORD, to make it a wrong one."""
    module = name.replace("-", "_")
    info = f"{module}-{version}.dist-info"
    needs = "".join(f"Requires-Dist: {each}\n" for each in requires)
    content = {
        f"{module}/__init__.py": f"version = {version!r}\n".encode(),
        **(files or {}),
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n{needs}".encode(),
        f"{info}/WHEEL": f"Wheel-Version: {wheel_version}\nRoot-Is-Purelib: true\nTag: {tag}\n".encode(),
    }
    if entry_points:
        content[f"{info}/entry_points.txt"] = entry_points.encode()
    rows = []
    for path, data in content.items():
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
        rows.append(f"{path},{(record or {}).get(path, f'sha256={digest}')},{len(data)}\n")
    content[f"{info}/RECORD"] = "".join([*rows, f"{info}/RECORD,,\n"]).encode()
    folder.mkdir(parents=True, exist_ok=True)
    wheel = folder / f"{module}-{version}-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in content.items():
            archive.writestr(zipfile.ZipInfo(path, (2020, 1, 1, 0, 0, 0)), data)
    return wheel


class House:
    """A wheelhouse whose wheels are made as they are asked for."""

    def __init__(self, folder, greeting):
        self.folder = folder
        self.platform = greeted_platform(greeting)

    def environment(self, *wheels, **changes):
        locked = []
        for path in wheels:
            content = path.read_bytes()
            name, version = path.name.split("-")[:2]
            sha256 = hashlib.sha256(content).hexdigest()
            (self.folder / sha256).mkdir(parents=True, exist_ok=True)
            (self.folder / sha256 / path.name).write_bytes(content)
            locked.append(
                Locked(
                    name=name,
                    version=version,
                    sha256=sha256,
                    filename=path.name,
                    size_bytes=len(content),
                )
            )
        content = Lock(platform=self.platform, wheels=tuple(locked))
        return Environment(content=dataclasses.replace(content, **changes), wheels=self.folder)


def make_runtime_wheels(folder: Path, *pythons: str, machines: Sequence[str] = MACHINES) -> None:
    """Write stand-ins for all that the runtime needs, for these Pythons such as 311."""
    for name, tag in RUNTIME.items():
        tags = {tag.format(py=py, machine=machine) for py in pythons for machine in machines}
        for each in sorted(tags):
            make_wheel(folder, name, tag=each)


def make_source(folder: Path, name: str, version: str) -> None:
    """Write a source distribution, of which nothing can be built."""
    folder.mkdir(parents=True, exist_ok=True)
    top = f"{name.replace('-', '_')}-{version}"
    text = f"Metadata-Version: 2.2\nName: {name}\nVersion: {version}\n".encode()
    with tarfile.open(folder / f"{top}.tar.gz", "w:gz") as archive:
        for path, content in {"PKG-INFO": text, "setup.py": b"raise SystemExit(1)\n"}.items():
            member = tarfile.TarInfo(f"{top}/{path}")
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))


def only_index(monkeypatch, tmp_path: Path, folder: Path) -> None:
    """Make *folder* all that pip and uv see, as an operator without internet sets it for pip; caches are private."""
    for name in (
        "PIP_INDEX_URL",
        "PIP_EXTRA_INDEX_URL",
        "UV_INDEX",
        "UV_DEFAULT_INDEX",
        "UV_INDEX_URL",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(folder))
    monkeypatch.setenv("UV_CACHE_DIR", str(tmp_path / "uv"))
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
