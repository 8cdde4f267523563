"""
Check on a machine that the runtime runs there, and that datagrams come and go.

At one of three depths: a *look* finds the modules and starts nothing, a *start* has the environment's interpreter find
them, a *full* check imports all that an agent imports. None leaves anything behind: not even what Python compiles.
"""

from __future__ import annotations

import _socket  # what `socket` is made of: enough here, and a look is short of milliseconds
import contextlib
import os
import re
import sys
import time
from collections.abc import Mapping

from cosmos_cli.onboard import content_store
from cosmos_cli.onboard.installed import interpreter_path, site_folder
from cosmos_cli.onboard.request_loop import HelperRefusal, PlainValue, VerbRequest, last_words, verb

LOOK, FULL = "look", "full"
RUNTIME = "madns_runtime"
ECHO_WAITS_S = (0.3, 1.0, 4.0)
"""For the answer to each of the questions: a datagram may be lost, and who answers may have to wait for a processor."""
ECHO_BYTES_MAX = 256
VARIABLES = {"OPENBLAS_NUM_THREADS": "1", "PYTHONNOUSERSITE": "1"}
"""Variables of a run's programs: one thread per process, and nothing of the user's own packages."""
_VERSION = re.compile(rb'^__version__ = "([^"]+)"$', re.MULTILINE)

START_SCRIPT = """
import sys
import madns_runtime
missing = [name for name in {modules!r} if not any(
    finder.find_spec(name, None) for finder in sys.meta_path)]
if missing:
    sys.exit("no module named " + ", ".join(missing))
print(madns_runtime.__version__)
"""
FULL_SCRIPT = """
import importlib
import madns_runtime
import madns_runtime.agent
for name in {modules!r}:
    importlib.import_module(name)
if {simulation!r}:
    from pathlib import Path
    from madns_runtime.plugin.registry import load_half, resolve
    base = Path({base!r})
    load_half(resolve({simulation!r}, base), "agent", base)
print(madns_runtime.__version__)
"""


@verb("check_runtime")
def check_runtime(request: VerbRequest) -> dict[str, PlainValue]:
    """See that the runtime starts here as an agent will, and that datagrams come and go."""
    asked = request.arguments
    started_s = time.monotonic()
    version = _look(asked) if asked["depth"] == LOOK else None
    if version is None:
        version = _start(asked)
    start_s = time.monotonic() - started_s
    udp = asked.get("udp")
    return {
        "runtime": version,
        "start_ms": round(start_s * 1000, 1),
        "round_trip_ms": round_trip_ms(udp) if udp else None,
    }


def _look(asked: Mapping[str, PlainValue]) -> str | None:
    """
    Return the runtime's version, found by this process as one of the environment's interpreter would.

    None when that must be asked itself: it is another than this one, or something is not found. `bin/python` is a link
    to the interpreter that this very code runs on, and every file of environment and tree was just looked at, so a
    start of it proves nothing more, and costs more than all other questions together.
    """
    python = content_store.expand(asked["python"])
    if os.path.realpath(python) != interpreter_path():
        return None
    site = os.path.join(os.path.dirname(os.path.dirname(python)), site_folder(sys.version_info[:2]))
    folders = [content_store.expand(folder) for folder in asked["path"]]
    finder = sys.modules["_frozen_importlib_external"].PathFinder
    finder.invalidate_caches()
    if any(finder.find_spec(name, [*folders, site]) is None for name in asked["modules"]):
        return None
    runtime = finder.find_spec(RUNTIME, folders)
    if runtime is None or not runtime.origin:
        return None
    with open(runtime.origin, "rb") as file:
        found = _VERSION.search(file.read())
    return found[1].decode() if found else None


def _start(asked: Mapping[str, PlainValue]) -> str:
    """Return the version that the runtime tells, started there as an agent will be."""
    import subprocess  # a look at what is installed starts no process

    code = (FULL_SCRIPT if asked["depth"] == FULL else START_SCRIPT).format(
        modules=asked["modules"],
        simulation=asked.get("simulation", ""),
        base=content_store.expand(asked["base"]) if asked.get("base") else "/",
    )
    python = content_store.expand(asked["python"])
    path = os.pathsep.join(content_store.expand(folder) for folder in asked["path"])
    try:
        done = subprocess.run(
            [python, "-B", "-P", "-c", code],
            capture_output=True,
            timeout=asked["timeout_s"],
            env={**os.environ, **VARIABLES, "PYTHONPATH": path},
            check=False,
        )
    except FileNotFoundError:
        raise HelperRefusal("step", f"{python}: no such program", "repeat `cosmos up`") from None
    except subprocess.TimeoutExpired:
        raise HelperRefusal(
            "timeout", f"the runtime did not start in {asked['timeout_s']} s"
        ) from None
    if done.returncode:
        said = last_words(done.stderr) or f"exit status {done.returncode}"
        raise HelperRefusal("step", f"the runtime does not start there: {said}")
    version = done.stdout.decode(errors="replace").split()[-1:]
    return version[0] if version else ""


def round_trip_ms(udp: Mapping[str, PlainValue]) -> float:
    """Send a nonce to the operator until it comes back."""
    nonce = bytes.fromhex(udp["nonce_hex"])
    address, port = str(udp["address"]), int(udp["port"])
    said = ""
    try:
        family, _, _, _, where = _socket.getaddrinfo(address, port, 0, _socket.SOCK_DGRAM)[0]
        with contextlib.closing(_socket.socket(family, _socket.SOCK_DGRAM)) as link:
            for attempt, wait_s in enumerate(ECHO_WAITS_S):
                sent_s = time.monotonic()
                link.sendto(nonce + bytes([attempt]), where)
                if _comes_back(link, nonce, sent_s + wait_s):
                    return round((time.monotonic() - sent_s) * 1000, 3)
    except OSError as error:
        said = f" ({error.strerror or error})"
    raise HelperRefusal(
        "step",
        f"no UDP from here to {address}:{port}{said}",
        "is a firewall closing it? let UDP in on the operator's computer, or name the address by which"
        " this machine reaches it with cosmos_host_address",
    )


def _comes_back(link: _socket.socket, nonce: bytes, until_s: float) -> bool:
    while (left_s := until_s - time.monotonic()) > 0:
        link.settimeout(left_s)
        try:
            answer = link.recv(ECHO_BYTES_MAX)
        except (TimeoutError, ConnectionRefusedError):
            continue
        if answer[: len(nonce)] == nonce:
            return True
    return False
