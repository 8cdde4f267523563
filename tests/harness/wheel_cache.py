"""One cache of wheels for all tests of a worker: to fetch and pack scipy takes ten seconds of a processor."""

from __future__ import annotations

import os
from pathlib import Path

VARIABLE = "COSMOS_TEST_WHEELS"
"""Names the folder that holds them; the session's first fixture sets it."""
SHARED = ("locks", "wheels")
"""What is known by its content or its question. How machines are reached is each test's own."""


def begin_cache(folder: Path) -> Path:
    """Make *folder* an operator's cache whose wheels are those of all tests of this worker."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in SHARED:
        kept = Path(os.environ[VARIABLE], name)
        kept.mkdir(parents=True, exist_ok=True)
        (folder / name).symlink_to(kept)
    return folder
