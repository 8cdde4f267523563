"""
Run directories: numbered, made atomically, listed. `cosmos_cli.evidence.run_search` finds one.

A run directory holds all the evidence of one execution. Files that scripts rely on (run.json,
manifest.json) are replaced atomically, so that a reader sees the old or the new one, never half.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import importlib.metadata
import os
import platform
import re
import shlex
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from cosmos_cli.errors import InputError, RunFailedError, check_path_is_text
from cosmos_cli.evidence.run_documents import SCHEMA as SCHEMA
from cosmos_cli.evidence.run_documents import read_object
from cosmos_cli.evidence.run_index import remember_run
from cosmos_cli.evidence.run_number import NUMBER_MAX, NoNumber, make_numbered
from cosmos_cli.system.file_lock import LockHeld, take_lock
from cosmos_cli.system.ownership import check_own_folder
from madns_runtime.config import RunConfig, from_mapping, to_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.partial_file import write_whole
from madns_runtime.plugin.entry_points import distributions_of
from madns_runtime.plugin.registry import GROUP
from madns_runtime.processes import list_processes
from madns_runtime.recording.access import (
    DEFAULT,
    Access,
    access_applied,
    access_of,
    file_mode,
    folder_mode,
)

RESERVE_NAME = ".reserve"
RESERVE_BYTES = 1024 * 1024
FOLDERS = ("host", "agents", "machines")
"""In every run directory from its beginning."""
BUNDLE_SUFFIX = ".tar.zst"
HOST_TABLE = "truth.parquet"
RUNS_VARIABLE = "COSMOS_RUNS"
RUNS_FOLDER = "runs"
INTERRUPTED = "interrupted"
"""Key of run.json that is true from the operator's word to end the run until the run is judged."""
RUN_NAME = re.compile(rf"^([0-9]{{4,{len(str(NUMBER_MAX))}}})-(.+)$")
VERSIONED_PACKAGES = ("cosmos-madns", "numpy", "scipy", "sgp4", "msgpack", "orjson", "pyarrow")
UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """One run's directory and the names of what it holds."""

    path: Path

    @property
    def name(self) -> str:
        """Name of the run, such as 0007-iridium10."""
        return self.path.name

    @property
    def shell_path(self) -> str:
        """The path as a shell takes it, for commands that are to be copied: folders have spaces in their names."""
        return shlex.quote(str(self.path))

    @property
    def number(self) -> int | None:
        """Number of the run; None if somebody renamed the directory."""
        match = RUN_NAME.match(self.name)
        return int(match[1]) if match else None

    @property
    def run_json(self) -> Path:
        """The summary that scripts read."""
        return self.path / "run.json"

    @property
    def plan_json(self) -> Path:
        """The plan, with the run's whole configuration under "config"."""
        return self.path / "plan.json"

    @property
    def result_json(self) -> Path:
        """The host's report at its end; missing when it was killed."""
        return self.path / "result.json"

    @property
    def left_result_json(self) -> Path:
        """The host's result as it leaves it beside its records: its line to the operator may be cut."""
        return self.path / "host/result.json"

    @property
    def manifest_json(self) -> Path:
        """Every file with its size, hash and counts."""
        return self.path / "manifest.json"

    @property
    def report_html(self) -> Path:
        """The report for people."""
        return self.path / "report.html"

    @property
    def tables(self) -> Path:
        """Folder of the Parquet tables."""
        return self.path / "tables"

    @property
    def host_table(self) -> Path:
        """Table of what the host itself recorded: made when it is asked for, at whatever rate, of what is evidence already."""
        return self.path / HOST_TABLE

    @property
    def bundle(self) -> Path:
        """The packaged run, beside the directory."""
        return self.path.with_name(f"{self.name}{BUNDLE_SUFFIX}")

    @property
    def reserve(self) -> Path:
        """Space set aside so that the summary can be written on a full disk."""
        return self.path / RESERVE_NAME

    @property
    def access(self) -> Access:
        """Access that the mode of its directory grants."""
        try:
            return access_of(self.path.stat().st_mode)
        except OSError:
            return DEFAULT

    def read_json(self, path: Path) -> dict[str, Any] | None:
        """Return a JSON object of this run, None if it is missing or unreadable; `fault_of` says why."""
        try:
            return read_object(path)
        except (OSError, ValueError):
            return None

    def read_left_result(self) -> dict[str, Any] | None:
        """Return the result that the host of this run left; None if there is none or it is cut."""
        result = self.read_json(self.left_result_json)
        is_result = result is not None and isinstance(result.get("status"), str)
        return result if is_result else None

    def read_config(self) -> RunConfig | None:
        """Return the run's configuration from plan.json, None if it cannot be read."""
        plan = self.read_json(self.plan_json)
        config = plan.get("config") if plan else None
        if not isinstance(config, Mapping):
            return None
        try:
            return from_mapping(RunConfig, config)
        except ConfigurationError:
            return None

    def free_reserve(self) -> None:
        """Give the reserved space back to the file system."""
        with contextlib.suppress(OSError):
            self.reserve.unlink()


