"""Tests of suites made without files."""

from pathlib import Path

from cosmos_cli.models.scenario_test import ExpectedOutcome
from cosmos_cli.testing.case import SuiteCase
from cosmos_cli.testing.suite_process import ProcessResult


def make_case(name="s", **more):
    return SuiteCase(
        **{
            "path": Path(f"{name}.yaml"),
            "scenario_name": name,
            "overrides": (),
            "seed": 0,
            "has_given_seed": False,
            "is_lockstep": True,
            "work": 1.0,
            "deadline_s": 60.0,
            "expect": ExpectedOutcome(),
            "baseline": None,
            **more,
        }
    )


def make_result(exit_code=0, *checks, **more):
    document = {"run": "0001-s", "verdict": "PASSED: 1 check holds", "checks": list(checks)}
    return ProcessResult(**{"exit_code": exit_code, "seconds": 1.0, "document": document, **more})


def broken(name, **more):
    return {"name": name, "limit": 1, "got": 2.5, "passed": False, **more}
