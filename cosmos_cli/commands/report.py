"""`cosmos report`: what a run recorded, on the terminal or as one HTML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.collect.finished_run import (
    changed_tables,
    collected_document,
    refuse_foreign_tables,
)
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import runs_root
from cosmos_cli.evidence.run_documents import fault_of_summary
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.report.build import build_sections, with_simulation
from cosmos_cli.report.html import write_report
from cosmos_cli.report.terminal import print_report
from cosmos_cli.system.named_file import HTML, check_writable, named_file
from cosmos_cli.ui.console import Console, JsonOption, QuietOption


def report(
    run: RunArgument = "last",
    html: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="Write the report with its figures to FILE."),
    ] = None,
    folder: RunsOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Show what a run recorded: verdict, checks, tables; figures are in report.html of the run."""
    console = Console(json=as_json, quiet=quiet)
    if html is not None:
        check_writable(html, HTML)
    found = find_run(runs_root(folder), run)
    document = collected_document(found, run)
    refuse_foreign_tables(found)
    fault = fault_of_summary(document)
    if fault is not None:
        raise InputError(
            f"{found.run_json}: {fault}; make it anew with: cosmos collect {found.shell_path}"
        )
    if changed := changed_tables(found):
        document["remarks"] = [*document.get("remarks", ()), *changed]
    if as_json:
        console.print_json(with_simulation(found, document, console.warn))
    if html is not None:
        with named_file(html):
            console.say(f"report written to {write_report(found, document, html)}")
    elif not as_json:
        print_report(console, document, build_sections(found, document))
        if found.report_html.is_file():
            console.say(f"with figures: {found.report_html}")
        else:  # --no-report
            console.say(
                f"its figures were not drawn; cosmos report {found.shell_path} --html FILE draws them"
            )