def runs_root(option: str | os.PathLike[str] | None = None) -> Path:
    """
    Return the folder of all runs: the option, else COSMOS_RUNS, else ./runs.

    Raises:
        InputError: Its path is no UTF-8.
    """
    root = Path(os.path.expanduser(option or os.environ.get(RUNS_VARIABLE) or RUNS_FOLDER))
    check_path_is_text(root)
    return root


def create_run(root: Path, scenario_name: str, access: Access = DEFAULT) -> RunDirectory:
    """
    Make the next numbered run directory, with its reserve.

    Args:
        root: Of all runs; made if it is missing.
        scenario_name: What the run is named after.
        access: Who may read it.

    Raises:
        InputError: The folder cannot be made.
    """
    slug = UNSAFE.sub("-", scenario_name).strip("-.") or "run"
    run: RunDirectory | None = None
    try:
        root.mkdir(parents=True, exist_ok=True)
        path = make_numbered(root, slug, lambda: _taken(root), mode=folder_mode(access))
        run = RunDirectory(path.resolve())
        remember_run(run.name, run.path)
        for folder in FOLDERS:
            (run.path / folder).mkdir()
            (run.path / folder).chmod(folder_mode(access))
        _allocate(run.reserve, RESERVE_BYTES, mode=file_mode(access))
    except (OSError, NoNumber) as error:
        if run is not None:
            discard_run(run)
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise InputError(
            f"{root}: cannot make a run directory: {why}; "
            f"choose another folder with --runs or {RUNS_VARIABLE}"
        ) from error
    return run


def _taken(root: Path) -> Iterator[tuple[int, str]]:
    """Yield number and name of whatever lies there, and of runs whose folder was deleted while they live."""
    top = root.resolve()
    for entry in _entries(root):
        run = RunDirectory(root / entry.name.removesuffix(BUNDLE_SUFFIX))
        yield run.number or 0, run.name
    for process in list_processes():
        match = RUN_NAME.match(process.run)
        if match and Path(process.run_directory).is_relative_to(top):
            yield int(match[1]), process.run


def discard_run(run: RunDirectory) -> None:
    """Delete a run of which nothing was started: it is no evidence, and nobody should collect it."""
    shutil.rmtree(run.path, ignore_errors=True)


def list_runs(root: Path) -> list[RunDirectory]:
    """
    Return the runs below *root*, by number; also of packages whose directory is gone.

    Links are no runs: what is written into a run would go to where they lead.

    Raises:
        InputError: The folder cannot be listed.
    """
    names = {
        entry.name if entry.is_dir(follow_symlinks=False) else entry.name[: -len(BUNDLE_SUFFIX)]
        for entry in _entries(root)
        if entry.is_dir(follow_symlinks=False)
        or (entry.name.endswith(BUNDLE_SUFFIX) and entry.is_file(follow_symlinks=False))
    }
    runs = [RunDirectory((root / name).resolve()) for name in names if RUN_NAME.match(name)]
    return sorted(runs, key=lambda run: (run.number or 0, run.name))


