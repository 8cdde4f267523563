"""What is installed on a machine: is it whole, does it run, does anybody still need it?"""

from __future__ import annotations

import os
import socket
import subprocess
import time
from typing import Any

from cosmos_cli.fleet.onboard import store
from cosmos_cli.fleet.onboard.core import Refusal, Request, last_words, verb
from cosmos_cli.fleet.onboard.environment import is_whole as is_environment_whole
from cosmos_cli.fleet.onboard.trees import is_whole as is_tree_whole

NEWEST_KEPT = 2
"""Of the trees of one label, and of the environments, that nobody asks for."""
ECHO_TRIES = 3
ECHO_WAIT_S = 0.3
ECHO_BYTES_MAX = 256
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYTHONNOUSERSITE": "1"}
"""As the programs of a run have them: one thread a process, and nothing of the user's own packages."""

LIGHT = """
import sys
import madns_runtime
missing = [name for name in {modules!r} if not any(
    finder.find_spec(name) for finder in sys.meta_path)]
if missing:
    sys.exit("no module named " + ", ".join(missing))
print(madns_runtime.__version__)
"""
FULL = """
import importlib, sys
import madns_runtime
import madns_runtime.agent
for name in {modules!r}:
    importlib.import_module(name)
if {simulation!r}:
    from pathlib import Path
    from madns_runtime.plugin.registry import load_half, resolve
    base = Path({base!r})
    load_half(resolve({simulation!r}, base), {role!r}, base)
print(madns_runtime.__version__)
"""


@verb("installed")
def installed(request: Request) -> dict[str, Any]:
    """
    Tell which trees and environments are there, and really what they should be.

    With "touch", those are also remembered as wanted now.
    """
    asked = request.arguments
    folders = {kind: store.expand(asked["folders"][kind]) for kind in asked["folders"]}
    wanted = {"trees": asked["trees"], "environments": asked["environments"]}
    whole = {
        "trees": {name: is_tree_whole(folders["trees"], name) for name in wanted["trees"]},
        "environments": {
            key: is_environment_whole(os.path.join(folders["environments"], key))
            for key in wanted["environments"]
        },
    }
    if asked.get("touch"):
        for kind, names in wanted.items():
            for name in names:
                store.touch_mark(os.path.join(folders[kind], name))
    return {**whole, "folders": folders, "prunable": _prunable(folders, wanted)}


@verb("prune_installed")
def prune_installed(request: Request) -> dict[str, Any]:
    """Remove the trees, environments and wheels that nobody needs."""
    asked = request.arguments
    folders = {kind: store.expand(asked["folders"][kind]) for kind in asked["folders"]}
    wanted = {"trees": asked["trees"], "environments": asked["environments"]}
    removed = _prunable(folders, wanted)
    for kind, names in removed.items():
        for name in names:
            store.remove(os.path.join(folders[kind], name))
    now_s = time.clock_gettime(time.CLOCK_REALTIME)
    for folder in folders.values():
        store.remove_left_overs(folder, now_s)
    return removed


@verb("check_runtime")
def check_runtime(request: Request) -> dict[str, Any]:
    """See that the runtime starts here as an agent will, and that datagrams come and go."""
    asked = request.arguments
    program = FULL if asked["is_full"] else LIGHT
    code = program.format(
        modules=asked["modules"],
        simulation=asked.get("simulation", ""),
        base=asked.get("base", ""),
        role=asked.get("role", "agent"),
    )
    python = store.expand(asked["python"])
    path = os.pathsep.join(store.expand(folder) for folder in asked["path"])
    started_s = time.monotonic()
    try:
        done = subprocess.run(
            [python, "-c", code],
            capture_output=True,
            timeout=asked["timeout_s"],
            env={**os.environ, **VARIABLES, "PYTHONPATH": path},
            cwd="/",
            check=False,
        )
    except FileNotFoundError:
        raise Refusal("step", f"{python}: no such program", "repeat `cosmos up`") from None
    except subprocess.TimeoutExpired:
        raise Refusal("timeout", f"the runtime did not start in {asked['timeout_s']} s") from None
    start_s = time.monotonic() - started_s
    if done.returncode:
        said = last_words(done.stderr) or f"exit status {done.returncode}"
        raise Refusal("step", f"the runtime does not start there: {said}")
    version = done.stdout.decode(errors="replace").split()[-1:]
    udp = asked.get("udp")
    return {
        "runtime": version[0] if version else "",
        "start_ms": round(start_s * 1000, 1),
        "round_trip_ms": _round_trip_ms(udp) if udp else None,
    }


def _round_trip_ms(udp: dict[str, Any]) -> float:
    """Send a nonce to the operator until it comes back."""
    nonce = bytes.fromhex(udp["nonce_hex"])
    address, port = str(udp["address"]), int(udp["port"])
    said = ""
    try:
        family, _, _, _, where = socket.getaddrinfo(address, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as link:
            for attempt in range(ECHO_TRIES):
                packet = nonce + bytes([attempt])
                sent_s = time.monotonic()
                link.sendto(packet, where)
                if _comes_back(link, nonce, sent_s + ECHO_WAIT_S):
                    return round((time.monotonic() - sent_s) * 1000, 3)
    except OSError as error:
        said = f" ({error.strerror or error})"
    raise Refusal(
        "step",
        f"no UDP from here to {address}:{port}{said}",
        "is a firewall closing it? let UDP in on the operator's computer, or name the address by which"
        " this machine reaches it with cosmos_host_address",
    )


def _comes_back(link: socket.socket, nonce: bytes, until_s: float) -> bool:
    while (left_s := until_s - time.monotonic()) > 0:
        link.settimeout(left_s)
        try:
            answer = link.recv(ECHO_BYTES_MAX)
        except (TimeoutError, ConnectionRefusedError):
            continue
        if answer[: len(nonce)] == nonce:
            return True
    return False


def _prunable(folders: dict[str, str], wanted: dict[str, Any]) -> dict[str, list[str]]:
    """Return what no living run uses, nobody asks for, and is not among the newest."""
    found: dict[str, list[str]] = {"trees": [], "environments": [], "wheels": []}
    for kind in wanted:
        paths = [os.path.join(folders[kind], name) for name in store.names_in(folders[kind])]
        kept = {os.path.join(folders[kind], name) for name in wanted[kind]}
        others = [path for path in paths if path not in kept]
        newest = _newest(others)  # of those only: what `up` sends now must not make its next plan prune
        rest = [path for path in others if path not in newest]
        in_use = store.used(rest)
        found[kind] = [os.path.basename(path) for path in rest if path not in in_use]
    gone = {os.path.join(folders["environments"], key) for key in found["environments"]}
    needed = set()
    for key in store.names_in(folders["environments"]):
        path = os.path.join(folders["environments"], key)
        if path not in gone:
            needed |= set((store.read_mark(path) or {}).get("wheels", ()))
    if found["environments"]:
        found["wheels"] = [w for w in store.names_in(folders["wheels"]) if w not in needed]
    return found


def _newest(paths: list[str]) -> set[str]:
    """Return the newest of each label; half-made ones are nobody's."""
    by_label: dict[str, list[tuple[float, str]]] = {}
    for path in paths:
        mark = store.read_mark(path)
        if mark is not None:
            when_s = os.stat(os.path.join(path, store.MARK)).st_mtime
            by_label.setdefault(str(mark.get("label", "")), []).append((when_s, path))
    return {
        path for found in by_label.values() for _, path in sorted(found, reverse=True)[:NEWEST_KEPT]
    }
