"""
Runs a scenario many times in one process, and prints after each what that process holds.

    start_and_stop.py TIMES SCENARIO ARGUMENT...

One line of JSON a run on standard error.
"""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

from cosmos_cli.app import run


def held() -> dict[str, object]:
    """Return the kinds of open descriptors of this process, its threads and its children."""
    descriptors = []
    for link in Path("/proc/self/fd").iterdir():
        try:
            descriptors.append(os.readlink(link).split("[")[0])
        except FileNotFoundError:
            continue  # the one that listed the folder
    children = Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()
    return {
        "descriptors": sorted(descriptors),
        "threads": threading.active_count(),
        "children": len(children),
    }


if __name__ == "__main__":
    for _ in range(int(sys.argv[1])):
        code = run(["run", *sys.argv[2:]])
        sys.stderr.write(json.dumps({"code": code, **held()}) + "\n")
