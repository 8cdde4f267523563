"""`cosmos schema`: write the JSON Schema of scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.console import Console
from cosmos_cli.errors import InputError
from cosmos_cli.models.schema import schema_text
from madns_runtime.plugin.registry import registered_names, resolve

KEPT = Path("scenarios/scenario.schema.json")
"""Where this repository keeps it, for editors and for `--check`."""


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
) -> None:
    """Print the JSON Schema of scenarios, for completion in editors."""
    console = Console()
    text = schema_text({name: resolve(name, Path()).parameters for name in registered_names()})
    if check and output is None:
        output = KEPT
        if not output.is_file():
            raise InputError(f"{output}: no such file here; name the file to check with --output")
    if output is None:
        console.data(text.rstrip("\n"))
        return
    try:
        if check:
            _check(output, text)
        else:
            output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{output}: {error.strerror}") from error
    console.say(f"{output}: {'current' if check else 'written'}")


def _check(path: Path, text: str) -> None:
    if path.read_text(encoding="utf-8") != text:
        raise InputError(f"{path}: is not current; write it with: cosmos schema --output {path}")
