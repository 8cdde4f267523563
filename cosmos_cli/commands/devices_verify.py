"""`cosmos devices verify`: what holds of a driver, seen in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.models.document import Document, read_document
from cosmos_cli.models.overrides import apply_overrides
from cosmos_cli.models.yaml_source import YamlSource, read_source
from cosmos_cli.ui.console import Column, Console

VERIFICATION_S = 400.0
"""Longer than all steps of the verification with their deadlines."""
STDERR_CHARACTERS_SHOWN = 2000
FINDINGS = (Column("what"), Column("holds"), Column("got"), Column("limit"))
HOLDS = {True: "yes", False: "NO", None: "-"}


def verify_driver(
    console: Console,
    kind: str,
    parameters: Sequence[str],
    *,
    rate_hz: float | None = None,
    write: bool = False,
) -> int:
    """
    Put a driver through its paces, and show what holds.

    Args:
        console: Where to.
        kind: Registered kind, module:NAME, ./file.py:NAME, or ./file.py that holds one Device class.
        parameters: KEY=VALUE each, or YAML files of parameters.
        rate_hz: At which it is read; None for the kind's own.
        write: Whether outputs may move.

    Raises:
        InputError: A parameter is none, or a file of them is not YAML.
    """
    order = {
        "kind": kind,
        "parameters": read_parameters(parameters),
        "directory": str(Path.cwd()),
        "rate_hz": rate_hz,
        "may_write": write,
    }
    console.say(f"verifying {kind}; this takes about 10 s")
    findings = _findings(order)
    console.table(
        FINDINGS, [(f["name"], HOLDS[f["passed"]], f["got"], f["limit"]) for f in findings]
    )
    broken = [f["name"] for f in findings if f["passed"] is False]
    for name in broken:
        console.say(f"{kind}: {name} does not hold")
    code = ExitCode.BUDGET_BROKEN if broken else ExitCode.OK
    console.print_json({"kind": kind, "findings": findings, "exit_code": int(code)})
    return int(code)


def read_parameters(texts: Sequence[str]) -> dict[str, Any]:
    """
    Return a device's parameters from files and KEY=VALUE, the later over the earlier.

    Raises:
        InputError: One is neither.
    """
    document = Document(YamlSource.of("--parameters", ""))
    overrides = []
    for text in texts:
        if "=" in text:
            overrides.append(text)
            continue
        found = read_document(read_source(Path(text)))
        if found.faults:
            raise InputError(faults=found.faults)
        document.value.update(found.value)
    if faults := apply_overrides(document, overrides):
        raise InputError(faults=faults)
    return document.value


def _findings(order: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the findings; a verification that ends without any is one itself."""
    try:
        ended = subprocess.run(
            [sys.executable, "-P", "-m", "madns_runtime.hardware.verification"],
            input=json.dumps(order),
            capture_output=True,
            text=True,
            errors="replace",
            timeout=VERIFICATION_S,
            check=False,
        )
        return list(json.loads(ended.stdout))
    except subprocess.TimeoutExpired:
        why = f"it did not end within {VERIFICATION_S:g} s"
    except ValueError:
        why = f"it ended with {ended.returncode}: {ended.stderr[-STDERR_CHARACTERS_SHOWN:]}"
    return [{"name": "verification", "passed": False, "got": why, "limit": "findings"}]
