"""Wall time, for records alone: everything that acts uses the monotonic clock of its loop."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta


def utc_now_iso() -> str:
    """Return the wall time as ISO 8601 in UTC with microseconds and Z; for records, never for deadlines."""
    return utc_at_iso(0.0)


def utc_at_iso(in_s: float) -> str:
    """Return the wall time *in_s* seconds from now (negative: ago) in the form of `utc_now_iso`."""
    utc = datetime.now(UTC) + timedelta(seconds=in_s)
    return utc.isoformat(timespec="microseconds").replace("+00:00", "Z")