def _entries(root: Path) -> list[os.DirEntry[str]]:
    """Return whatever bears the name of a run; none if there is no such folder."""
    try:
        with os.scandir(root) as entries:
            return [entry for entry in entries if RUN_NAME.match(entry.name)]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise InputError(
            f"{root}: expected the folder of all runs: {error.strerror}; "
            f"name it with --runs or {RUNS_VARIABLE}"
        ) from error


@contextlib.contextmanager
def alone(run: RunDirectory, *, patience_s: float = 0.0, must_own: bool = True) -> Iterator[None]:
    """
    Let one command at a time collect a run, and what it writes have the run's access.

    Args:
        run: The run.
        patience_s: How long another one is waited for.
        must_own: Whether it has to be this user's, as when it is written into: whoever has a folder
            decides where its links lead. Root may write into everybody's.

    Raises:
        InputError: Another one is at it all the time, or it is another user's; the message says whose.
        RunFailedError: Somebody deleted the run.
    """
    try:
        descriptor = os.open(run.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise RunFailedError(f"{run.path}: {error.strerror}; was the run deleted?") from error
    try:
        if must_own:
            check_own_folder(descriptor, run.path)
        try:
            take_lock(descriptor, timeout_s=patience_s)
        except LockHeld as held:
            raise InputError(
                f"{run.name}: another command is collecting it: {held}; wait for its end,"
                f" then repeat with: cosmos collect {run.shell_path}"
            ) from None
        with access_applied(run.access):
            yield
    finally:
        os.close(descriptor)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Replace a JSON file so that readers, also after a power cut, see the old or the new; keys stay in their order."""
    options = orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE | orjson.OPT_SERIALIZE_NUMPY
    write_whole(path, orjson.dumps(value, option=options))


def begin_run(
    run: RunDirectory,
    config: RunConfig,
    plan: Mapping[str, Any],
    flown: Mapping[str, Any] | None = None,
) -> None:
    """
    Write what is known at the start: plan.json with the whole configuration, run.json as running.

    Args:
        run: A fresh run directory.
        config: What every process of the run is told; holds no secret.
        plan: The launch plan; "machines" maps each machine to the names of its agents.
        flown: What the run keeps of the files that it flies, as `evidence.flown_files` reads it.
    """
    write_json(run.plan_json, {**plan, "config": to_mapping(config)})
    document = starting_document(run.name, config, utc_now())
    write_json(run.run_json, document | ({} if flown is None else {"flown": flown}))


def note_interruption(run: RunDirectory) -> None:
    """Note in run.json that the operator has ended the run: its host may have no result, and collecting may be cut off."""
    document = run.read_json(run.run_json)
    if document is not None:
        with contextlib.suppress(OSError):
            write_json(run.run_json, {**document, INTERRUPTED: True})


def was_interrupted(document: Mapping[str, Any]) -> bool:
    """Tell whether run.json says that the operator ended the run."""
    return document.get("status") == "interrupted" or document.get(INTERRUPTED) is True


def starting_document(name: str, config: RunConfig, started_utc: str) -> dict[str, Any]:
    """Return run.json of a run that has no end yet."""
    return {
        "schema": SCHEMA,
        "run": name,
        "scenario": config.scenario,
        "status": "running",
        "exit_code": None,
        "agents": {"count": config.agents.count, "lost": []},
        "started_utc": started_utc,
        "seed": config.seed,
        "versions": {**distributions_of(GROUP, config.simulation), **installed_versions()},
    }


@functools.cache
def installed_versions() -> dict[str, str]:
    """Return the versions of what had a hand in the run."""
    versions = {"python": platform.python_version(), "system": platform.platform(terse=True)}
    for package in VERSIONED_PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions


def utc_now() -> str:
    """Return the wall time in UTC, ISO 8601, for records only."""
    return (
        datetime.datetime.now(datetime.UTC)
        .isoformat(timespec="milliseconds")
        .replace("+00:00", "Z")
    )


def _allocate(path: Path, size_bytes: int, *, mode: int) -> None:
    with path.open("xb") as stream:
        os.fchmod(stream.fileno(), mode)
        os.posix_fallocate(stream.fileno(), 0, size_bytes)
