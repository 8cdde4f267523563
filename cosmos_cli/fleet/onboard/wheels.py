"""
Installs wheels on a machine with nothing but the standard library.

Follows the PyPA specification of the binary distribution format: what RECORD says is verified, data folders
go where they belong, entry points become programs. Measured: as quick as uv, with nothing to send first.
"""

from __future__ import annotations

import base64
import configparser
import csv
import hashlib
import io
import os
import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

from cosmos_cli.fleet.onboard.core import Refusal

WHEEL_VERSION_MAJOR = "1"
INSTALLER = b"cosmos\n"
LOCAL_HEADER = struct.Struct("<4s22xHH")
LOCAL_SIGNATURE = b"PK\x03\x04"
IS_ENCRYPTED = 1
PROGRAM_MODE, FILE_MODE = 0o755, 0o644
DATA_FOLDERS = ("purelib", "platlib", "scripts", "headers", "data")
MODULE = re.compile(r"[A-Za-z_][\w.]*")
SCRIPT = """#!{python}
import sys
from {module} import {start}

if __name__ == "__main__":
    sys.exit({call}())
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """An environment that wheels are installed into."""

    top: str
    """Its folder, under its final name."""
    python: str
    """Its interpreter, for programs."""
    python_version: str
    """Such as 3.11."""

    @property
    def site(self) -> str:
        """Folder that modules are imported from."""
        return os.path.join(self.top, f"lib/python{self.python_version}/site-packages")

    def folder(self, scheme: str, name: str) -> str:
        """Return where a part of a wheel's data folder goes, one of `DATA_FOLDERS`."""
        folders = {
            "purelib": self.site,
            "platlib": self.site,
            "scripts": os.path.join(self.top, "bin"),
            "headers": os.path.join(self.top, f"include/site/python{self.python_version}", name),
            "data": self.top,
        }
        return folders[scheme]


