"""
Run directories: numbered, made atomically, found by number, name or path.

A run directory holds all the evidence of one execution. Files that scripts rely on (run.json,
manifest.json) are replaced atomically, so that a reader sees the old or the new one, never half.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import importlib.metadata
import os
import platform
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import orjson

from cosmos_cli.errors import InputError, RunFailedError
from cosmos_cli.runindex import remember_run, remembered_runs
from madns_runtime.config import RunConfig, from_mapping, to_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.processes import list_processes

RESERVE_NAME = ".reserve"
RESERVE_BYTES = 1024 * 1024
RESULT_BYTES_MAX = 256 * 1024 * 1024
"""A host's result is some kilobytes an agent; a file beyond this is none."""
LOCK_NAME = ".lock"
FOLDERS = ("host", "agents", "machines")
"""In every run directory from its beginning."""
BUNDLE_SUFFIX = ".tar.zst"
SCHEMA = 1
"""Version of run.json and manifest.json; a change that breaks a reader raises it."""
RUNS_VARIABLE = "COSMOS_RUNS"
RUNS_FOLDER = "runs"
RUN_NAME = re.compile(r"^(\d{4,})-(.+)$")
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
        """What was planned, with the run's whole configuration under "config"."""
        return self.path / "plan.json"

    @property
    def result_json(self) -> Path:
        """What the host reported at its end; missing when it was killed."""
        return self.path / "result.json"

    @property
    def left_result_json(self) -> Path:
        """The same, as the host leaves it beside its records: its line to the operator may be cut."""
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
    def bundle(self) -> Path:
        """The packaged run, beside the directory."""
        return self.path.with_name(f"{self.name}{BUNDLE_SUFFIX}")

    @property
    def reserve(self) -> Path:
        """Space set aside so that the summary can be written on a full disk."""
        return self.path / RESERVE_NAME

    def read_json(self, path: Path) -> dict[str, Any] | None:
        """Return a JSON object of this run, None if it is missing or unreadable."""
        try:
            value = orjson.loads(path.read_bytes())
        except (OSError, orjson.JSONDecodeError):
            return None
        return value if isinstance(value, dict) else None

    def read_left_result(self) -> dict[str, Any] | None:
        """Return the result that the host of this run left; None if there is none or it is cut."""
        try:
            if self.left_result_json.stat().st_size > RESULT_BYTES_MAX:
                return None
        except OSError:
            return None
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
    """Return the folder of all runs: the option, else COSMOS_RUNS, else ./runs."""
    return Path(option or os.environ.get(RUNS_VARIABLE) or RUNS_FOLDER)


