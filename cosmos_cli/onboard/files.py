"""
Files on a machine, changed one at a time and each at once: before or after, never half.

A new content is written beside, brought to the disk, and renamed. What a power failure leaves beside is
overwritten by the next attempt.
"""

from __future__ import annotations

import contextlib
import grp
import os
import pwd
import re
import stat
from collections.abc import Mapping

from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    sha256,
    sync_folder,
    verb,
)

CONTENT_BYTES_MAX = 64 * 1024 * 1024
"""Of a file that is written or edited: what is longer has another content, and is not read to know that."""
MODE_DEFAULT = 0o644
FOLDER_MODE_DEFAULT = 0o755
MISSING_FILE_ADVICE = "correct the path, or say create: true in cosmos_provision"
KINDS = {stat.S_IFREG: "file", stat.S_IFDIR: "directory"}


def look_at(path: str) -> dict[str, PlainValue]:
    """Tell what a path is; a link is followed."""
    try:
        found = os.stat(os.path.expanduser(path))
    except (FileNotFoundError, NotADirectoryError):
        return {"kind": "missing"}
    return {
        "kind": KINDS.get(stat.S_IFMT(found.st_mode), "other"),
        "mode": stat.S_IMODE(found.st_mode),
        "owner": user_name(found.st_uid),
        "group": _group_name(found.st_gid),
        "owner_id": found.st_uid,
        "group_id": found.st_gid,
        "size_bytes": found.st_size,
    }


def content_hash(path: str) -> str | None:
    """Return the SHA-256 of a file's content; None of one that is longer than any that is written here."""
    with open(os.path.expanduser(path), "rb") as file:
        if os.fstat(file.fileno()).st_size > CONTENT_BYTES_MAX:
            return None
        return sha256(file)


def edited(content: str, *, line: str | None, regexp: str | None, is_present: bool) -> str:
    """
    Return a file's content with one line there or not; all else stays as it is. Pure.

    Args:
        content: Of the file.
        line: The whole line, without its end.
        regexp: Where it is found: the last such line is replaced, or every one is removed.
        is_present: Whether the line is to be there.
    """
    lines = content.split("\n")  # what stands behind the last end of line is the last item
    meant = [
        index
        for index, text in enumerate(lines)
        if (index < len(lines) - 1 or text) and _is_meant(text.rstrip("\r"), line, regexp)
    ]
    if not is_present:
        return _without(lines, meant)
    if line is None:
        raise ValueError("expected the line that is to be present")
    end = "\r" if "\r\n" in content else ""
    if meant:
        last = meant[-1]
        kept = "\r" if lines[last].endswith("\r") else ""
        return "\n".join([*lines[:last], line + kept, *lines[last + 1 :]])
    if lines[-1]:
        lines[-1] += end
        lines.append("")
    return "\n".join([*lines[:-1], line + end, ""])


def _without(lines: list[str], meant: list[int]) -> str:
    kept = [text for index, text in enumerate(lines) if index not in meant]
    if kept and meant and meant[-1] == len(lines) - 1:
        kept.append("")  # the line above keeps its end
    return "\n".join(kept)


def _is_meant(text: str, line: str | None, regexp: str | None) -> bool:
    return text == line if regexp is None else re.search(regexp, text) is not None


