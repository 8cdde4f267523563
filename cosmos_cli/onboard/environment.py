"""
Virtual environments on a machine: built from unpacked wheels under their final names, marked when whole.

An environment is a folder with a link to the interpreter and `pyvenv.cfg` (PEP 405): neither venv, ensurepip,
pip nor uv is needed there. Its packages are hard links to the wheels' files: nothing is written twice.
"""

from __future__ import annotations

import configparser
import contextlib
import errno
import json
import os
import re
import shutil
import sys
from collections.abc import Iterator, Mapping

from cosmos_cli.onboard import content_changes, content_store
from cosmos_cli.onboard.installed import (
    interpreter_path,
    is_environment_whole,
    prunable,
    site_folder,
)
from cosmos_cli.onboard.request_loop import (
    HelperRefusal,
    PlainValue,
    VerbRequest,
    last_words,
    sync_folder,
    verb,
)
from cosmos_cli.onboard.wheels import is_wheel_whole, partial_path

MARK_SCHEMA = 1
INSTALLER = b"cosmos\n"
PROGRAM_MODE = 0o755
NAME = re.compile(r"[A-Za-z_][\w.]*")
NO_LINKS = (errno.EPERM, errno.EXDEV, errno.EMLINK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Of file systems that know no hard links, such as a USB stick's: files are copied there."""
SCRIPT = """#!{python}
import sys
from {module} import {start}

if __name__ == "__main__":
    sys.exit({call}())
"""
VERSIONS_TIMEOUT_S = 60.0
VERSIONS = """
import importlib.metadata, json, sys
found = {}
for name in sys.argv[1:]:
    try:
        found[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        found[name] = None
print(json.dumps(found))
"""


@verb("environment")
def environment(request: VerbRequest) -> dict[str, PlainValue]:
    """
    See that an environment is there.

    Returns whether anything changed, and which wheels must be sent first, each with how much is there of it.
    """
    asked = request.arguments
    folder = content_store.expand(asked["folder"])
    wheels = content_store.expand(asked["wheels_folder"])
    path = os.path.join(folder, asked["key"])
    if is_environment_whole(path, is_strict=True):
        return {"changed": False, "missing": []}
    if list(sys.version_info[:2]) != asked["python"]:
        found = ".".join(map(str, sys.version_info[:2]))
        raise HelperRefusal("data", f"expected Python {asked['python']}, found {found}", "repeat")
    missing = [
        {"sha256": wanted["sha256"], "have": _size_of_part(wheels, wanted)}
        for wanted in asked["wheels"]
        if not is_wheel_whole(os.path.join(wheels, wanted["sha256"]))
    ]
    if missing:
        return {"changed": False, "missing": missing}
    if os.path.isdir(path) and content_store.used([path]):
        raise HelperRefusal(
            "busy",
            f"the environment {path} is damaged, and a run uses it",
            "end that run (`cosmos ps`, `cosmos down`), then repeat",
        )
    content_changes.remove(path)
    content_changes.remove_left_overs(folder)
    content_changes.remove_left_overs(wheels)
    try:
        Builder(path, wheels, asked).build()
    except (OSError, HelperRefusal):
        with contextlib.suppress(OSError):
            content_changes.remove(path)  # most of all when the disk is full
        raise
    return {"changed": True, "missing": []}


def _size_of_part(wheels: str, wanted: Mapping[str, PlainValue]) -> int:
    """Return how much of a wheel has come."""
    path = partial_path(wheels, wanted["sha256"])
    with contextlib.suppress(FileNotFoundError):
        size = os.stat(path).st_size
        if size <= wanted["size"]:
            return size
        os.unlink(path)
    return 0


class Builder:
    """
    Builds one environment.

    Args:
        path: Its folder, under its final name.
        wheels: Folder of the unpacked wheels.
        asked: What is wanted, as the verb is told.
    """

    def __init__(self, path: str, wheels: str, asked: Mapping[str, PlainValue]) -> None:
        self._path = path
        self._wheels = wheels
        self._asked = asked
        self._python = os.path.join(path, "bin/python")
        self._version = ".".join(map(str, asked["python"]))
        self._site = site_folder(asked["python"])
        self._made: set[str] = set()

    def build(self) -> None:
        """
        Build it, wait until it is on the disk, and mark it.

        Raises:
            Refusal: A wheel has parts that belong nowhere.
        """
        written = self._skeleton()
        for wanted in self._asked["wheels"]:
            written += self._install(os.path.join(self._wheels, wanted["sha256"]))
        content_changes.sync(self._path)
        document = {
            "schema": MARK_SCHEMA,
            "wheels": [wanted["sha256"] for wanted in self._asked["wheels"]],
            "files": content_store.trace(self._path, written),
        }
        content_changes.mark_complete(self._path, document)
        sync_folder(os.path.dirname(self._path))

    def _skeleton(self) -> list[str]:
        interpreter = interpreter_path()
        for folder in ("bin", self._site):
            os.makedirs(os.path.join(self._path, folder))
        links = [f"bin/{name}" for name in ("python", "python3", f"python{self._version}")]
        for name in links:
            target = interpreter if name == links[0] else "python"
            os.symlink(target, os.path.join(self._path, name))
        lines = {
            "home": os.path.dirname(interpreter),
            "include-system-site-packages": "true" if self._asked["sees_system"] else "false",
            "version": ".".join(map(str, sys.version_info[:3])),
        }
        text = "".join(f"{key} = {value}\n" for key, value in lines.items())
        return [*links, self._write("pyvenv.cfg", text.encode())]

    def _install(self, wheel: str) -> list[str]:
        mark = content_store.read_mark(wheel) or {}
        info = mark["info"]
        written = []
        for name in mark["files"]:
            if name == f"{info}/RECORD":
                continue
            source, target = os.path.join(wheel, name), self._target(name, info)
            if "/scripts/" in name and (script := self._script(source)) is not None:
                written.append(self._write(target, script, PROGRAM_MODE))
            else:
                written.append(self._link(source, target))
        for name, program in self._starters(os.path.join(wheel, info, "entry_points.txt")):
            written.append(self._write(f"bin/{name}", program, PROGRAM_MODE))
        written.append(self._write(f"{self._site}/{info}/INSTALLER", INSTALLER))
        written.append(self._record(info, written))
        return written

    def _target(self, name: str, info: str) -> str:
        """Return where a file of a wheel belongs within the environment."""
        top, _, rest = name.partition("/")
        if top != f"{info.removesuffix('.dist-info')}.data":
            return f"{self._site}/{name}"
        scheme, _, inner = rest.partition("/")
        folders = {
            "purelib": self._site,
            "platlib": self._site,
            "scripts": "bin",
            "headers": f"include/site/python{self._version}/{info.split('-')[0]}",
            "data": ".",
        }
        if scheme not in folders or not inner:
            raise HelperRefusal("data", f"{info}: {name} belongs into no known folder")
        return os.path.normpath(f"{folders[scheme]}/{inner}")

    def _script(self, source: str) -> bytes | None:
        """Return a script whose first line asks for the environment's interpreter; None for other files."""
        with open(source, "rb") as file:
            content = file.read()
        if not content.startswith(b"#!python"):
            return None
        return f"#!{self._python}\n".encode() + content.partition(b"\n")[2]

    def _starters(self, entry_points: str) -> Iterator[tuple[str, bytes]]:
        """Yield the programs that a wheel's entry points ask for."""
        if not os.path.exists(entry_points):
            return
        entries = configparser.ConfigParser(delimiters=("=",), interpolation=None)
        entries.optionxform = str  # type: ignore[method-assign,assignment]  # as its documentation has it
        entries.read(entry_points, encoding="utf-8")
        for section in ("console_scripts", "gui_scripts"):
            for name, value in entries.items(section) if entries.has_section(section) else ():
                module, _, call = value.split("[")[0].replace(" ", "").partition(":")
                if "/" in name or not NAME.fullmatch(module) or not NAME.fullmatch(call):
                    raise HelperRefusal("data", f"{entry_points}: no entry point: {name} = {value}")
                start = call.split(".")[0]
                text = SCRIPT.format(python=self._python, module=module, start=start, call=call)
                yield name, text.encode()

    def _record(self, info: str, written: list[str]) -> str:
        """Leave RECORD, as tools that look at an environment expect it; the wheel's own has the hashes."""
        path = f"{self._site}/{info}/RECORD"
        rows = []
        for name in [*written, path]:
            inner = os.path.relpath(name, self._site)
            rows.append(f'"{inner}",,\n' if "," in inner or '"' in inner else f"{inner},,\n")
        return self._write(path, "".join(rows).encode())

    def _link(self, source: str, target: str) -> str:
        path = self._room(target)
        try:
            _link_or_copy(source, path)
        except FileExistsError:  # two wheels bring one file: the later one has it, as with pip
            os.unlink(path)
            _link_or_copy(source, path)
        return target

    def _write(self, target: str, content: bytes, mode: int = 0o644) -> str:
        path = self._room(target)
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)  # it may be a link to a wheel's file
        content_changes.write_new(path, content, mode)
        return target

    def _room(self, target: str) -> str:
        path = os.path.join(self._path, target)
        folder = os.path.dirname(path)
        if folder not in self._made:
            os.makedirs(folder, exist_ok=True)
            self._made.add(folder)
        return path


