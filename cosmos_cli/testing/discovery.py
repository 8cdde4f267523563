"""Scenarios in files and folders, those of them that are meant, and each one's tests."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.document import read_document
from cosmos_cli.models.scenario_outline import ScenarioOutline, is_scenario, read_outline
from cosmos_cli.models.yaml_source import FILE_BYTES_MAX, UTF_16, read_source
from cosmos_cli.provision.tree_rules import is_folder_of_tree, is_name_of_tree
from cosmos_cli.testing.case import CaseSettings, SuiteCase, make_cases
from cosmos_cli.testing.expression import Matcher
from madns_runtime.bounded_files import read_regular_file, real_path
from madns_runtime.errors import MissingExtraError

SUFFIXES: Final = (".yaml", ".yml")
FILES_MAX: Final = 10_000
CASES_MAX: Final = 20_000
_SIMULATION: Final = re.compile(r"""(?:^|[{,])[ \t]*["']?simulation["']?[ \t]*:""", re.MULTILINE)
_FIRST: Final = re.compile(r"^(?:---)?([ \t]*)(?!---)([^\s#%])", re.MULTILINE)
"""The indentation and the first character of what is written at the top level."""
DEFAULT_FOLDERS: Final = (Path("scenarios"), Path())
"""Looked into if no path is given: the first that is there."""


@dataclass(slots=True, kw_only=True)
class FoundScenarios:
    """Scenarios of files and folders."""

    outlines: list[ScenarioOutline] = field(default_factory=list)
    others: list[Path] = field(default_factory=list)
    """Files of folders that are YAML and no scenarios."""
    links: list[Path] = field(default_factory=list)
    """Links to folders, whose scenarios are not looked for: one may lead back."""
    faults: list[Fault] = field(default_factory=list)


def find_scenarios(paths: Sequence[Path]) -> FoundScenarios:
    """
    Return the scenarios of files, and those in and below folders.

    A file that is named is one; of a folder's files those are that have a name and a simulation; one that cannot be
    read is at fault if it seems to have them. One without a simulation that another one extends is a base of it. Left out are what travels with no scenario either (folders whose name
    begins with a dot, runs, virtual environments, caches) and links to folders.

    Raises:
        InputError: A path is missing, a folder cannot be read, or the folders hold too many files.
    """
    found = FoundScenarios()
    missing = [path for path in paths if not os.path.exists(path)]
    if missing:
        told = ", ".join(map(str, missing))
        raise InputError(f"{told}: no such file or folder; name scenarios or folders of them")
    seen: set[Path] = set()
    for path in paths or (next(each for each in DEFAULT_FOLDERS if each.is_dir()),):
        files = [(path, True)] if os.path.isfile(path) else _all_below(path, found.links)
        for file, is_named in files:
            if real_path(file) not in seen:
                seen.add(real_path(file))
                _add(found, file, is_named=is_named)
    _leave_out_bases(found, {real_path(path) for path in paths})
    return found


def _leave_out_bases(found: FoundScenarios, named: set[Path]) -> None:
    """Leave out what has no simulation, alone or by what it extends, and gets one in a scenario that extends it."""
    bases = {base for outline in found.outlines for base in outline.bases} - named
    for outline in list(found.outlines):
        if "simulation" not in outline.document.value and real_path(outline.path) in bases:
            found.outlines.remove(outline)
            found.others.append(outline.path)


def _all_below(folder: Path, links: list[Path]) -> list[tuple[Path, bool]]:
    try:
        return _files_below(folder, links)
    except RecursionError:
        raise InputError(f"{folder}: folders nest too deeply there; name folders of it") from None


def _files_below(folder: Path, links: list[Path]) -> list[tuple[Path, bool]]:
    """Return files, none of them named; links to folders are added to *links*."""
    files: list[tuple[Path, bool]] = []
    for here, folders, names in os.walk(folder, onerror=_refuse):
        folders[:] = sorted(
            name
            for name in folders
            if is_name_of_tree(name) and is_folder_of_tree(Path(here) / name)
        )
        links += [Path(here) / name for name in folders if os.path.islink(os.path.join(here, name))]
        files += [(Path(here) / name, False) for name in sorted(names) if name.endswith(SUFFIXES)]
        if len(files) > FILES_MAX:
            raise InputError(
                f"{folder}: expected at most {FILES_MAX} YAML files; name folders of it"
            )
    return files


def _refuse(error: OSError) -> None:
    if isinstance(error, FileNotFoundError):  # removed meanwhile, as runs are
        return
    text = f"{error.filename}: cannot be read: {error.strerror}; name the folders that are meant"
    raise InputError(text) from error


def _add(found: FoundScenarios, file: Path, *, is_named: bool) -> None:
    try:
        if not is_named and not is_scenario(read_document(read_source(file))):
            found.others.append(file)
            return
        found.outlines.append(read_outline(file))
    except InputError as error:
        if is_named or _seems_scenario(file):
            found.faults += error.all_faults
        else:
            found.others.append(file)


def _seems_scenario(file: Path) -> bool:
    """Tell whether a file that is no proper YAML means to be a scenario: other programs have YAML of their own."""
    try:
        raw = read_regular_file(file, bytes_max=FILE_BYTES_MAX)
    except OSError:
        return False
    encoding = "utf-16" if raw.startswith(UTF_16) else "utf-8-sig"
    text = raw.decode(encoding, errors="replace").replace("\0", "").replace("\r", "\n")
    return bool(_SIMULATION.search(text)) or _has_scenarios_keys(text)


def _has_scenarios_keys(text: str) -> bool:
    """Tell whether keys of the top level are a scenario's: a service of Docker Compose extends another, too."""
    first = _FIRST.search(text)
    if first is None:
        return False
    indent, letter = first.groups()
    before = r"(?:^|[{,])[ \t]*" if letter == "{" else rf"^[ \t]{{0,{len(indent) + 1}}}"

    def has(key: str) -> bool:
        return re.search(rf"""(?m){before}["']?{key}["']?[ \t]*:""", text) is not None

    return has("extends") or (has("name") and has("agents"))


@dataclass(slots=True, kw_only=True)
class ChosenCases:
    """Tests that are to be run."""

    cases: list[SuiteCase] = field(default_factory=list)
    deselected: int = 0
    left_out: list[str] = field(default_factory=list)
    """Paths of folders' other files, and of links to folders."""


def choose_cases(
    found: FoundScenarios,
    settings: CaseSettings,
    *,
    seeds_of: Callable[[Path], Sequence[int | None]],
    is_meant: Matcher,
    warn: Callable[[str], None],
) -> ChosenCases:
    """
    Check the scenarios that are meant, and return each one's tests.

    Args:
        found: Scenarios and faults.
        settings: Of the command line.
        seeds_of: Returns the seeds with which a scenario is run; None among them for its own.
        is_meant: Of the expression.
        warn: Told of old names.

    Raises:
        InputError: With every fault of every scenario that is meant.
    """
    chosen = ChosenCases(left_out=[str(path) for path in (*found.others, *found.links)])
    faults = list(found.faults)
    messages: list[str] = []
    omitted = 0
    for outline in found.outlines:
        seeds = seeds_of(outline.path)
        meant = [seed for seed in seeds if is_meant(_names(outline, seed))]
        chosen.deselected += max(1, len(seeds)) - len(meant)
        try:
            chosen.cases += make_cases(outline, settings, meant, warn) if meant else []
        except InputError as error:
            faults += error.all_faults
            omitted += error.omitted
        except MissingExtraError as error:
            messages.append(f"{outline.path}: {error}")
        if len(chosen.cases) > CASES_MAX:
            raise InputError(f"expected at most {CASES_MAX} tests; choose with -k or fewer seeds")
    faults += [Fault(text=text) for text in messages]
    if faults:
        raise InputError(faults=faults, omitted=omitted)
    return chosen


def _names(outline: ScenarioOutline, seed: int | None) -> list[str]:
    mark = "" if seed is None else f"[seed={seed}]"
    names = [f"{outline.name}{mark}", f"{outline.path.name}{mark}", *outline.test.tags]
    return [name.lower() for name in names]
