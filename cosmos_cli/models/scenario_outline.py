"""A scenario as a test: what is known of it before it is checked, and the scenario with what its test changes."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.models.baseline import Baseline, read_baseline
from cosmos_cli.models.document import Document
from cosmos_cli.models.extending import read_scenario_source
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.overrides import override_steps
from cosmos_cli.models.scenario_test import ScenarioTest, faults_of_test
from cosmos_cli.models.test_settings import SECTION, giving_way, test_overrides
from cosmos_cli.models.translate import faults_of
from cosmos_cli.models.variables import substitute_variables
from madns_runtime.bounded_files import real_path
from madns_runtime.similar_words import most_similar


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenarioOutline:
    """A scenario's name and its section `test`, by which a suite chooses; nothing else is checked yet."""

    path: Path
    name: str
    test: ScenarioTest
    document: Document
    root: Path
    """The folder that travels with it, from which relative files are found."""
    settings: Mapping[str, Any]
    """`test.set` as it is written, variables and all."""
    bases: frozenset[Path]
    """Files that it extends, directly or not, with links followed."""

    def overrides(self, given: Sequence[str] = (), *, is_shortened: bool = True) -> list[str]:
        """
        Return KEY=VALUE for all that the test changes.

        Args:
            given: Of --set; what the test would set at or below one of these keys gives way.
            is_shortened: Whether `test.set` counts.
        """
        if not is_shortened:
            return list(given)
        return [*giving_way(self._own(), given), *given]

    def load(self, overrides: Sequence[str], warn: Callable[[str], None]) -> ScenarioFile:
        """
        Return the checked scenario.

        Args:
            overrides: As `overrides` returned them.
            warn: Told of old names.

        Raises:
            InputError: With every fault; what follows from `test.set` has its place there.
            MissingExtraError: The simulation needs an optional dependency that is not installed.
        """
        try:
            return load_scenario(self.path, overrides, warn=warn)
        except InputError as error:
            own = dict(zip(self.settings, self._own(), strict=True))
            applied = {key for key, override in own.items() if override in overrides}
            faults = [self._placed(fault, applied) for fault in error.all_faults]
            raise InputError(faults=faults, omitted=error.omitted) from error

    def baseline(self) -> Baseline | None:
        """
        Return the figures that the test's runs are compared with; None for none.

        Raises:
            InputError: The file is missing or wrong.
        """
        name = self.test.baseline
        if not name:
            return None
        path = self.root / name
        if not os.path.exists(path):
            text = f"{path}: no such file; write the names of the figures there: docs/ci.md"
            raise InputError(faults=[self.document.fault((SECTION, "baseline"), text)])
        return read_baseline(path)

    def _own(self) -> list[str]:
        return test_overrides(self.document, self.settings)

    def _placed(self, fault: Fault, applied: set[str]) -> Fault:
        """Return a fault of --set KEY=VALUE at KEY of `test.set`, if it came from there."""
        if fault.override not in applied:
            return fault
        is_elsewhere = fault.path not in ("", fault.override)
        told = f"{fault.path}: {fault.text}" if is_elsewhere else fault.text
        return self.document.fault((SECTION, "set", fault.override), told)


def read_outline(path: Path) -> ScenarioOutline:
    """
    Read a scenario's name and its section `test`.

    Raises:
        InputError: The file is no YAML, or the section is wrong.
    """
    source = read_scenario_source(path)
    document = source.document
    written = document.value.get(SECTION)
    settings = copy.deepcopy(written.get("set")) if isinstance(written, dict) else None
    substitute_variables(document)
    value = document.value.get(SECTION, {})
    try:
        test = _ADAPTER.validate_json(json.dumps(value), strict=True)
    except ValidationError as error:
        faults = faults_of(
            document, error.errors(include_url=False), ScenarioTest, below=(SECTION,)
        )
        raise InputError(faults=faults) from error
    faults = [document.fault((SECTION, *where), text) for where, text in faults_of_test(test)]
    if faults:
        raise InputError(faults=faults)
    name = document.value.get("name")
    return ScenarioOutline(
        path=path,
        name=name if isinstance(name, str) and name else path.stem,
        test=test,
        document=document,
        root=source.root,
        settings=settings if isinstance(settings, dict) else {},
        bases=frozenset(real_path(Path(file)) for file in source.files[1:]),
    )


def is_scenario(document: Document) -> bool:
    """
    Tell whether a file of a folder means to be a scenario that can run, and no inventory, baseline or base of others.

    One of its two words may be misspelt or forgotten: its agents tell it from other programs' files. A simulation with
    no name is a base of others, unless a key is much like `name`.
    """
    value = document.value
    if "extends" in value or ("name" in value and "simulation" in value):
        return True
    agents = value.get("agents")
    if not isinstance(agents, dict) or agents.keys().isdisjoint(_OF_AGENTS):
        return False
    has_similar = any(most_similar(key, ("name",)) for key in value)
    return "name" in value or ("simulation" in value and has_similar)


def check_test(scenario: ScenarioFile, warn: Callable[[str], None]) -> None:
    """
    Check what `cosmos test` would meet beyond the scenario itself, which is right.

    Raises:
        InputError: With the faults of the scenario as its test changes it, and of the baseline.
    """
    if SECTION not in scenario.document.value:
        return
    outline = read_outline(scenario.path)
    faults: list[Fault] = []
    omitted = 0
    given = scenario.overrides
    try:
        if outline.test.set:
            outline.load(outline.overrides(given), warn)
    except InputError as error:
        faults += map(_of_the_test, error.all_faults)
        omitted += error.omitted
    try:
        outline.baseline()
    except InputError as error:
        faults += error.all_faults
        omitted += error.omitted
    if faults:
        faults.sort(key=lambda fault: (bool(fault.override), fault.line or 0, fault.column or 0))
        raise InputError(faults=faults, omitted=omitted)


def _of_the_test(fault: Fault) -> Fault:
    """Return a fault that says that a test alone has it, where its place does not."""
    if fault.path.startswith(SECTION):
        return fault
    return replace(fault, text=f"{fault.text} (of the scenario as its test.set changes it)")


def with_seed(overrides: Sequence[str], seed: int | None) -> list[str]:
    """Return settings with the seed of a run; None for the scenario's own."""
    if seed is None:
        return list(overrides)
    return [*(item for item in overrides if override_steps(item) != ("seed",)), f"seed={seed}"]


_OF_AGENTS = ("count", "names", "tick_hz")
_ADAPTER: TypeAdapter[ScenarioTest] = TypeAdapter(ScenarioTest)
