"""Common parts of commands about runs: which run is meant, and in which folder of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

RunArgument = Annotated[
    str, typer.Argument(metavar="RUN", help="Number, name or path of a run, or: last.")
]
RunsOption = Annotated[
    Path | None,
    typer.Option(
        "--runs", metavar="DIRECTORY", help="Folder of all runs; else COSMOS_RUNS or ./runs."
    ),
]
