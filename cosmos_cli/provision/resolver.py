"""
The only place that asks a package index: uv resolves, pip downloads, both with the operator's settings.

Both run for another machine than this one. What they say is turned into words about a machine; passwords
in addresses are never repeated.
"""

from __future__ import annotations

import ast
import contextlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import uv
from packaging.specifiers import SpecifierSet
from packaging.version import InvalidVersion, Version

from cosmos_cli.cache import CACHE_VARIABLE
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision.lock import (
    DISTRIBUTION_PACKAGES,
    Candidate,
    Chosen,
    normal_name,
    parse_pylock,
)
from cosmos_cli.provision.platform import Platform
from cosmos_cli.system.bounded_process import run_bounded

RESOLVE_TIMEOUT_S = 300.0
DOWNLOAD_TIMEOUT_S = 3600.0
QUESTION_TIMEOUT_S = 60.0
LAST_LINES = 6
NO_WHEELS = re.compile(r"([A-Za-z0-9][\w.-]*)\S* ha(?:ve|s) no (?:usable )?wheels")
NO_NETWORK = re.compile(
    r"request failed|failed to fetch|error sending request|network was disabled|connection(?: was)? refused"
    r"|newconnectionerror|connecttimeout|readtimeout|temporary failure in name",
    re.IGNORECASE,
)
NO_ROOM = re.compile(r"no space left on device|disk quota exceeded", re.IGNORECASE)
SECRET = re.compile(r"://[^/@\s]+@")
NOBODYS_PROJECT = '[project]\nname = "nobody"\nversion = "0"\n[tool.uv.workspace]\n'
"""Else uv heeds that of the present folder, or of one above it, and what it finds is remembered for all folders."""
EXTRA_INDEXES = ("UV_INDEX", "UV_EXTRA_INDEX_URL")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--no-input")


def resolve(requirements: Sequence[str], platform: Platform) -> tuple[Candidate, ...]:
    """
    Decide on a version of every package that these requirements need on a platform.

    Raises:
        MachineFailure: They cannot be met there, or the index cannot be reached.
    """
    where = ["--python-platform", platform.resolver_name] if platform.resolver_name else None
    command = [
        *(uv.find_uv_bin(), "pip", "compile", "-", "--quiet", "--no-header", "--no-annotate"),
        *("--format", "pylock.toml", "--only-binary", ":all:", "--no-python-downloads"),
        *("--python", sys.executable, "--python-version", platform.python_text),
        *(where or ["--universal"]),  # uv knows no 32-bit ARM: ask for all, choose here
    ]
    settings = pip_settings()
    if settings.get("no-index") in ("1", "true", "yes", "on"):
        command.append("--no-index")
    with _private_file("pyproject.toml", NOBODYS_PROJECT) as project:
        done = _run(
            [command[0], "--project", str(project.parent), *command[1:]],
            timeout_s=RESOLVE_TIMEOUT_S,
            stdin="\n".join([*index_lines(settings, os.environ), *requirements]),
            environment=uv_environment(settings, os.environ),
        )
    if done.returncode:
        raise _resolve_failure(done.stderr, requirements, platform)
    return parse_pylock(done.stdout, platform)


def download(chosen: Sequence[Chosen], folder: Path, platform: Platform) -> None:
    """
    Download wheels into a folder, each verified by its hash.

    Raises:
        MachineFailure: The index cannot be reached, or what it gave is not what was decided on.
    """
    pins = "".join(f"{_pin(each)}\n" for each in chosen)
    with _private_file("wheels.txt", pins) as wanted:  # not in argv: an address may hold a password
        command = [*PIP, "download", "--quiet", "--no-deps", "--require-hashes"]
        command += ["--requirement", str(wanted), "--dest", str(folder), *_pip_platform(platform)]
        done = _run(command, timeout_s=DOWNLOAD_TIMEOUT_S, environment=pip_environment(os.environ))
    if done.returncode:
        names = ", ".join(each.locked.filename for each in chosen)
        if NO_ROOM.search(done.stderr):
            raise _no_room(done.stderr)
        if NO_NETWORK.search(done.stderr):
            raise _unreachable(done.stderr)
        raise MachineFailure(
            FailureKind.STEP, f"cannot download {names}: {last_lines(done.stderr)}", "repeat"
        )