def create_run(root: Path, scenario_name: str) -> RunDirectory:
    """
    Make the next numbered run directory, with its reserve.

    A lock on the folder makes the number atomic when two runs start at once; the kernel drops it
    when its holder dies.

    Raises:
        InputError: The folder cannot be made.
    """
    slug = UNSAFE.sub("-", scenario_name).strip("-.") or "run"
    run: RunDirectory | None = None
    try:
        root.mkdir(parents=True, exist_ok=True)
        with (root / LOCK_NAME).open("wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            number = max((0, *_numbers(root))) + 1
            run = RunDirectory((root / f"{number:04d}-{slug}").resolve())
            run.path.mkdir()
        remember_run(run.name, run.path)
        for folder in FOLDERS:
            (run.path / folder).mkdir()
        _allocate(run.reserve, RESERVE_BYTES)
    except OSError as error:
        if run is not None:
            discard_run(run)
        raise InputError(
            f"{root}: cannot make a run directory: {error.strerror or error}; "
            f"choose another folder with --runs or {RUNS_VARIABLE}"
        ) from error
    return run


def _numbers(root: Path) -> Iterator[int]:
    """Yield the numbers that are taken: of what lies there, and of runs whose folder was deleted while they live."""
    top = root.resolve()
    yield from (run.number or 0 for run in list_runs(root))
    for entry in list_processes():
        match = RUN_NAME.match(entry.run)
        if match and Path(entry.run_directory).is_relative_to(top):
            yield int(match[1])


def discard_run(run: RunDirectory) -> None:
    """Delete a run of which nothing was started: it is no evidence, and nobody should collect it."""
    shutil.rmtree(run.path, ignore_errors=True)


def list_runs(root: Path) -> list[RunDirectory]:
    """Return the runs below *root*, by number; also of packages whose directory is gone."""
    try:
        names = {entry.name.removesuffix(BUNDLE_SUFFIX) for entry in root.iterdir()}
    except FileNotFoundError:
        return []
    runs = [RunDirectory((root / name).resolve()) for name in names if RUN_NAME.match(name)]
    return sorted(runs, key=lambda run: (run.number or 0, run.name))


def find_run(root: Path, which: str) -> RunDirectory:
    """
    Find a run by path, full name, number (with or without zeros) or "last".

    A run that is not in ./runs is looked for among all that were started by this user; a folder that
    was named by --runs or COSMOS_RUNS is meant alone.

    Raises:
        InputError: There is none, or several; the message lists what there is.
    """
    if os.sep in which or which in (".", ".."):
        path = Path(which)
        if not path.is_dir():
            raise InputError(f"{which}: no such run directory")
        if not (path / "plan.json").is_file() and not all((path / f).is_dir() for f in FOLDERS):
            raise InputError(
                f"{which}: no run directory: expected plan.json, or the folders {', '.join(FOLDERS)}"
            )
        return RunDirectory(path.resolve())
    runs = [run for run in list_runs(root) if run.path.is_dir()]
    if which == "last":
        found = runs[-1:]
    elif which.isdecimal():
        found = [run for run in runs if run.number == int(which)]
    else:
        found = [run for run in runs if run.name == which]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"{which}: {', '.join(run.name for run in found)} match; give the full name"
        )
    if root == Path(RUNS_FOLDER):
        elsewhere = find_elsewhere(which)
        if len(elsewhere) == 1:
            return elsewhere[0]
        if elsewhere:
            paths = ", ".join(str(run.path) for run in elsewhere)
            raise InputError(
                f"{which}: not in {root}, and several elsewhere; give the path: {paths}"
            )
    known = ", ".join(run.name for run in runs[-5:]) or "none yet"
    raise InputError(f"{which}: no such run in {root}; the last ones are: {known}")


def find_elsewhere(which: str) -> list[RunDirectory]:
    """Return the runs that this user started anywhere and that a full name or a number means."""
    runs = [RunDirectory(entry.path) for entry in remembered_runs()]
    if which.isdecimal():
        return [run for run in runs if run.number == int(which)]
    return [run for run in runs if run.name == which]


@contextlib.contextmanager
def alone(run: RunDirectory) -> Iterator[None]:
    """
    Let one command at a time collect a run; the kernel drops the lock when its holder dies.

    Raises:
        InputError: Another one is at it.
        RunFailedError: Somebody deleted the run.
    """
    try:
        descriptor = os.open(run.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise RunFailedError(f"{run.path}: {error.strerror}; was the run deleted?") from error
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{run.name}: another command is collecting it; wait for its end, then repeat"
            ) from None
        yield
    finally:
        os.close(descriptor)


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file so that readers, also after a power cut, see the old or the new content."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with partial.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
    _sync_directory(path.parent)


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Replace a JSON file atomically; keys stay in the order given."""
    write_atomically(
        path,
        orjson.dumps(
            value,
            option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE | orjson.OPT_SERIALIZE_NUMPY,
        ),
    )


def begin_run(run: RunDirectory, config: RunConfig, plan: Mapping[str, Any]) -> None:
    """
    Write what is known at the start: plan.json with the whole configuration, run.json as running.

    Args:
        run: A fresh run directory.
        config: What every process of the run is told; holds no secret.
        plan: The launch plan; "machines" maps each machine to the names of its agents.
    """
    write_json(run.plan_json, {**plan, "config": to_mapping(config)})
    write_json(run.run_json, starting_document(run.name, config, utc_now()))


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
        "versions": installed_versions(),
    }


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


def _allocate(path: Path, size_bytes: int) -> None:
    with path.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, size_bytes)


def _sync_directory(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
