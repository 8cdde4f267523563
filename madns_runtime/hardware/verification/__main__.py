"""Verifies what standard input says, and prints the findings as JSON."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from madns_runtime.errors import MadnsError
from madns_runtime.hardware.kind_registry import DeviceProgram
from madns_runtime.hardware.verification.driver import (
    move_outputs,
    open_often,
    take_samples,
    units_of,
)
from madns_runtime.hardware.verification.line import line_of, spoil_line
from madns_runtime.hardware.verification.order import (
    PORT,
    STAND_IN,
    Findings,
    VerificationOrder,
    finding,
    has_stand_in,
    make_program,
    may_write,
    spec_of,
)
from madns_runtime.hardware.verification.process import claimed, lose_device
from madns_runtime.hardware.verification.steps import run_step
from madns_runtime.plain_values import from_mapping


def verify_device(order: VerificationOrder) -> Findings:
    """Return what holds of a driver, and what does not."""
    try:
        order = replace(order, kind=spec_of(order.kind, Path(order.directory)))
        program = make_program(order, "/dev/null" if has_stand_in(order) else None)
    except MadnsError as error:
        return [finding("declaration", False, str(error), "a kind that loads, with its parameters")]
    may_move = may_write(order, program.kind)
    rate_hz = order.rate_hz or program.kind.rate_hz
    is_asked = order.rate_hz is not None or has_stand_in(order)
    findings: Findings = [
        finding("declaration", True, f"{len(program.channels)} channels"),
        units_of(program),
    ]
    with line_of(order, program, rate_hz) as line_program:
        driven: dict[str, Callable[[], Findings]] = {
            "opening": lambda: open_often(line_program, order.cycles),
            "samples": lambda: take_samples(
                line_program, rate_hz, order.sampling_s, is_asked=is_asked
            ),
            "outputs": lambda: move_outputs(line_program),
        }
        runs: dict[str, Callable[[], Findings]] = {
            **{name: partial(claimed, order, line_program, run) for name, run in driven.items()},
            # Which claims it as a run does.
            "process": lambda: lose_device(order, line_program, rate_hz, may_move),
        }
        for name, step in runs.items():
            if name not in order.steps:
                continue
            why = _why_not(name, program, findings, may_move=may_move)
            findings += [finding(name, None, why)] if why else run_step(name, step)
            if findings[-1].name == "opening" and not findings[-1].passed:
                return findings  # the reason stands there once
    if "line" in order.steps and has_stand_in(order):
        findings += run_step("line", lambda: spoil_line(order))
    elif "line" in order.steps:
        findings.append(finding("line", None, f"no stand-in: {PORT}={STAND_IN} asks for one"))
    return findings


def _why_not(name: str, program: DeviceProgram, findings: Findings, *, may_move: bool) -> str:
    """Return why a step is not taken; "" if it is."""
    if name == "outputs" and not any(c.direction == "out" for c in program.channels):
        return "it has none"
    if name == "outputs" and not may_move:
        return "not moved: that must be asked for"
    if name == "process" and any(f.name == "shapes" and f.passed is False for f in findings):
        return "a run refuses its samples"
    return ""


def main() -> None:
    """Verify what standard input says, and print the findings as JSON."""
    order = from_mapping(VerificationOrder, json.load(sys.stdin), "order")
    out = os.dup(1)
    os.dup2(2, 1)
    findings = [asdict(each) for each in verify_device(order)]
    with open(out, "w", encoding="utf-8") as file:
        json.dump(findings, file)


if __name__ == "__main__":
    main()