def replace_file(path: str, content: bytes, how: Mapping[str, PlainValue]) -> bool:
    """
    Give a file a content, a mode and an owner at once; tell whether anything changed.

    Args:
        path: The file; a link stays one. Folders above that are missing are made.
        content: All of it.
        how: "mode", "owner", "group"; what is missing or null stays as it is.
    """
    path = os.path.realpath(os.path.expanduser(path))
    folder, name = os.path.split(path)
    os.makedirs(folder, mode=FOLDER_MODE_DEFAULT, exist_ok=True)
    before = _stat_of_file(path)
    mode, uid, gid = _wanted_of(how, before)
    if (
        before is not None
        and before.st_size == len(content)
        and _read(path) == content
        and _state_of(before) == (mode, uid, gid)
    ):
        return False
    beside = os.path.join(folder, f".{name}.cosmos-new")
    with contextlib.suppress(FileNotFoundError):
        os.unlink(beside)
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            _give(file.fileno(), uid, gid)
            os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        os.rename(beside, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(beside)
        raise
    sync_folder(folder)
    return True


def _stat_of_file(path: str) -> os.stat_result | None:
    try:
        found = os.stat(path)
    except FileNotFoundError:
        return None
    if not stat.S_ISREG(found.st_mode):
        raise HelperRefusal(
            "step", f"{path}: expected a file, got something else", "remove it there"
        )
    return found


def _read(path: str) -> bytes | None:
    try:
        with open(path, "rb") as file:
            return file.read()
    except PermissionError:
        return None


def _state_of(found: os.stat_result) -> tuple[int, int, int]:
    return stat.S_IMODE(found.st_mode), found.st_uid, found.st_gid


def _wanted_of(
    how: Mapping[str, PlainValue], before: os.stat_result | None
) -> tuple[int, int, int]:
    mode, uid, gid = _state_of(before) if before else (MODE_DEFAULT, os.geteuid(), os.getegid())
    owner = _number_of(how.get("owner"), is_group=False)
    group = _number_of(how.get("group"), is_group=True)
    return (
        mode if how.get("mode") is None else how["mode"],
        uid if owner is None else owner,
        gid if group is None else group,
    )


def _give(descriptor: int, uid: int, gid: int) -> None:
    """Give an open file to its owner; a file system that knows no owners already says the right one or fails."""
    found = os.fstat(descriptor)
    if (found.st_uid, found.st_gid) != (uid, gid):
        os.fchown(descriptor, uid, gid)


def _number_of(name: str | None, *, is_group: bool) -> int | None:
    if name is None:
        return None
    try:
        return grp.getgrnam(name).gr_gid if is_group else pwd.getpwnam(name).pw_uid
    except KeyError:
        if name.isdecimal():
            return int(name)
        what = "group" if is_group else "user"
        raise HelperRefusal("step", f"there is no {what} {name!r} on this machine") from None


def user_name(uid: int) -> str:
    """Return a user's name, or the number where nobody has it."""
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


@verb("make_directories")
def make_directories(request: VerbRequest) -> list[str]:
    """Make folders that are missing, and return which those were."""
    made = []
    for path in request.arguments["paths"]:
        full = os.path.expanduser(path)
        if not os.path.isdir(full):
            os.makedirs(full, mode=FOLDER_MODE_DEFAULT, exist_ok=True)
            sync_folder(os.path.dirname(full))
            made.append(path)
    return made


@verb("write_file")
def write_file(request: VerbRequest) -> bool:
    """Give a file the content that came as the body; tell whether anything changed."""
    return replace_file(request.arguments["path"], request.body, request.arguments)


@verb("remove_file")
def remove_file(request: VerbRequest) -> bool:
    """Remove a file; tell whether it was there."""
    path = os.path.expanduser(request.arguments["path"])
    try:
        os.unlink(path)
    except FileNotFoundError:
        return False
    sync_folder(os.path.dirname(path))
    return True


@verb("edit_line")
def edit_line(request: VerbRequest) -> bool:
    """Have a line in a file or not; tell whether anything changed."""
    arguments = request.arguments
    path = os.path.expanduser(arguments["path"])
    found = _stat_of_file(path)
    if found is not None and found.st_size > CONTENT_BYTES_MAX:
        text = f"{path}: expected at most {CONTENT_BYTES_MAX} B to edit, got {found.st_size} B"
        raise HelperRefusal("step", text)
    try:
        with open(path, "rb") as file:
            before = file.read().decode(errors="surrogateescape")
    except FileNotFoundError:
        if not arguments.get("create"):
            text = f"{path}: there is no such file on this machine"
            raise HelperRefusal("step", text, MISSING_FILE_ADVICE) from None
        before = ""
    after = edited(
        before,
        line=arguments.get("line"),
        regexp=arguments.get("regexp"),
        is_present=bool(arguments["is_present"]),
    )
    if after == before and os.path.exists(path):
        return False
    return replace_file(path, after.encode(errors="surrogateescape"), {})


@verb("set_values")
def set_values(request: VerbRequest) -> None:
    """Write values where the kernel takes them: below /proc/sys or /sys."""
    for path, value in request.arguments["values"]:
        try:
            with open(path, "w") as file:
                file.write(f"{value}\n")  # as `echo` would
        except OSError as error:
            text = f"{path}: {error.strerror}, when {value!r} was written"
            raise HelperRefusal("step", text) from None
