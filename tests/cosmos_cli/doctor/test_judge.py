"""Every check of `cosmos doctor`, red and green, over what a machine told."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.doctor.case import AgentBound, Case, Wants
from cosmos_cli.doctor.finding import HERE, Finding, Severity
from cosmos_cli.doctor.judge import CHECKS, judge
from cosmos_cli.models.scenario import Scenario

FOLDER = Path(__file__).parent
HEALTHY: dict[str, Any] = json.loads((FOLDER / "healthy.json").read_text())
CASES: list[dict[str, Any]] = json.loads((FOLDER / "cases.json").read_text())
ALWAYS_FINE = {"preempt_rt", "system"}
"""Tells what a machine is, and judges nothing."""


def told_with(changes: dict[str, Any], *, is_here: bool) -> dict[str, Any]:
    told = copy.deepcopy(HEALTHY)
    if not is_here:
        del told["here"]
    for path, value in changes.items():
        *steps, last = path.split(".")
        place: Any = told
        for step in steps:
            place = place[int(step) if isinstance(place, list) else step]
        assert (int(last) < len(place)) if isinstance(place, list) else (last in place), path
        place[int(last) if isinstance(place, list) else last] = value
    return told


def judged(case: dict[str, Any]) -> list[Finding]:
    is_here = bool(case.get("here"))
    told = told_with(case.get("change", {}), is_here=is_here)
    machine = HERE if is_here else "pi04"
    wants = dict(case.get("wants", {}))
    bounds = {
        name: AgentBound(agents=agents, is_of_process=is_of_process)
        for name, (agents, is_of_process) in wants.pop("bounds", {}).items()
    }
    return judge(Case.of(machine, told, Wants(**wants, bounds=bounds)))


def named(case: dict[str, Any]) -> str:
    return f"{case['check']}-{(case['expect'] or {}).get('level', 'silent')}"


@pytest.mark.parametrize("case", CASES, ids=named)
def test_check_finds(case: dict[str, Any]) -> None:
    found = [f.to_mapping() for f in judged(case) if f.check == case["check"]]

    expected = case["expect"]
    if expected is None:
        assert found == []
        return
    (fitting,) = [
        item
        for item in found
        if item["level"] == expected["level"] and expected.get("found", "") in item["found"]
    ] or [found]
    assert isinstance(fitting, dict), f"expected {expected}, got {found}"
    assert expected.get("cure", "") in (fitting["cure"] or "")
    assert bool(fitting["cure"]) == (fitting["level"] != "ok")


@pytest.mark.parametrize(
    ("deadline", "expected"),
    [({"overrun_ms": 2}, 2.0), ({"overrun_ms": 2, "lateness_ms": 0.5}, 0.5), ({}, 5.0)],
)
def test_wake_ups_are_held_against_the_lateness_that_the_scenario_allows(deadline, expected):
    scenario = Scenario(name="a", simulation="counter", agents={"count": 1}, deadline=deadline)

    assert Wants.of(scenario, {}, machines=0).lateness_ms == expected


@pytest.mark.parametrize("check", CHECKS)
def test_every_check_is_tried_red_and_green(check: str) -> None:
    mine = [case for case in CASES if case["check"] == check]
    healthy = [f for f in judged({}) + judged({"here": True}) if f.check == check]
    is_green = [f for f in healthy if f.level == Severity.OK] or [
        case for case in mine if case["expect"] is None or case["expect"]["level"] == "ok"
    ]

    assert is_green, "no case in which all is well"
    if check not in ALWAYS_FINE:
        assert [case for case in mine if case["expect"] and case["expect"]["level"] != "ok"]


def test_healthy_machine_has_nothing_to_cure() -> None:
    assert [f for f in judged({}) if f.level != Severity.OK] == []


def test_machine_that_tells_little_is_judged_by_that() -> None:
    """An ordinary computer: no Pi's files, no measurements, nothing of COSMoS."""
    told = copy.deepcopy(HEALTHY)
    for key in ("wake_ups", "busy", "round_trips", "swap", "disk_write", "interfaces", "here"):
        told[key] = None
    told["facts"] |= {"throttled": None, "temperature_c": None, "governors": {}, "radios": []}
    told["kernel"] = {}
    told["receive_drops"] = {"total": None, "before": None}

    findings = judge(Case.of("laptop", told, Wants()))

    assert {f.check for f in findings if f.level != Severity.OK} == {"clock", "udp"}
