"""
The manifest of an earlier collection: who recorded, and which files are no longer what they were.

Collecting again must not make damage look whole. A file that differs from the manifest is named, and
its first entry stays in the new manifest under "was", so that it is named the next time as well. What
came from a machine is held against that machine's own manifest, also before the first collection.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from cosmos_cli.collect.remote_manifest import MANIFEST_NAME, RETRIEVED_NAME
from cosmos_cli.collect.retrieval_state import retrieved_files
from cosmos_cli.evidence.manifest import file_entry
from cosmos_cli.evidence.run_directory import HOST_TABLE, RunDirectory
from cosmos_cli.evidence.run_documents import MISSING, fault_of
from cosmos_cli.evidence.streams import SUFFIX, StreamScan, is_linked

MADE_ANEW = ("run.json", "report.html", "manifest.json", HOST_TABLE)
"""Written by every collection, as are the tables, or, as the last one, whenever somebody asks for it."""
TABLES = "tables/"
MACHINES = "machines/"
WAS = "was"
UNREADABLE = "unreadable"
NOT_KNOWN = "what has changed since it was written is not known"


@dataclass(frozen=True, slots=True, kw_only=True)
class Earlier:
    """The evidence of a run as its manifest listed it first; empty for a run that was not collected yet."""

    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    fault: str = ""
    """Why there are none though there was a manifest: it is written anew, and this is not told again."""

    @classmethod
    def read(cls, run: RunDirectory) -> Earlier:
        """Return what the manifest of *run* says."""
        fault = fault_of(run.manifest_json)
        files = (run.read_json(run.manifest_json) or {}).get("files")
        if fault is None and not isinstance(files, Mapping):
            fault = "cannot be used: expected the run's files under files"
        entries = {
            name: entry.get(WAS, entry)
            for name, entry in (files.items() if isinstance(files, Mapping) else ())
            if isinstance(entry, Mapping) and not _is_made_anew(name)
        }
        entries = {k: v for k, v in entries.items() if isinstance(v, Mapping)}
        for name, entry in retrieved_files(run):
            # A machine may have gone on with a file since: its last word counts.
            if entries.get(name, {}).get("sha256") != entry["sha256"]:
                entries[name] = entry
        is_lost = fault not in (None, MISSING)
        return cls(entries=entries, fault=f"{fault}; {NOT_KNOWN}" if is_lost else "")

    def sources(self, folder: str) -> tuple[str, ...]:
        """Return whose records were below a folder, such as agents."""
        paths = [PurePosixPath(name).parts for name in self.entries]
        return tuple(dict.fromkeys(p[1] for p in paths if len(p) > 2 and p[0] == folder))

    def changed_files(self, run: RunDirectory, unread: Container[Path]) -> dict[str, str]:
        """Return what happened to each file that is no stream and is not what it was, by name; *unread* are left out."""
        return self._changed(
            {
                name: _entry_now(run, name)
                for name in self.entries
                if not name.endswith(SUFFIX) and run.path / name not in unread
            }
        )

    def changed_streams(
        self, run: RunDirectory, scans: Mapping[Path, StreamScan], unread: Container[Path]
    ) -> dict[str, str]:
        """Return what happened to each stream that is not what it was, by the name of its file; *unread* are left out."""
        paths = {name: run.path / name for name in self.entries if name.endswith(SUFFIX)}
        return self._changed(
            {
                name: {"sha256": scans[path].sha256, "records": scans[path].records}
                if path in scans
                else _entry_now(run, name)  # a plug-in's own, in a folder of its own
                for name, path in paths.items()
                if path not in unread
            }
        )

    def _changed(self, now: Mapping[str, Mapping[str, Any] | None]) -> dict[str, str]:
        changes = {name: _change(entry, self.entries[name]) for name, entry in now.items()}
        return {name: change for name, change in changes.items() if change}


def is_there(run: RunDirectory, name: str) -> bool:
    """Tell whether a name of a manifest is that of a file of the run, or of a link in its place."""
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        return False  # nothing of the run; a manifest can be written by anybody
    try:
        return (run.path / name).is_file()
    except OSError:  # no file has such a name: it is too long
        return False


def _entry_now(run: RunDirectory, name: str) -> Mapping[str, Any] | None:
    """
    Return the entry of a file of the run, empty of a link, which is neither read nor packaged; None if it is gone.

    Of one that cannot be read it says why, under UNREADABLE.
    """
    if not is_there(run, name):
        return None
    path = run.path / name
    try:
        return {} if is_linked(path, run.path) else file_entry(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        return {UNREADABLE: error.strerror or str(error)}


def _is_made_anew(name: str) -> bool:
    is_note = (
        name.startswith(MACHINES)
        and name.count("/") == 2
        and name.endswith((f"/{RETRIEVED_NAME}", f"/{MANIFEST_NAME}"))
    )
    return is_note or name in MADE_ANEW or name.startswith(TABLES)


def _change(now: Mapping[str, Any] | None, was: Mapping[str, Any]) -> str:
    """Return what happened to a file; empty if it is what it was."""
    if now is None:
        return "missing; it was there when the run was collected"
    if not now:
        return "a link, which is not followed; it was there when the run was collected"
    if UNREADABLE in now:
        return f"cannot be read: {now[UNREADABLE]}"
    if now["sha256"] == was.get("sha256"):
        return ""
    has_others = "records" in was and now.get("records", was["records"]) != was["records"]
    counts = f" ({now['records']} records, were {was['records']})" if has_others else ""
    return f"changed since the run was collected{counts}"
