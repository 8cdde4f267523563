"""Outcomes of a scenario's checks in the recorded run and in its rerun."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosmos_cli.evidence.expectations.of_run import planned_expectations
from cosmos_cli.evidence.run_directory import RunDirectory
from madns_runtime.plain_values import is_real


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectationComparison:
    """One check in both runs."""

    name: str
    stream: str
    field: str
    unit: str
    expected: str
    got: float | None
    """On record; None where there was nothing."""
    passed: bool
    rerun_got: float | None
    rerun_passed: bool

    @property
    def is_same(self) -> bool:
        """Whether it holds in both runs, or is broken in both."""
        return self.passed == self.rerun_passed

    @property
    def words(self) -> str:
        """Return its outcome in words."""
        before = _came_to(self.got, self.unit, is_held=self.passed)
        after = _came_to(self.rerun_got, self.unit, is_held=self.rerun_passed)
        return f"check {self.name}: {before} on record, {after} in the rerun ({self.expected})"


def compare_expectations(
    recorded: RunDirectory, rerun: RunDirectory
) -> tuple[ExpectationComparison, ...]:
    """Return the checks that were judged in both runs, in their order."""
    before, after = _judged(recorded), _judged(rerun)
    of = {each.name: each for each in planned_expectations(rerun.read_json(rerun.plan_json))}
    return tuple(
        ExpectationComparison(
            name=name,
            stream=of[name].stream,
            field=of[name].field,
            unit=str(check.get("unit") or ""),
            expected=str(check.get("expected")),
            got=_number(before[name].get("got")),
            passed=before[name].get("passed") is True,
            rerun_got=_number(check.get("got")),
            rerun_passed=check.get("passed") is True,
        )
        for name, check in after.items()
        if name in before and name in of
    )


def _judged(run: RunDirectory) -> dict[str, Mapping[str, Any]]:
    listed = (run.read_json(run.run_json) or {}).get("checks")
    return {
        str(check.get("name")): check
        for check in (listed if isinstance(listed, list) else ())
        if isinstance(check, Mapping) and check.get("expected")
    }


def _number(value: Any) -> float | None:
    return float(value) if is_real(value) else None


def _came_to(got: float | None, unit: str, *, is_held: bool) -> str:
    told = "nothing" if got is None else f"{got:g} {unit}".rstrip()
    return f"{told} ({'holds' if is_held else 'broken'})"
