"""Looks at what matters on this computer alone; nothing is judged."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import stat
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil

from cosmos_cli.evidence.run_directory import list_runs, runs_root
from cosmos_cli.system.import_turn import IMPORT_TURN

AGENT_TIMEOUT_S = 2.0
REQUEST_IDENTITIES = struct.pack(">IB", 1, 11)
"""Of the ssh agent's protocol (RFC draft-miller-ssh-agent, 4.4): a length, then the message's number."""
IDENTITIES_ANSWER = 12
RUNS_LOOKED_AT_MAX = 20
WRITABLE_BY_OTHERS = stat.S_IWGRP | stat.S_IWOTH
SEEN_BY_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def look_here(living: Sequence[str]) -> dict[str, Any]:
    """
    Return plain values.

    Args:
        living: Directories of runs that live here.
    """
    return {
        "open_files": resource.getrlimit(resource.RLIMIT_NOFILE)[0],
        "ssh_agent": _ssh_agent(os.environ.get("SSH_AUTH_SOCK", "")),
        "ssh_files": list(_ssh_problems(Path.home() / ".ssh")),
        "uv": _uv(),
        "cut_off": _cut_off(living),
    }


def interface_of(address: str) -> str:
    """Return the interface that has one of this computer's addresses; lo when none does. One behind % is a machine's."""
    address = address.partition("%")[0]
    for name, addresses in psutil.net_if_addrs().items():
        if any(item.address.partition("%")[0] == address for item in addresses):
            return str(name)
    return "lo"


def _ssh_agent(path: str) -> dict[str, Any]:
    """Ask the ssh agent how many keys it holds; null when nobody answers."""
    keys: int | None = None
    if path:
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as agent:
            agent.settimeout(AGENT_TIMEOUT_S)
            agent.connect(path)
            agent.sendall(REQUEST_IDENTITIES)
            answer = agent.recv(9, socket.MSG_WAITALL)
            if len(answer) == 9 and answer[4] == IDENTITIES_ANSWER:
                keys = struct.unpack(">I", answer[5:])[0]
    return {"socket": path, "keys": keys}


def _ssh_problems(folder: Path) -> Iterator[dict[str, str]]:
    """Find files that others may change, and private keys that others may read."""
    for path in (folder, folder / "config", folder / "known_hosts"):
        with contextlib.suppress(OSError):
            if path.stat().st_mode & WRITABLE_BY_OTHERS:
                yield {"found": f"others may write to {path}", "cure": f"chmod go-w {path}"}
    with contextlib.suppress(OSError):
        for path in sorted(folder.glob("id_*")):
            if path.suffix != ".pub" and path.stat().st_mode & SEEN_BY_OTHERS:
                yield {
                    "found": f"others may read {path}: OpenSSH will not use it",
                    "cure": f"chmod 600 {path}",
                }


def _uv() -> str | None:
    try:
        with IMPORT_TURN:
            import uv  # may be missing: that is the answer

        return str(uv.find_uv_bin())
    except (ImportError, FileNotFoundError):
        return None


def _cut_off(living: Sequence[str]) -> list[str]:
    """Return the latest runs whose summary says that they go on, although they do not."""
    alive = {os.path.realpath(path) for path in living}
    names = []
    for run in list_runs(runs_root())[-RUNS_LOOKED_AT_MAX:]:
        summary = run.read_json(run.run_json) or {}
        is_open = summary.get("status") == "running" and str(run.path) not in alive
        # Of one elsewhere its machine is asked.
        if is_open and not (run.read_json(run.plan_json) or {}).get("host"):
            names.append(run.name)
    return names
