"""Whether what a scenario names as its executor is there: somebody's own code, imported in a process of its own."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosmos_cli.models.scenario import EXECUTOR_KINDS, Scenario
from cosmos_cli.models.separate_process import SeparateFailure, work_separately
from madns_runtime.errors import MadnsError
from madns_runtime.plugin.registry import load_function

EXECUTOR_KIND = ("executor", "kind")
"""Where it stands in a scenario."""


def ask_executor(scenario: Scenario) -> tuple[str, str]:
    """
    Return what is wrong with an executor of somebody's own, and what is odd; each is empty for nothing.

    Args:
        scenario: Without a fault of its own there, such as a kind of another form.
    """
    kind = scenario.executor.kind
    module, _, attribute = kind.partition(":")
    if kind in EXECUTOR_KINDS or not attribute:
        return "", ""
    if not _is_here(module.partition(".")[0]):
        return "", f"no module {module} is found here: the run needs it where its host is"

    def work(tell: Callable[[str], None]) -> Mapping[str, Any]:
        tell(f"importing {module}")
        try:
            load_function(kind, Path())
        except MadnsError as error:
            return {"fault": str(error)}
        return {}

    try:
        answer = work_separately(work, limit_s=scenario.timeouts.loading_s)
    except SeparateFailure as failure:
        return str(failure), ""
    return str(answer.get("fault", "")), ""


def _is_here(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):  # such as __main__, which has no spec
        return False
