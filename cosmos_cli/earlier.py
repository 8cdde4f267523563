"""
What an earlier collection of a run saw: who recorded, and which files are no longer what they were.

Collecting again must not make damage look whole. A file that differs from the manifest is named, and
its first entry stays in the new manifest under "was", so that it is named the next time as well. What
came from a machine is held against that machine's own manifest, also before the first collection.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from cosmos_cli.manifest import file_entry
from cosmos_cli.retrieve.notes import retrieved_files
from cosmos_cli.retrieve.offer import MANIFEST_NAME, RETRIEVED_NAME
from cosmos_cli.rundir import RunDirectory
from cosmos_cli.streams import SUFFIX, StreamScan

MADE_ANEW = ("run.json", "report.html", "manifest.json")
"""Written by every collection, as are the tables."""
TABLES = "tables/"
MACHINES = "machines/"
WAS = "was"


@dataclass(frozen=True, slots=True, kw_only=True)
class Earlier:
    """The evidence of a run as its manifest listed it first; empty for a run that was not collected yet."""

    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, run: RunDirectory) -> Earlier:
        """Return what the manifest of *run* says."""
        files = (run.read_json(run.manifest_json) or {}).get("files")
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
        return cls(entries=entries)

    def sources(self, folder: str) -> tuple[str, ...]:
        """Return whose records were below a folder, such as agents."""
        paths = [PurePosixPath(name).parts for name in self.entries]
        return tuple(dict.fromkeys(p[1] for p in paths if len(p) > 2 and p[0] == folder))

    def changed_files(self, run: RunDirectory) -> dict[str, str]:
        """Return what happened to each file that is no stream and is not what it was, by name."""
        found: dict[str, str] = {}
        for name, entry in self.entries.items():
            if not name.endswith(SUFFIX):
                path = run.path / name
                now = file_entry(path) if path.is_file() else None
                _note(found, name, now, entry)
        return found

    def changed_streams(
        self, run: RunDirectory, scans: Mapping[Path, StreamScan]
    ) -> dict[str, str]:
        """Return what happened to each stream that is not what it was, by the name of its file."""
        found: dict[str, str] = {}
        for name, entry in self.entries.items():
            if name.endswith(SUFFIX):
                path = run.path / name
                scan = scans.get(path)
                if scan is not None:
                    now: dict[str, Any] | None = {"sha256": scan.sha256, "records": scan.records}
                else:  # a plug-in's own, in a folder of its own
                    now = file_entry(path) if path.is_file() else None
                _note(found, name, now, entry)
        return found


def _is_made_anew(name: str) -> bool:
    notes = (f"/{RETRIEVED_NAME}", f"/{MANIFEST_NAME}")
    is_note = name.startswith(MACHINES) and name.count("/") == 2 and name.endswith(notes)
    return is_note or name in MADE_ANEW or name.startswith(TABLES)


def _note(
    found: dict[str, str], name: str, now: Mapping[str, Any] | None, was: Mapping[str, Any]
) -> None:
    if now is None:
        found[name] = "missing; it was there when the run was collected"
    elif now["sha256"] != was.get("sha256"):
        counts = ""
        if "records" in was and now.get("records") != was["records"]:
            counts = f" ({now['records']} records, were {was['records']})"
        found[name] = f"changed since the run was collected{counts}"
