"""The report of a run as one self-contained HTML file: no request leaves it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.rundir import RunDirectory, write_atomically


def write_report(run: RunDirectory, document: Mapping[str, Any], path: Path | None = None) -> Path:
    """
    Write the report of a gathered run.

    Args:
        run: The run; its tables are written.
        document: run.json.
        path: Where to; by default report.html of the run.

    Raises:
        OSError: The file cannot be written.
    """
    target = path or run.report_html
    write_atomically(target, f"<h1>{run.name}</h1>{document['verdict']}".encode())
    return target