def newest_version(
    name: str, specifier: str, platform: Platform, *, with_wheel: bool
) -> str | None:
    """
    Return the newest version of a package that an index has; None when that cannot be found out.

    Args:
        name: Of the package.
        specifier: Which versions count.
        platform: Of the machine; versions for another Python do not count.
        with_wheel: Count only those with a wheel for the platform, else those in any form.
    """
    where = _pip_platform(platform) if with_wheel else ["--python-version", platform.python_text]
    command = [*PIP, "index", "versions", name, "--json", *where]
    done = _run(command, timeout_s=QUESTION_TIMEOUT_S, environment=pip_environment(os.environ))
    try:
        versions = [Version(text) for text in json.loads(done.stdout)["versions"]]
    except (ValueError, KeyError, TypeError, InvalidVersion):
        return None
    matching = list(SpecifierSet(specifier).filter(versions))
    return str(max(matching)) if matching else None


def pip_settings() -> dict[str, str]:
    """Return pip's own settings, from its files and its environment; the more special wins."""
    done = _run([*PIP, "config", "list"], timeout_s=QUESTION_TIMEOUT_S)
    found: dict[str, dict[str, str]] = {}
    for line in done.stdout.splitlines():
        place, _, value = line.partition("=")
        section, _, key = place.rpartition(".")
        with contextlib.suppress(ValueError, SyntaxError):
            found.setdefault(section, {})[key] = str(ast.literal_eval(value))
    return {
        key: value
        for section in ("global", "download", ":env:")
        for key, value in found.get(section, {}).items()
    }


def index_lines(settings: Mapping[str, str], environment: Mapping[str, str]) -> list[str]:
    """
    Return the indexes that pip sees, as lines of requirements for uv; what is said to uv itself wins.

    An address may hold a password, which has no business in arguments or in the environment.
    """
    own_names = {
        "index-url": ("UV_DEFAULT_INDEX", "UV_INDEX_URL"),
        "extra-index-url": EXTRA_INDEXES,
        "find-links": ("UV_FIND_LINKS",),
    }
    return [
        f"--{setting} {value}"
        for setting, names in own_names.items()
        if not any(name in environment for name in names)
        for value in settings.get(setting, "").split()
        if _can_be_looked_at(value)
    ]


def _can_be_looked_at(place: str) -> bool:
    """Tell whether a place of packages is an address or there: pip passes over a folder that is not, uv ends."""
    return "://" in place or Path(place).expanduser().exists()


def uv_environment(settings: Mapping[str, str], environment: Mapping[str, str]) -> dict[str, str]:
    """
    Return an environment in which uv reaches indexes as pip does; what is said to uv itself wins.

    pip takes the best version that any of its indexes has; uv would stop at the first index that knows
    the name, which finds other versions than pip.
    """
    told = dict(environment)
    passed = {
        "UV_INSECURE_HOST": ("", " ".join(settings.get("trusted-host", "").split())),
        "SSL_CERT_FILE": ("", settings.get("cert")),
        "ALL_PROXY": ("HTTPS_PROXY", settings.get("proxy")),
    }
    for name, (older_name, value) in passed.items():
        if value and name not in told and older_name not in told:
            told[name] = value
    if settings.get("extra-index-url") and not any(name in told for name in EXTRA_INDEXES):
        told.setdefault("UV_INDEX_STRATEGY", "unsafe-best-match")
    return told


