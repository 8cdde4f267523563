"""`cosmos schema`: write the JSON Schema of scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.console import Console
from cosmos_cli.errors import InputError
from cosmos_cli.models.schema import schema_text
from madns_runtime.plugin.registry import registered_names, resolve


def schema(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write to FILE.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; fail if FILE is not current.")
    ] = False,
) -> None:
    """Print the JSON Schema of scenarios, for completion in editors."""
    console = Console()
    text = schema_text({name: resolve(name, Path()).parameters for name in registered_names()})
    if output is None:
        if check:
            raise typer.BadParameter("--check needs --output FILE: the file to check")
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
