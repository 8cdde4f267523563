"""What the tests of all kinds share: kernel modules, a device driven as in a run, its loss and return, verification."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from harness.cosmos_command import CosmosCommand

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import MachineError
from tests.hardware.bench import AGENT, DeviceBench
from tests.hardware.driving import opened

PLACE, NAME = "here", "device"
PATIENCE_S = 60.0
RETURN_S_MAX = 2.0
ATTEMPTS_MAX = 4
SLOWNESS = 10.0


def run(*command: str, timeout_s: float = 30.0) -> str:
    """Run a program, which must succeed, and return its output."""
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout_s, check=False, stdin=subprocess.DEVNULL
    )  # fmt: skip
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def load(module: str, *options: str) -> None:
    """Load a module of the kernel."""
    run("modprobe", module, *options)


def unload(module: str) -> None:
    """Take a module of the kernel away."""
    run("modprobe", "--remove", module)


def wait_until(is_so: Callable[[], Any], timeout_s: float = PATIENCE_S) -> Any:
    """Wait until something is so, and return it."""
    until_s = time.monotonic() + timeout_s
    while not (found := is_so()):
        assert time.monotonic() < until_s, f"not so within {timeout_s:g} s"
        time.sleep(0.02)
    return found


def write_file(path: Path | str, text: str) -> None:
    """Tell a file of the kernel something."""
    Path(path).write_text(text, encoding="ascii")


@contextlib.contextmanager
def driven(
    folder: Path, kind: str, parameters: Mapping[str, Any], *, rate_hz: float = 20.0
) -> Iterator[DeviceBench]:
    """Drive one device in its own process, as a run does; its outputs may move."""
    launch = DeviceLaunch(
        name=NAME, place=PLACE, kind=kind, base_directory=str(folder), rate_hz=rate_hz,
        parameters=parameters, users=(AGENT,), owner=AGENT, may_move=True,
    )  # fmt: skip
    bench = DeviceBench(folder, (launch,), lost_s=None)
    bench.start_time()
    try:
        yield bench
    finally:
        with contextlib.suppress(Exception):  # closed by the test itself
            bench.close()


def status_is(bench: DeviceBench, *statuses: str) -> Callable[[], bool]:
    """Return a question whether the device has one of these statuses."""
    return lambda: bench.hardware[NAME].status in statuses


def lose_and_regain(
    bench: DeviceBench,
    take_away: Callable[[], object],
    give_back: Callable[[], object],
    *,
    why: str,
) -> None:
    """
    Take a device away and give it back: it is lost with a reason, and back within 2 s.

    A busy computer may keep a guest waiting, so that one return in some has to be in time, and each has to be.
    """
    spent_s = []
    for _ in range(ATTEMPTS_MAX):
        bench.until(status_is(bench, "ok"), PATIENCE_S)
        take_away()
        bench.until(status_is(bench, "lost"), PATIENCE_S)
        bench.run(1.0)  # the back-off has reached its longest
        give_back()
        spent_s.append(bench.until(status_is(bench, "ok"), PATIENCE_S))
        if spent_s[-1] <= RETURN_S_MAX:
            break
    assert min(spent_s) <= RETURN_S_MAX, spent_s
    told = errors_told(bench)
    assert any(why in text for text in told), told


def errors_told(bench: DeviceBench) -> list[str]:
    """Return the reasons of the device's errors that are on record."""
    return [event["why"] for event in device_events(bench.folder) if event["event"] == "error"]


def device_events(folder: Path) -> list[dict[str, Any]]:
    """Return what befell the device, by its records."""
    file = folder / "devices" / PLACE / NAME / "events.jsonl"
    whole = file.read_text().rpartition("\n")[0] if file.exists() else ""
    lines = map(json.loads, whole.splitlines()[1:])
    return [line for line in lines if "event" in line]


def verify(folder: Path, kind: str, parameters: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """
    Return the rows of `cosmos devices verify`, by name, all of which must hold or be left out.

    An emulated processor is some ten times slower: what is held to seconds or to a rate may take so many
    times longer here.
    """
    file = folder / "parameters.yaml"
    file.write_text(json.dumps(parameters))  # JSON is YAML
    cosmos = CosmosCommand(folder)
    done = cosmos("devices", "verify", kind, "--parameters", file, "--write", "--json", "--quiet")
    rows = {row["name"]: row for row in json.loads(done.stdout)["findings"]}
    for row in rows.values():
        got_s, limit_s = (_seconds(row[key]) for key in ("got", "limit"))
        if got_s is not None and limit_s is not None and got_s <= SLOWNESS * limit_s:
            row["passed"] = True
    if (rate := rows.get("rate")) is not None and rate["passed"] is False:
        got_hz, limit_hz = (float(rate[key].partition(" Hz")[0]) for key in ("got", "limit"))
        rate["passed"] = got_hz >= limit_hz / SLOWNESS
    broken = [row for row in rows.values() if row["passed"] is False]
    assert not broken, broken
    return rows


def _seconds(text: str) -> float | None:
    """Return the seconds at the end of a text, such as of "open again after 0.31 s"."""
    *_, number, unit = ["", "", *text.split()]
    return float(number) if unit == "s" else None


def assert_refused(kind: str, told: str, **parameters: Any) -> None:
    """Open a device that cannot be opened, and hold the error against a pattern."""
    with pytest.raises(MachineError, match=told), opened(kind, **parameters):
        pass


@contextlib.contextmanager
def program(code: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run Python code in a process of its own until the end of the block."""
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], text=True)
    try:
        yield process
        assert process.poll() is None, "it ended before its time"
    finally:
        process.kill()
        process.wait()
