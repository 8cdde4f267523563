"""The report's chapter on devices: what each came to. Their channels over time are drawn as any stream is."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.evidence.verdict import is_number
from cosmos_cli.report.device_temperature import temperature_blocks
from madns_runtime.analysis.tables import RecordedRun
from madns_runtime.analysis.values import Heading, Section, TableBlock
from madns_runtime.plain_values import mapping_at

COLUMNS = {
    "status": "status",
    "samples": "samples",
    "errors": "errors",
    "stale_ratio": "stale or missing, share",
    "lost": "times lost",
    "restarts": "restarts",
    "frozen": "times frozen",
    "why": "why it was lost",
}
WORDS = ("status", "why")


def is_told_in_words(table: str) -> bool:
    """Tell whether a table holds a device's events or log, which are not drawn."""
    return table.startswith("device_") and table.endswith((".events", ".log"))


def device_sections(document: Mapping[str, Any], run: RecordedRun, folder: Path) -> list[Section]:
    """Return the chapter; none of a run without devices. *folder* is the run's directory."""
    devices = mapping_at(document, "devices")
    if not devices:
        return []
    rows = [
        [name, *(mapping_at(devices, name).get(key) for key in COLUMNS), _counts(devices, name)]
        for name in devices
    ]
    table = TableBlock(
        title="What devices came to",
        headings=[
            Heading(text="device", is_number=False),
            *(Heading(text=text, is_number=key not in WORDS) for key, text in COLUMNS.items()),
            Heading(text="counted", is_number=False),
        ],
        rows=rows,
        note="What nobody has given account of was not measured, and breaks its check.",
    )
    return [Section(title="Devices", blocks=[table, *temperature_blocks(run, folder)])]


def _counts(devices: Mapping[str, Any], name: str) -> str:
    counts = mapping_at(devices, name, "counts")
    return ", ".join(
        f"{key} {value:g}" for key, value in counts.items() if is_number(value) and value
    )