class Wheel:
    """
    A wheel that is about to be installed; its whole content is verified already.

    Args:
        path: The file.
    """

    def __init__(self, path: str) -> None:
        self._name = os.path.basename(path)
        self._file = open(path, "rb")  # noqa: SIM115 - closed by `close`
        try:
            self._zip = ZipFile(self._file)
        except BadZipFile as error:
            self._file.close()
            raise Refusal("data", f"{self._name}: {error}") from None
        self._entries = {entry.filename: entry for entry in self._zip.infolist()}
        self._info = self._find_info()
        self._made: set[str] = set()

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def install(self, place: Place) -> list[str]:
        """
        Unpack it, and return the paths of all files within the environment.

        Raises:
            Refusal: It is not what the specification asks for, or its RECORD does not hold.
        """
        self._check_version()
        record = self._record()
        written = []
        for name, entry in self._entries.items():
            if entry.is_dir() or name == f"{self._info}/RECORD":
                continue
            content = self._read(entry)
            self._verify(name, content, record)
            path, is_script = self._target(name, place)
            is_program = is_script or bool(entry.external_attr >> 16 & 0o111)
            if is_script and content.startswith(b"#!python"):
                _, _, rest = content.partition(b"\n")
                content = f"#!{place.python}\n".encode() + rest
            written.append(self._write(place, path, content, is_program=is_program))
        for name, program in self._programs(place):
            path = os.path.join(place.folder("scripts", ""), name)
            written.append(self._write(place, path, program, is_program=True))
        self._write_record(place, record, written)
        return written

    def _find_info(self) -> str:
        project, version = self._name.split("-")[:2]
        wanted = f"{project}-{version}.dist-info"
        tops = {name.partition("/")[0] for name in self._entries}
        found = [top for top in tops if top.endswith(".dist-info")]
        if len(found) != 1 or _normal(found[0]) != _normal(wanted):
            raise Refusal("data", f"{self._name}: expected one folder {wanted}, got {found}")
        return found[0]

    def _check_version(self) -> None:
        for line in self._text("WHEEL").splitlines():
            key, _, value = line.partition(":")
            if key == "Wheel-Version" and value.strip().split(".")[0] == WHEEL_VERSION_MAJOR:
                return
        raise Refusal("data", f"{self._name}: expected Wheel-Version {WHEEL_VERSION_MAJOR}.x")

    def _text(self, name: str) -> str:
        entry = self._entries.get(f"{self._info}/{name}")
        return "" if entry is None else self._read(entry).decode()

    def _record(self) -> dict[str, tuple[str, str]]:
        rows = csv.reader(io.StringIO(self._text("RECORD")))
        return {row[0]: (row[1], row[2]) for row in rows if len(row) == 3}

    def _verify(self, name: str, content: bytes, record: dict[str, tuple[str, str]]) -> None:
        if name in (f"{self._info}/RECORD.jws", f"{self._info}/RECORD.p7s"):
            return
        method, _, wanted = record.get(name, ("", ""))[0].partition("=")
        if method not in ("sha256", "sha384", "sha512"):
            raise Refusal("data", f"{self._name}: {name} has no hash in RECORD")
        digest = hashlib.new(method, content).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != wanted:
            raise Refusal("data", f"{self._name}: {name} is not what RECORD says")

    def _read(self, entry: ZipInfo) -> bytes:
        """Return an entry's content: in one piece, which is quicker than `ZipFile.read` by a third."""
        self._file.seek(entry.header_offset)
        signature, name_size, extra_size = LOCAL_HEADER.unpack(self._file.read(LOCAL_HEADER.size))
        self._file.seek(name_size + extra_size, os.SEEK_CUR)
        packed = self._file.read(entry.compress_size)
        if signature != LOCAL_SIGNATURE or entry.flag_bits & IS_ENCRYPTED:
            raise Refusal("data", f"{self._name}: {entry.filename} cannot be unpacked")
        if entry.compress_type == ZIP_STORED:
            return packed
        if entry.compress_type != ZIP_DEFLATED:
            raise Refusal("data", f"{self._name}: unknown compression of {entry.filename}")
        try:
            content = zlib.decompress(packed, -zlib.MAX_WBITS, max(1, entry.file_size))
        except zlib.error as error:
            raise Refusal("data", f"{self._name}: {entry.filename}: {error}") from None
        return content

    def _target(self, name: str, place: Place) -> tuple[str, bool]:
        """Return where an entry goes, and whether it is a program."""
        parts = name.split("/")
        if name.startswith("/") or ".." in parts or "\\" in name:
            raise Refusal("data", f"{self._name}: {name!r} leads out of the environment")
        if parts[0] != f"{self._info.removesuffix('.dist-info')}.data":
            return os.path.join(place.site, name), False
        if len(parts) < 3:
            raise Refusal("data", f"{self._name}: {name!r} belongs nowhere")
        if parts[1] not in DATA_FOLDERS:
            raise Refusal("data", f"{self._name}: unknown data folder {parts[1]!r}")
        folder = place.folder(parts[1], self._name.split("-")[0])
        return os.path.join(folder, *parts[2:]), parts[1] == "scripts"

    def _programs(self, place: Place) -> Iterator[tuple[str, bytes]]:
        entries = configparser.ConfigParser(delimiters=("=",), interpolation=None)
        entries.optionxform = str  # type: ignore[method-assign,assignment]
        entries.read_string(self._text("entry_points.txt"))
        for section in ("console_scripts", "gui_scripts"):
            for name, value in entries.items(section) if entries.has_section(section) else ():
                module, _, call = value.split("[")[0].replace(" ", "").partition(":")
                if "/" in name or not MODULE.fullmatch(module) or not MODULE.fullmatch(call):
                    raise Refusal("data", f"{self._name}: no entry point: {name} = {value}")
                script = SCRIPT.format(
                    python=place.python, module=module, start=call.split(".")[0], call=call
                )
                yield name, script.encode()

    def _write(self, place: Place, path: str, content: bytes, *, is_program: bool) -> str:
        folder = os.path.dirname(path)
        if folder not in self._made:
            os.makedirs(folder, exist_ok=True)
            self._made.add(folder)
        mode = PROGRAM_MODE if is_program else FILE_MODE
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, mode)
        with open(descriptor, "wb") as file:
            file.write(content)
        return os.path.relpath(path, place.top)

    def _write_record(
        self, place: Place, record: dict[str, tuple[str, str]], written: list[str]
    ) -> None:
        """Leave RECORD and INSTALLER, as tools that look at an environment expect them."""
        info = os.path.join(place.site, self._info)
        written.append(self._write(place, f"{info}/INSTALLER", INSTALLER, is_program=False))
        site = os.path.relpath(place.site, place.top)
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        for path in [*written, os.path.join(site, self._info, "RECORD")]:
            inner = os.path.relpath(path, site)
            rows.writerow((inner, *record.get(inner, ("", ""))))
        content = text.getvalue().encode()
        written.append(self._write(place, f"{info}/RECORD", content, is_program=False))


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
