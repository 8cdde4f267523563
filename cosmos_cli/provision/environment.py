"""
Gives machines their environments, and asks them what is installed, whether it runs, and what nobody needs.

The operator's side of `cosmos_cli.onboard.environment`, `.installed` and `.runtime_check`.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from packaging.specifiers import SpecifierSet

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.provision.lock import normal_name
from cosmos_cli.provision.sent_wheels import RUNTIME_NAMES, SentWheel, sent_wheel
from cosmos_cli.provision.trees import Progress, no_progress
from cosmos_cli.provision.wheelhouse import Environment
from cosmos_cli.provision.wheels import cache_failures, see_verified

PIECE_BYTES = 1024 * 1024
"""More at once makes the SSH server there copy what it holds back over and over: measured 65 ms against 207 ms of its
processor for numpy in pieces of 4 MB."""
BUILD_TIMEOUT_S = 900.0
"""A slow card writes some megabytes a second, and an emulated board unpacks as slowly."""
LOOK_TIMEOUT_S = 120.0
START_TIMEOUT_S = 120.0
"""Of an interpreter that compiles all that it imports for the first time, on a slow board."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Installed:
    """A machine's answer on what is installed there."""

    trees: Mapping[str, bool]
    """Of each tree asked for: whether it is there and really of that content."""
    environments: Mapping[str, bool]
    prunable: Mapping[str, Sequence[str]]
    """By "trees", "environments" and "wheels": what nobody needs any more."""

    @classmethod
    def from_mapping(cls, mapping: Mapping[str, Any]) -> Installed:
        """Read the answer of the verb "installed"."""
        return cls(
            trees=mapping["trees"],
            environments=mapping["environments"],
            prunable=mapping["prunable"],
        )


