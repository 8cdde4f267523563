"""
Unpacks wheels on a machine with nothing but the standard library.

Follows the PyPA specification of the binary distribution format; what RECORD says is verified, here or before it was
sent. A wheel is unpacked once and stays as it is; environments are made of links to its files (`environment`).
"""

from __future__ import annotations

import base64
import contextlib
import csv
import hashlib
import io
import os
import struct
import zlib
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile

from cosmos_cli.onboard import content_changes, content_store
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    no_links,
    sync_folder,
    verb,
)

TYPE_CHECKING = False  # to import typing takes longer than most that is done here
if TYPE_CHECKING:
    from collections.abc import Mapping
    from zipfile import ZipInfo

WHEEL_VERSION_MAJOR = "1"
MARK_SCHEMA = 1
PART = ".part"
LOCAL_HEADER = struct.Struct("<4s22xHH")
LOCAL_SIGNATURE = b"PK\x03\x04"
IS_ENCRYPTED = 1
EXECUTE_BITS = 0o111
PROGRAM_MODE, FILE_MODE = 0o755, 0o644
HASHES = ("sha256", "sha384", "sha512")
"""Hashes that the specification lets RECORD use."""
SIGNATURES = ("RECORD.jws", "RECORD.p7s")
"""Files beside RECORD that it does not name."""


@verb("wheel")
def wheel(request: VerbRequest) -> None:
    """Keep a piece of a wheel; with the last one it is verified, unpacked, and gets its name."""
    asked = request.arguments
    folder = content_store.expand(asked["folder"])
    os.makedirs(folder, exist_ok=True)
    partial = partial_path(folder, asked["sha256"])
    with open(partial, "ab", opener=no_links) as file:
        if file.tell() != asked["offset"]:
            raise HelperRefusal(
                "data", f"{partial}: expected {asked['offset']} B, has {file.tell()} B"
            )
        try:
            file.write(request.body)
            file.flush()
        except OSError:
            os.unlink(partial)  # a full disk needs the room more than the next try needs the piece
            raise
        if file.tell() < asked["size"]:
            return
    if content_store.hash_of(partial) != asked["sha256"]:
        os.unlink(partial)
        raise HelperRefusal(
            "data", f"{asked['filename']}: what came is not what was announced", "repeat"
        )
    _settle(Archive(partial, asked["filename"], is_verified=asked["is_verified"]), folder, asked)


def partial_path(folder: str, sha256: str) -> str:
    """Return where a wheel is while it comes."""
    return os.path.join(folder, f"{content_store.HIDDEN}{sha256}{PART}")


def is_wheel_whole(path: str) -> bool:
    """Tell whether an unpacked wheel is whole and nobody touched it."""
    mark = content_store.read_mark(path)
    return mark is not None and content_store.is_untouched(path, mark.get("files", {"": []}))


def _settle(archive: Archive, folder: str, asked: Mapping[str, PlainValue]) -> None:
    """Unpack a wheel beside its name, and give it its name."""
    partial, sha256 = archive.path, asked["sha256"]
    new = content_changes.beside(folder, sha256)
    try:
        os.mkdir(new)
        names, info = archive.unpack(new)
        os.unlink(partial)  # before what follows writes all that is new to the disk
        content_changes.sync(new)
        document = {"schema": MARK_SCHEMA, "filename": asked["filename"], "info": info}
        content_changes.mark_complete(new, {**document, "files": content_store.trace(new, names)})
        path = os.path.join(folder, sha256)
        content_changes.remove(path)
        os.rename(new, path)
    except (OSError, HelperRefusal):
        content_changes.remove(new)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(partial)  # a full disk needs the room; a wheel that is faulty is no use
        raise
    sync_folder(folder)