def pip_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment in which pip sees the indexes that uv was told of; what is said to pip wins."""
    told = dict(environment)
    for name, older_name in (
        ("PIP_INDEX_URL", "UV_DEFAULT_INDEX"),
        ("PIP_INDEX_URL", "UV_INDEX_URL"),
        ("PIP_EXTRA_INDEX_URL", "UV_EXTRA_INDEX_URL"),
        ("PIP_CERT", "SSL_CERT_FILE"),
    ):
        if older_name in told:
            told.setdefault(name, told[older_name])
    return told


def last_lines(text: str) -> str:
    """Return the end of what a program said, without passwords."""
    lines = [line.rstrip() for line in text.strip().splitlines() if line.strip()]
    return SECRET.sub("://***@", "\n".join(lines[-LAST_LINES:]))


def no_wheel(name: str, text: str, platform: Platform, *, pin: str = "") -> MachineFailure:
    """
    Return the failure of a requirement that has no wheel for a platform.

    Args:
        name: Of the package.
        text: What was found, behind its name.
        platform: Of the machine.
        pin: A version that has one, if there is any.
    """
    known = DISTRIBUTION_PACKAGES.get(normal_name(name), "python3-... there")
    pinned = f"pin the older one if it will do ({name}=={pin}), or " if pin else ""
    return MachineFailure(
        FailureKind.UNSUPPORTED,
        f"{name}: {text} {platform.label}",
        f"{pinned}take it from the machine's distribution: {known} under cosmos_packages in the inventory"
        f" instead of {name} under the requirements",
    )


def _resolve_failure(said: str, requirements: Sequence[str], platform: Platform) -> MachineFailure:
    if NO_ROOM.search(said):
        return _no_room(said)
    lacking = NO_WHEELS.search(" ".join(said.split()))
    if lacking:
        written = {normal_name(name): name for name in map(_name_of, requirements)}
        name = written.get(normal_name(lacking[1]), lacking[1])
        return no_wheel(name, "no wheel for", platform)
    if NO_NETWORK.search(said):
        return _unreachable(said)
    return MachineFailure(
        FailureKind.UNSUPPORTED,
        f"the requirements cannot be met for {platform.label}: {last_lines(said)}",
        "correct `requirements` in the scenario or cosmos_requirements in the inventory",
    )


@contextlib.contextmanager
def _private_file(name: str, text: str) -> Iterator[Path]:
    """
    Keep a file in a folder of its own that nobody else may enter, and that goes.

    Raises:
        MachineFailure: DISK_FULL, this computer has no room for it.
    """
    with contextlib.ExitStack() as kept:
        try:
            folder = kept.enter_context(tempfile.TemporaryDirectory(prefix="cosmos-"))
            path = Path(folder, name)
            path.write_text(text)
        except OSError as error:  # FileNotFoundError, where no folder for such files takes one
            raise _without_room(error.strerror or str(error)) from None
        yield path


def _no_room(said: str) -> MachineFailure:
    line = next(line for line in said.splitlines() if NO_ROOM.search(line))
    return _without_room(last_lines(line.strip()))


def _without_room(said: str) -> MachineFailure:
    return MachineFailure(
        FailureKind.DISK_FULL,
        f"no room on this computer for what machines need: {said}",
        f"make room where that is, or name other folders with {CACHE_VARIABLE} (wheels), UV_CACHE_DIR and TMPDIR",
    )


def _unreachable(said: str) -> MachineFailure:
    return MachineFailure(
        FailureKind.STEP,
        f"this computer cannot reach the package index: {last_lines(said)}",
        "connect it to the internet, or name an index that it can reach (pip config set global.index-url"
        " URL); once this has worked, it works without for machines of this kind",
    )


def _pin(chosen: Chosen) -> str:
    locked = chosen.locked
    where = f"{locked.name} @ {chosen.url}" if chosen.url else f"{locked.name}=={locked.version}"
    return f"{where} --hash=sha256:{locked.sha256}"


def _name_of(requirement: str) -> str:
    match = re.match(r"\s*([A-Za-z0-9][\w.-]*)", requirement)
    return match[1] if match else requirement


def _pip_platform(platform: Platform) -> list[str]:
    tags = [part for tag in platform.platform_tags() for part in ("--platform", tag)]
    return [*("--only-binary", ":all:", "--implementation", "cp"), *tags] + [
        "--python-version",
        platform.python_text,
    ]


def _run(
    command: Sequence[str],
    *,
    timeout_s: float,
    stdin: str = "",
    environment: Mapping[str, str] | None = None,
) -> subprocess.CompletedProcess[str]:
    try:
        return run_bounded(command, timeout_s=timeout_s, stdin=stdin, environment=environment)
    except subprocess.TimeoutExpired:
        raise MachineFailure(
            FailureKind.TIMEOUT,
            f"the package index did not answer in {timeout_s:g} s ({Path(command[0]).name} on this computer)",
            "look at this computer's connection, then repeat",
        ) from None