CheckDepth = Literal["look", "start", "full"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RuntimeCheck:
    """Check of programs on a machine."""

    key: str
    """Of the environment."""
    trees: Sequence[str]
    """Hashes of the trees on the path, the runtime's first."""
    depth: CheckDepth
    """`look`: find what is to be imported; `start`: have the environment's Python find it; `full`: import it."""
    modules: Sequence[str] = ()
    """Names of the modules that wheels and the distribution brought."""
    simulation: str = ""
    """Of the scenario, whose agents' half is imported as well when all is."""
    base: str = ""
    """Hash of the scenario's tree."""
    udp: Mapping[str, Any] | None = None
    """Return value of `cosmos_cli.provision.udp_echo.Echo.question`; None leaves the network out."""


def installed_request(
    layout: Layout,
    *,
    trees: Sequence[str],
    environments: Sequence[str],
    touch: bool = False,
    is_strict: bool = False,
) -> dict[str, Any]:
    """
    Return the arguments of the verbs "installed" and "prune_installed".

    Args:
        layout: Of the machine.
        trees: Hashes of the trees that are wanted; never pruned.
        environments: Keys of the environments that are wanted; never pruned.
        touch: Whether these are remembered as wanted just now, so that no other operator prunes them.
        is_strict: Whether a file that was added to an environment makes it one that is to be built anew.
    """
    return {
        "folders": {
            "trees": layout.trees,
            "environments": layout.environments,
            "wheels": layout.wheels,
        },
        "compiled": layout.compiled,
        "trees": list(trees),
        "environments": list(environments),
        "touch": touch,
        "is_strict": is_strict,
    }


def ask_installed(helper: Helper, request: Mapping[str, Any]) -> Installed:
    """
    Ask a machine what is installed there.

    Args:
        helper: Started with `cosmos_cli.provision.STORE_PARTS`.
        request: Made by `installed_request`.

    Raises:
        MachineFailure: The connection is lost.
    """
    return Installed.from_mapping(helper.call("installed", request, timeout_s=LOOK_TIMEOUT_S).value)


def install_environment(
    helper: Helper, layout: Layout, environment: Environment, progress: Progress = no_progress
) -> bool:
    """
    See that an environment is on a machine; wheels that are there already are not sent.

    Args:
        helper: Started with `cosmos_cli.provision.STORE_PARTS`, holding the machine's lock.
        layout: Of the machine.
        environment: What is wanted.
        progress: Told while wheels are sent and installed.

    Returns:
        Whether anything was changed there.

    Raises:
        MachineFailure: The distribution's packages are missing or too old, a run uses what is to be rebuilt,
            the disk is full or read-only, or the connection is lost.
    """
    sent = _sent_wheels(environment)
    asked = {
        "folder": layout.environments,
        "wheels_folder": layout.wheels,
        "key": environment.key,
        "python": list(environment.platform.python),
        "sees_system": environment.content.sees_system,
        "wheels": [
            {
                "sha256": each.locked.sha256,
                "filename": each.locked.filename,
                "size": each.locked.size_bytes,
            }
            for each in sent
        ],
    }
    told: Mapping[str, Any] = helper.call("environment", asked, timeout_s=BUILD_TIMEOUT_S).value
    if told["changed"] or not told["missing"]:
        return bool(told["changed"])
    check_distribution(helper, environment)
    have = {each["sha256"]: each["have"] for each in told["missing"]}
    wheels = [(each, have[each.locked.sha256]) for each in sent if each.locked.sha256 in have]
    _send_wheels(helper, layout, wheels, progress)
    progress("installing", 1.0)
    told = helper.call("environment", asked, timeout_s=BUILD_TIMEOUT_S).value
    if told["missing"]:
        raise MachineFailure(
            FailureKind.DATA, "wheels that were sent are not there", "repeat the command"
        )
    return bool(told["changed"])


def pack_wheels(environment: Environment) -> None:
    """
    Pack an environment's wheels as they are sent, if they are not yet.

    A slow operator compiles for minutes: not while it holds a machine's lock, which is given up when nothing is asked.
    """
    _sent_wheels(environment)


def _sent_wheels(environment: Environment) -> list[SentWheel]:
    """Return the wheels as they are sent; those that they are made of are verified."""
    found = []
    for wheel in environment.lock:
        path = environment.wheel(wheel)
        with cache_failures():
            see_verified(path, wheel)
            found.append(sent_wheel(path, wheel, environment.platform))
    return found


def check_distribution(helper: Helper, environment: Environment) -> None:
    """
    See that the machine's distribution has what no wheel brings, new enough.

    Raises:
        MachineFailure: UNSUPPORTED: it has not; every package is named.
    """
    wanted = environment.content.distributed
    if not wanted:
        return
    names = {"names": [each.name for each in wanted]}
    found: Mapping[str, str | None] = helper.call("versions", names, timeout_s=LOOK_TIMEOUT_S).value
    faults, packages = [], []
    for each in wanted:
        version = found[each.name]
        needed = f"{each.name}{each.specifier}"
        if version is None:
            faults.append(f"{each.package} is not installed (needed: {needed})")
            packages.append(each.package)
        elif not SpecifierSet(each.specifier).contains(version, prereleases=True):
            faults.append(f"{each.package} brings {each.name} {version}, needed: {needed}")
    if faults:
        advice = (
            f"install them there: sudo apt-get install {' '.join(packages)}"
            if packages
            else "use a newer release of the distribution there, or a 64-bit one"
        )
        raise MachineFailure(
            FailureKind.UNSUPPORTED,
            f"no wheels are made for {environment.platform.label}, and of its distribution "
            + "; ".join(faults),
            advice,
        )


def check_request(layout: Layout, check: RuntimeCheck) -> dict[str, Any]:
    """Return the arguments of the verb "check_runtime"."""
    return {
        "python": layout.python(check.key),
        "path": [layout.tree(each) for each in check.trees],
        "depth": check.depth,
        "modules": list(check.modules),
        "simulation": check.simulation,
        "base": layout.tree(check.base) if check.base else "",
        "udp": check.udp,
        "timeout_s": START_TIMEOUT_S,
    }


def modules_of(environment: Environment) -> tuple[str, ...]:
    """Return the names under which the runtime's own requirements are imported."""
    names = {wheel.name for wheel in environment.lock}
    names |= {each.name for each in environment.content.distributed}
    return tuple(
        sorted(name.replace("-", "_") for name in map(normal_name, names) if name in RUNTIME_NAMES)
    )


def _send_wheels(
    helper: Helper,
    layout: Layout,
    wheels: Sequence[tuple[SentWheel, int]],
    progress: Progress,
) -> None:
    """Send wheels, each from the byte to which it has come there."""
    whole_bytes = sum(wheel.locked.size_bytes - have for wheel, have in wheels)
    sent_bytes = 0
    for wheel, have in wheels:
        see_verified(wheel.path, wheel.locked)
        try:
            for piece_bytes in _send_wheel(helper, layout, wheel, have):
                sent_bytes += piece_bytes
                progress(f"wheels {sent_bytes / 1e6:.1f} MB", sent_bytes / max(1, whole_bytes))
        except MachineFailure as failure:
            if failure.kind is not FailureKind.DATA or not have:
                raise
            for _ in _send_wheel(helper, layout, wheel, 0):
                pass  # what had come before is not its beginning, as after a power cut


def _send_wheel(helper: Helper, layout: Layout, wheel: SentWheel, have: int) -> Iterator[int]:
    """Send a wheel from byte *have* on; yield the size of each piece."""
    arguments = {
        "folder": layout.wheels,
        "sha256": wheel.locked.sha256,
        "filename": wheel.locked.filename,
        "size": wheel.locked.size_bytes,
        "is_verified": wheel.is_verified,
    }
    with (
        wheel.path.open("rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content,
    ):
        # All of it may have come, before the connection was cut.
        for offset in range(have, wheel.locked.size_bytes, PIECE_BYTES) or [have]:
            piece = content[offset : offset + PIECE_BYTES]
            helper.call(
                "wheel", {**arguments, "offset": offset}, body=piece, timeout_s=BUILD_TIMEOUT_S
            )
            yield len(piece)
