"""Tests that run in a guest: what each comes to goes out as a line at once, so that a guest that hangs has told of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

PORT = next(Path("/dev").glob("vport*p1"), None)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    if PORT is None or (report.when != "call" and report.passed):
        return
    told = {
        "name": f"{item.path.name}::{item.originalname}",
        "outcome": report.outcome if report.when == "call" else f"{report.when} {report.outcome}",
        "text": str(report.longrepr or "") + "".join(f"\n{n}:\n{t}" for n, t in report.sections),
        "duration_s": round(call.duration, 2),
    }
    with PORT.open("wb", buffering=0) as file:
        file.write(json.dumps(told).encode() + b"\n")
