"""
Environments for machines without internet: resolved and downloaded here, remembered in a cache.

    <cache>/locks/<hash of what was asked>.json    what an environment is made of
    <cache>/wheels/<sha256>/<wheel>                 shared by all runs and all machines

When nothing changed no process is started and no network is needed. Safe for threads and processes. What was
not used for a long time goes when something new comes (`cosmos_cli.provision.wheels.remove_unused`).
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
import os
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement
from packaging.version import Version

from cosmos_cli.cache import cache_folder
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.models.device_needs import MachineNeeds
from cosmos_cli.models.inventory import Variables
from cosmos_cli.provision import resolver
from cosmos_cli.provision.lock import (
    DISTRIBUTION_PACKAGES,
    Candidate,
    Chosen,
    Distributed,
    Lock,
    Locked,
    choose,
    normal_name,
    with_specifiers,
)
from cosmos_cli.provision.platform import Platform, greeted_platform, wheel_rank
from cosmos_cli.provision.trees import DISTRIBUTION, Progress, no_progress
from cosmos_cli.provision.wheels import (
    cache_failures,
    fetch,
    is_own_wheel,
    lacking,
    own_wheel,
    remove_unused,
    requirements_of,
    wheel_path,
)
from cosmos_cli.system.file_lock import LockHeld, locked
from cosmos_cli.system.ownership import read_own_file
from madns_runtime.partial_file import write_whole

SCHEMA = 1
"""Of what is remembered; what another one wrote is resolved anew."""
TRUTH_EXTRA = "truth"
SYSTEM_PREFIX = "python3-"
FAILURE_KEPT_S = 30.0
"""Other machines of a kind need not wait for the same answer; a later command asks anew."""
LOCK_BYTES_MAX = 16 * 1024 * 1024
LOCK_TIMEOUT_S = 3600.0

_failures: dict[str, tuple[float, MachineFailure]] = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Environment:
    """A virtual environment that machines can be given; made by `prepare`."""

    content: Lock
    wheels: Path
    """Folder of the wheels here, each in a folder named after its hash."""

    @property
    def key(self) -> str:
        """Return its name on machines: the hash of what it is made of."""
        return self.content.key

    @property
    def platform(self) -> Platform:
        """Return what it is made for."""
        return self.content.platform

    @property
    def lock(self) -> tuple[Locked, ...]:
        """Return its wheels."""
        return self.content.wheels

    @property
    def distribution_packages(self) -> tuple[str, ...]:
        """Return the system packages that a machine must have before it can be installed."""
        return tuple(each.package for each in self.content.distributed)

    def size_bytes(self, there: Collection[str] = ()) -> int:
        """Return what it takes on a machine at most: its wheels as they come, and unpacked; none that is *there*."""
        missing = (wheel for wheel in self.lock if wheel.dist_info not in there)
        return sum(wheel.size_bytes + wheel.installed_bytes for wheel in missing)

    def wheel(self, locked: Locked) -> Path:
        """Return where one of its wheels is here."""
        return wheel_path(self.wheels, locked)


def sees_system_packages(packages: Iterable[str]) -> bool:
    """Tell whether a machine's system packages (cosmos_packages) hold any that Python code imports."""
    return any(package.startswith(SYSTEM_PREFIX) for package in packages)


def prepare(
    platform: Platform,
    requirements: Sequence[str],
    *,
    is_host: bool = False,
    sees_system: bool = False,
    progress: Progress = no_progress,
) -> Environment:
    """
    Return the environment for a machine, its wheels downloaded.

    Args:
        platform: Of the machine.
        requirements: Of the scenario and of the machine, beyond what the runtime needs.
        is_host: Whether the host's half runs there.
        sees_system: Whether the distribution's Python packages can be imported; see `sees_system_packages`.
        progress: Told what takes long.

    Raises:
        MachineFailure: A requirement has no wheel for such a machine, or the index cannot be reached.
    """
    need = EnvironmentNeed.of(platform, requirements, is_host=is_host, sees_system=sees_system)
    return prepare_needed(need, progress)