def _link_or_copy(source: str, path: str) -> None:
    """
    Give a wheel's file a name in an environment as well.

    Raises:
        FileExistsError: Something has that name.
    """
    try:
        os.link(source, path)
    except OSError as error:
        if error.errno not in NO_LINKS:
            raise
        shutil.copy2(source, path)


@verb("versions")
def versions(request: VerbRequest) -> dict[str, str | None]:
    """Tell which versions of Python packages the distribution's interpreter finds; None for what it does not."""
    import subprocess  # nothing else here starts a process

    done = subprocess.run(
        [interpreter_path(), "-s", "-P", "-c", VERSIONS, *map(str, request.arguments["names"])],
        capture_output=True,
        timeout=VERSIONS_TIMEOUT_S,
        check=False,
    )
    if done.returncode:
        raise HelperRefusal("step", f"{interpreter_path()}: {last_words(done.stderr)}")
    return dict(json.loads(done.stdout))


@verb("prune_installed")
def prune_installed(request: VerbRequest) -> dict[str, PlainValue]:
    """Remove the trees, environments and wheels that nobody needs, what was left half made, and what Python compiled of them."""
    asked = request.arguments
    folders = {kind: content_store.expand(path) for kind, path in asked["folders"].items()}
    wanted = {"trees": asked["trees"], "environments": asked["environments"]}
    removed = prunable(folders, wanted)
    for kind, names in removed.items():
        for name in names:
            content_changes.remove(os.path.join(folders[kind], name))
    for kind in wanted:
        # Python put what it compiled below that folder under the whole path of the source.
        compiled = content_store.expand(asked["compiled"]) + folders[kind]
        for name in set(content_store.names_in(compiled)) - set(
            content_store.names_in(folders[kind])
        ):
            content_changes.remove(os.path.join(compiled, name))
    return removed
