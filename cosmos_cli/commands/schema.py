"""`cosmos schema`: write the JSON Schema of scenarios."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.errors import InputError
from cosmos_cli.models.schema import schema_text
from cosmos_cli.models.separate_process import (
    SeparateDefect,
    SeparateFailure,
    Work,
    work_separately,
)
from cosmos_cli.system.named_file import JSON_SCHEMA, check_no_other
from cosmos_cli.ui.console import Console, JsonOption
from madns_runtime.bounded_files import read_regular_file
from madns_runtime.config import Timeouts
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.partial_file import refuse_stream_word
from madns_runtime.plugin.registry import is_shipped, registered_names, resolve

SCHEMA_BYTES_MAX = 64 * 1024 * 1024
KEPT = Path("scenarios/scenario.schema.json")
"""Place of the schema in this repository, for editors and for `--check`."""


def schema(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write to FILE.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help=f"Write nothing; fail if FILE, by default {KEPT}, is not current."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print the JSON Schema of scenarios, for completion in editors."""
    console = Console(json=as_json)
    text = _current_schema(console.warn)
    if check and output is None:
        output = KEPT
        if not output.is_file():
            raise InputError(f"{output}: no such file here; name the file to check with --output")
    if output is None:
        console.data(text.rstrip("\n"))
        console.print_json(json.loads(text))
        return
    try:
        refuse_stream_word(output)
        if check:
            _check(output, text)
        else:
            check_no_other(output, JSON_SCHEMA)
            output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{output}: {error.strerror}") from error
    done = "current" if check else "written"
    console.print_json({"file": str(output), "status": done, "exit_code": 0})
    console.say(f"{output}: {done}")


def _current_schema(warn: Callable[[str], None]) -> str:
    """Return the schema of all installed simulations; *warn* hears of those that do not load, and are left out."""
    names = registered_names()
    if all(map(is_shipped, names)):
        return str(_schema_of(names, lambda doing: None)["text"])
    faults = {name: _fault_of(name) for name in names if not is_shipped(name)}
    for name, fault in faults.items():
        if fault:
            warn(f"{name} is left out: {fault}")
    whole = [name for name in names if not faults.get(name)]
    return str(_asked_separately(partial(_schema_of, whole))["text"])


def _fault_of(name: str) -> str:
    """Return why an installed simulation that is not shipped does not load; empty if it does."""

    def load(tell: Callable[[str], None]) -> Mapping[str, str]:
        tell(f"importing {name}")
        try:
            schema_text({name: resolve(name, Path())})
        except MadnsError as error:
            return {"fault": str(error)}
        return {"fault": ""}

    try:
        return str(_asked_separately(load)["fault"])
    except PluginError as error:
        return str(error)


def _asked_separately(work: Work) -> Mapping[str, Any]:
    try:
        return work_separately(work, limit_s=Timeouts().loading_s)
    except SeparateFailure as failure:
        raise PluginError(str(failure)) from None
    except SeparateDefect as defect:
        raise RuntimeError(str(defect)) from None


def _schema_of(names: Sequence[str], tell: Callable[[str], None]) -> Mapping[str, str]:
    simulations = {}
    for name in names:
        tell(f"importing {name}")
        simulations[name] = resolve(name, Path())
    return {"text": schema_text(simulations)}


def _check(path: Path, text: str) -> None:
    if read_regular_file(path, bytes_max=SCHEMA_BYTES_MAX) != text.encode():
        raise InputError(f"{path}: is not current; write it with: cosmos schema --output {path}")