def prepare_needed(need: EnvironmentNeed, progress: Progress = no_progress) -> Environment:
    """Return what is needed, its wheels downloaded; see `prepare`. Also fails when the cache takes nothing."""
    cache = cache_folder()
    path = need.path(cache)
    content = _read_lock(path)
    if content is None or lacking(content.wheels, cache / "wheels"):
        with cache_failures(), _locked(path.with_suffix(".lock")):
            content = _read_lock(path) or _make_lock(path, need, cache, progress)
            chosen = [Chosen(locked=wheel) for wheel in content.wheels]
            fetch(chosen, cache / "wheels", need.platform, progress)
    return Environment(content=content, wheels=cache / "wheels")


def environment_key(need: EnvironmentNeed) -> str:
    """
    Return the key of an environment; its wheels may be gone from the cache, as machines have them.

    Raises:
        MachineFailure: As `prepare`, for one that was never prepared here.
    """
    content = _read_lock(need.path(cache_folder()))
    return prepare_needed(need).key if content is None else content.key


def remembered_key(need: EnvironmentNeed) -> str | None:
    """Return the key of an environment; None for one that was never prepared here. Asks nobody."""
    content = _read_lock(need.path(cache_folder()))
    return None if content is None else content.key


@dataclass(frozen=True, slots=True, kw_only=True)
class EnvironmentNeed:
    """Needs of an environment."""

    platform: Platform
    requirements: tuple[str, ...]
    is_host: bool
    sees_system: bool

    @classmethod
    def of(
        cls,
        platform: Platform,
        requirements: Sequence[str],
        *,
        is_host: bool = False,
        sees_system: bool = False,
    ) -> EnvironmentNeed:
        """Return a need; requirements in any order, however often each is named."""
        return cls(
            platform=platform,
            requirements=tuple(sorted({text.strip() for text in requirements})),
            is_host=is_host,
            sees_system=sees_system,
        )

    @classmethod
    def of_machine(
        cls,
        greeting: Mapping[str, Any],
        variables: Variables,
        requirements: Sequence[str],
        *,
        is_host: bool,
        needs: MachineNeeds,
    ) -> EnvironmentNeed:
        """
        Return the need of a machine.

        Args:
            greeting: First words of its helper.
            variables: The machine's, of the inventory.
            requirements: Of the scenario, beside the machine's own.
            is_host: Whether the host's half runs there.
            needs: Of its devices.
        """
        return cls.of(
            greeted_platform(greeting),
            (*(variables.cosmos_requirements or ()), *requirements, *needs.requirements),
            is_host=is_host,
            sees_system=needs.sees_system or sees_system_packages(variables.cosmos_packages or ()),
        )

    def path(self, cache: Path) -> Path:
        """Return where the answer is remembered."""
        platform = self.platform
        asked = {
            "schema": SCHEMA,
            "platform": [platform.python, platform.machine, platform.libc_version],
            "runtime": sorted(importlib.metadata.requires(DISTRIBUTION) or ()),
            "requirements": self.requirements,
            "is_host": self.is_host,
            "sees_system": self.sees_system,
        }
        name = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
        return cache / "locks" / f"{name}.json"

    def runtime_requirements(self) -> tuple[str, ...]:
        """Return what the installed distribution says that the runtime needs on such a machine."""
        extra = TRUTH_EXTRA if self.is_host else ""
        known = map(Requirement, importlib.metadata.requires(DISTRIBUTION) or ())
        needed = [each for each in known if self.platform.needs(each, extra=extra)]
        return tuple(sorted(f"{each.name}{each.specifier}" for each in needed))


def _make_lock(path: Path, need: EnvironmentNeed, cache: Path, progress: Progress) -> Lock:
    failed_s, failure = _failures.get(str(path), (0.0, None))
    if failure is not None and time.monotonic() - failed_s < FAILURE_KEPT_S:
        raise failure
    try:
        content = _resolve(need, cache, progress)
    except MachineFailure as error:
        _failures[str(path)] = (time.monotonic(), error)
        raise
    write_whole(path, json.dumps(content.to_mapping(), indent=1).encode())
    remove_unused(cache, now_s=time.clock_gettime(time.CLOCK_REALTIME))
    return content