class Archive:
    """
    A wheel as it came; the hash of its whole content is verified already.

    Args:
        path: Where it is.
        filename: Its own name.
        is_verified: Whether its files were verified by RECORD before it was sent; else they are here.
    """

    def __init__(self, path: str, filename: str, *, is_verified: bool = False) -> None:
        self.path = path
        self._is_verified = is_verified
        self._name = filename
        self._info = "-".join(filename.split("-")[:2]) + ".dist-info"
        self._entries: dict[str, ZipInfo] = {}

    def unpack(self, folder: str) -> tuple[list[str], str]:
        """
        Unpack it, each file verified by what RECORD, or its entry, says of it.

        Returns:
            The paths of its files within *folder*, and the name of its dist-info folder.

        Raises:
            Refusal: It is not what the specification asks for.
        """
        with open(self.path, "rb") as file:
            try:
                with ZipFile(file) as archive:
                    entries = archive.infolist()
            except BadZipFile as error:
                raise self._refusal(str(error)) from None
            self._entries = {e.filename: e for e in entries if not e.is_dir()}
            self._check(file)
            record = {} if self._is_verified else self._record(file)
            made: set[str] = set()
            for name, entry in self._entries.items():
                self._check_name(name)
                content = self._read(file, entry)
                if not self._is_verified:
                    self._verify(name, content, record)
                elif zlib.crc32(content) != entry.CRC:
                    raise self._refusal(f"{name} did not come out as it was packed")
                self._write(os.path.join(folder, name), content, self._mode(entry), made)
        return list(self._entries), self._info

    def _check(self, file: io.BufferedReader) -> None:
        tops = {name.partition("/")[0] for name in self._entries}
        infos = {top for top in tops if top.endswith(".dist-info")}
        if infos != {self._info}:
            found = ", ".join(sorted(infos)) or "none"
            raise self._refusal(f"expected one folder {self._info}, got {found}")
        for line in self._text(file, "WHEEL").splitlines():
            key, _, value = line.partition(":")
            if key == "Wheel-Version" and value.strip().split(".")[0] == WHEEL_VERSION_MAJOR:
                return
        raise self._refusal(f"expected Wheel-Version {WHEEL_VERSION_MAJOR}.x")

    def _check_name(self, name: str) -> None:
        parts = name.split("/")
        if not all(parts) or {".", ".."} & set(parts) or "\\" in name or name == content_store.MARK:
            raise self._refusal(f"{name!r} leads out of its folder")

    def _text(self, file: io.BufferedReader, name: str) -> str:
        entry = self._entries.get(f"{self._info}/{name}")
        return "" if entry is None else self._read(file, entry).decode()

    def _record(self, file: io.BufferedReader) -> dict[str, str]:
        rows = csv.reader(io.StringIO(self._text(file, "RECORD")))
        return {row[0]: row[1] for row in rows if len(row) == 3}

    def _verify(self, name: str, content: bytes, record: dict[str, str]) -> None:
        if name in {f"{self._info}/{each}" for each in ("RECORD", *SIGNATURES)}:
            return
        method, _, wanted = record.get(name, "").partition("=")
        if method not in HASHES:
            raise self._refusal(f"{name} has no hash in RECORD")
        digest = hashlib.new(method, content).digest()
        if base64.urlsafe_b64encode(digest).rstrip(b"=").decode() != wanted:
            raise self._refusal(f"{name} is not what RECORD says")

    def _read(self, file: io.BufferedReader, entry: ZipInfo) -> bytes:
        """Return an entry's content: in one piece, which is quicker than `ZipFile.read` by a third."""
        file.seek(entry.header_offset)
        signature, name_size, extra_size = LOCAL_HEADER.unpack(file.read(LOCAL_HEADER.size))
        file.seek(name_size + extra_size, os.SEEK_CUR)
        packed = file.read(entry.compress_size)
        if signature != LOCAL_SIGNATURE or entry.flag_bits & IS_ENCRYPTED:
            raise self._refusal(f"{entry.filename} cannot be unpacked")
        if entry.compress_type == ZIP_STORED:
            return packed
        if entry.compress_type != ZIP_DEFLATED:
            raise self._refusal(f"unknown compression of {entry.filename}")
        try:
            return zlib.decompress(packed, -zlib.MAX_WBITS, max(1, entry.file_size))
        except zlib.error as error:
            raise self._refusal(f"{entry.filename}: {error}") from None

    def _mode(self, entry: ZipInfo) -> int:
        is_script = entry.filename.split("/")[1:2] == ["scripts"] and ".data/" in entry.filename
        is_program = is_script or bool(entry.external_attr >> 16 & EXECUTE_BITS)
        return PROGRAM_MODE if is_program else FILE_MODE

    def _write(self, path: str, content: bytes, mode: int, made: set[str]) -> None:
        folder = os.path.dirname(path)
        if folder not in made:
            os.makedirs(folder, exist_ok=True)
            made.add(folder)
        content_changes.write_new(path, content, mode)

    def _refusal(self, text: str) -> HelperRefusal:
        return HelperRefusal("data", f"{self._name}: {text}")
