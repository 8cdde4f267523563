"""The JSON files of a run, read as the input that they are: bounded, regular, and said what is wrong with them; problems as run.json holds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import orjson

from cosmos_cli.models.expectation import Expectation
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.bounded_files import read_regular_file
from madns_runtime.config import RunConfig, from_mapping
from madns_runtime.errors import ConfigurationError
from madns_runtime.plain_values import is_nested_deeper

DOCUMENT_BYTES_MAX = 256 * 1024 * 1024
"""A host's result is some kilobytes per agent, a manifest some 200 bytes per file."""
LEVELS_MAX = 220
"""Lists and mappings in each other: a plug-in's summary may have 200. More than 254 are read, but cannot be written."""
SCHEMA = 1
"""Version of run.json and manifest.json; a change that breaks a reader raises it."""
EXPECTATIONS = "expectations"
"""Key of plan.json."""
MISSING = "missing"
Step = Literal["run", "collect", "forgotten"]


def read_object(path: Path) -> dict[str, Any]:
    """
    Return a JSON object.

    Raises:
        OSError: It is missing, no regular file, or too large.
        ValueError: It is something else, or nested too deep.
    """
    value = orjson.loads(read_regular_file(path, bytes_max=DOCUMENT_BYTES_MAX))
    if not isinstance(value, dict):
        raise ValueError(f"expected a JSON object, got {type(value).__name__}")
    if is_nested_deeper(value, LEVELS_MAX):
        raise ValueError(f"expected at most {LEVELS_MAX} lists and objects in each other")
    return value


def newer_schema(document: Mapping[str, Any]) -> str | None:
    """Say that a run.json or manifest.json is of a schema that this program does not know yet, and what to do; None if not."""
    schema = document.get("schema")
    if not isinstance(schema, int) or schema <= SCHEMA:
        return None
    versions = document.get("versions")
    made = versions.get("cosmos-madns") if isinstance(versions, Mapping) else None
    by = f" ({clean_line(made)})" if isinstance(made, str) else ""
    return (
        f"schema {schema} is of a newer COSMoS{by}, this one knows {SCHEMA}; read it with that version,"
        " or upgrade cosmos-madns"
    )


def text_or_none(value: object) -> str | None:
    """Return a text as it is; None for anything else."""
    return value if isinstance(value, str) else None


def fault_of(path: Path) -> str | None:
    """Say why a JSON file cannot be used; None if it can."""
    try:
        read_object(path)
    except FileNotFoundError:
        return MISSING
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    except ValueError as error:
        return f"cannot be used: {error}"
    return None


def fault_of_plan(path: Path) -> str | None:
    """Say why what was planned is not known from a plan.json; None if it is."""
    fault = fault_of(path)
    if fault is not None:
        return fault
    plan = read_object(path)
    config, listed = plan.get("config"), plan.get(EXPECTATIONS, [])
    if not isinstance(config, Mapping):
        return "cannot be used: expected the run's configuration under config"
    if not isinstance(listed, list):
        return f"cannot be used: expected a list of checks under {EXPECTATIONS}"
    try:
        from_mapping(RunConfig, config, "config")
        for number, item in enumerate(listed):
            from_mapping(Expectation, item, f"{EXPECTATIONS}[{number}]")
    except ConfigurationError as error:
        return f"cannot be used: {error}"
    return None


def fault_of_summary(document: Mapping[str, Any]) -> str | None:
    """Say what in a run.json cannot be shown, and where; None if all of it can."""
    data = document.get("data", {})
    lists = {
        "checks": (document.get("checks", []), dict),
        "problems": (document.get("problems", []), dict),
        "remarks": (document.get("remarks", []), str),
        "data.missing": (data.get("missing", []) if isinstance(data, dict) else None, str),
    }
    for name, (value, kind) in lists.items():
        if not isinstance(value, list):
            return f"{name}: expected a list, got {type(value).__name__}"
        for index, item in enumerate(value):
            if not isinstance(item, kind):
                word = "an object" if kind is dict else "a text"
                return f"{name}[{index}]: expected {word}, got {type(item).__name__}"
    return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """One problem, as run.json holds it."""

    text: str
    """Names who and why."""
    machine: str | None = None
    """The machine that failed; None if it was none of them, such as the host's own process."""
    step: Step = "run"
    """The run's problems stay for ever; those of collecting are found anew each time, or are mended; of a machine
    that was forgotten what it had is missing, and nobody looks after it."""
    is_of_data: bool = False
    """Whether only data are missing or damaged, and the machine that had them is not to blame."""

    def to_mapping(self) -> dict[str, Any]:
        """Return it as run.json holds it."""
        return {"machine": self.machine, "text": self.text, "step": self.step}


def problems_of_run(listed: object) -> tuple[Problem, ...]:
    """Return what the run itself met, of the problems in a run.json; what is no problem is left out."""
    items = listed if isinstance(listed, list) else []
    return tuple(
        Problem(text=str(item["text"]), machine=text_or_none(item.get("machine")))
        for item in items
        if isinstance(item, Mapping) and "text" in item and item.get("step") == "run"
    )
