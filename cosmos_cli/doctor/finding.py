"""A finding: what is so on a machine, how bad that is, and what to do; and the same of many machines as one. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from cosmos_cli.ui.name_ranges import compact

HERE = "this computer"
"""Stands where a machine's name would; no machine of an inventory can be called so."""
DETAILS_SHOWN_MAX = 3


class Severity(StrEnum):
    """Severity of a finding; scripts may rely on these words."""

    OK = "ok"
    NOTE = "note"
    """Good to know; spoils nothing by itself."""
    WARNING = "warning"
    """May cost real time or data."""
    ERROR = "error"
    """A run cannot be good like this."""


ORDER = (Severity.ERROR, Severity.WARNING, Severity.NOTE, Severity.OK)


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckRemark:
    """Result of a check on one machine."""

    found: str
    """A sentence that is the same for all machines of which the same is true."""
    level: Severity = Severity.OK
    cure: str = ""
    """A command, or a line of the inventory; empty when there is nothing to do."""
    figure: float | None = None
    """Measured value, where the machines differ by it."""
    unit: str = ""
    detail: str = ""
    """Addition for the case that few machines are meant, such as the names of processes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """A remark, whose it is, and of which check."""

    machine: str
    check: str
    remark: CheckRemark

    @property
    def level(self) -> Severity:
        """Severity of the finding."""
        return self.remark.level

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        remark = self.remark
        return {
            "check": self.check,
            "level": remark.level.value,
            "found": _sentence(remark.found, _figures([remark]), remark.detail),
            "figure": remark.figure,
            "unit": remark.unit or None,
            "cure": remark.cure or None,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingGroup:
    """One finding of many machines."""

    check: str
    level: Severity
    found: str
    cure: str
    machines: tuple[str, ...]

    @property
    def names(self) -> str:
        """Return the machines in few characters, this computer first."""
        others = compact(name for name in self.machines if name != HERE)
        return ", ".join(filter(None, [HERE if HERE in self.machines else "", others]))


def grouped(findings: Iterable[Finding]) -> list[FindingGroup]:
    """Return one group a finding that several machines share: the worst first, then in the order that they came."""
    alike: dict[tuple[Severity, str, str, str], list[Finding]] = {}
    for finding in findings:
        remark = finding.remark
        key = (remark.level, finding.check, remark.found, remark.cure)
        alike.setdefault(key, []).append(finding)
    return [_group(alike[key]) for key in sorted(alike, key=lambda key: ORDER.index(key[0]))]


def _group(findings: Sequence[Finding]) -> FindingGroup:
    first = findings[0]
    remarks = [finding.remark for finding in findings]
    return FindingGroup(
        check=first.check,
        level=first.level,
        found=_sentence(first.remark.found, _figures(remarks), _details(findings)),
        cure=first.remark.cure,
        machines=tuple(finding.machine for finding in findings),
    )


def _sentence(found: str, figures: str, detail: str) -> str:
    text = f"{found}: {figures}" if figures else found
    return f"{text} ({detail})" if detail else text


def _figures(remarks: Sequence[CheckRemark]) -> str:
    """Return the figures' range in words."""
    values = [remark.figure for remark in remarks if remark.figure is not None]
    if not values:
        return ""
    low, high = _number(min(values)), _number(max(values))
    unit = f" {remarks[0].unit}" if remarks[0].unit else ""
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _details(findings: Sequence[Finding]) -> str:
    """Return the detail if all have the same, else of the first few machines with their names."""
    told = [(f.machine, f.remark.detail) for f in findings if f.remark.detail]
    if len({detail for _, detail in told}) <= 1:
        return told[0][1] if told else ""
    if findings[0].level == Severity.OK:
        return ""
    shown = "; ".join(f"{machine}: {detail}" for machine, detail in told[:DETAILS_SHOWN_MAX])
    return shown + ("; ..." if len(told) > DETAILS_SHOWN_MAX else "")