def _resolve(need: EnvironmentNeed, cache: Path, progress: Progress) -> Lock:
    platform = need.platform
    own = [own_wheel(text) for text in need.requirements if is_own_wheel(text)]
    indexed = tuple(text for text in need.requirements if not is_own_wheel(text))
    _check(indexed)
    _expect_fitting([locked for locked, _ in own], platform)
    everything = [*need.runtime_requirements(), *indexed, *_requirements_of_own(own, platform)]
    progress(f"resolving {len(everything)} requirements for {platform.label}", 0.0)
    chosen, missing = choose(resolver.resolve(everything, platform), platform)
    distributed = _distributed(missing, platform)
    _refuse_ancient(need, {candidate.name for candidate in missing})
    fetched = fetch(chosen, cache / "wheels", platform, progress)
    wheels = (*fetched, *(locked for locked, _ in own))
    for wheel in wheels:
        everything += requirements_of(wheel_path(cache / "wheels", wheel))
    return Lock(
        platform=platform,
        wheels=wheels,
        distributed=with_specifiers(distributed, everything, platform),
        sees_system=need.sees_system or bool(distributed),
    )


def _expect_fitting(own: Sequence[Locked], platform: Platform) -> None:
    for wheel in own:
        if wheel_rank(wheel.filename, platform) is None:
            raise MachineFailure(
                FailureKind.UNSUPPORTED,
                f"{wheel.filename} is no wheel for {platform.label}",
                "name one that is, or its sources if they are of Python alone",
            )


def _requirements_of_own(own: Sequence[tuple[Locked, Path]], platform: Platform) -> list[str]:
    """Return what distributions of one's own need of an index: what they need of each other is there."""
    known = {DISTRIBUTION, *(locked.name for locked, _ in own)}
    found = []
    for text in (text for _, path in own for text in requirements_of(path)):
        requirement = Requirement(text)
        if platform.needs(requirement) and normal_name(requirement.name) not in known:
            found.append(text)
    return found


def _check(requirements: Sequence[str]) -> None:
    for text in requirements:
        try:
            requirement = Requirement(text)
        except InvalidRequirement as error:
            reason = str(error).splitlines()[0]
        else:
            if requirement.url is None:
                continue
            reason = "an address; what no index has belongs into the scenario's folder"
        raise MachineFailure(
            FailureKind.UNSUPPORTED,
            f"requirement {resolver.SECRET.sub('://***@', text)!r}: expected a name and versions such as"
            f" pyproj>=3.6, got {reason}",
            "correct `requirements` in the scenario or cosmos_requirements in the inventory",
        )


def _distributed(missing: Sequence[Candidate], platform: Platform) -> tuple[Distributed, ...]:
    """Return what 32-bit ARM takes from its distribution, because nobody makes wheels of it."""
    found = []
    for candidate in missing:
        package = DISTRIBUTION_PACKAGES.get(candidate.name)
        if package is None or not platform.is_32_bit:
            raise resolver.no_wheel(
                candidate.name, f"{candidate.version} has no wheel for", platform
            )
        found.append(Distributed(name=candidate.name, package=package))
    return tuple(found)


def _refuse_ancient(need: EnvironmentNeed, missing: set[str]) -> None:
    """
    Refuse a version that is taken only because newer ones have no wheel for the machine.

    Resolvers go back in time silently: for Python 3.13 they find lgpio of 2020. Who wants that says so.
    """
    platform = need.platform
    for requirement in map(Requirement, need.requirements):
        if requirement.url is not None:  # a wheel of one's own: nobody has a newer one
            continue
        name, specifier = requirement.name, str(requirement.specifier)
        is_pinned = any(each.operator in ("==", "===") for each in requirement.specifier)
        if is_pinned or not platform.needs(requirement) or normal_name(name) in missing:
            continue
        newest = resolver.newest_version(name, specifier, platform, with_wheel=False)
        usable = resolver.newest_version(name, specifier, platform, with_wheel=True)
        if newest and usable and Version(usable) < Version(newest):
            text = f"{newest} has no wheel for"
            raise resolver.no_wheel(name, text, platform, pin=usable)


def _read_lock(path: Path) -> Lock | None:
    """Return what is remembered, which then counts as used now; None if nothing is."""
    try:
        content = Lock.from_mapping(json.loads(read_own_file(path, bytes_max=LOCK_BYTES_MAX)))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return content


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock between threads and processes; the kernel drops it when its holder dies."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with locked(path, timeout_s=LOCK_TIMEOUT_S):
            yield
    except LockHeld as held:
        raise MachineFailure(
            FailureKind.BUSY,
            f"another command on this computer holds {path}: {held}",
            "wait for its end, then repeat",
        ) from None
