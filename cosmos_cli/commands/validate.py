"""`cosmos validate`: check scenarios without running them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosmos_cli.errors import Fault, InputError
from cosmos_cli.launch.access import chosen_access
from cosmos_cli.launch.place_plan import place_notes
from cosmos_cli.models.loading import ScenarioFile, load_scenario
from cosmos_cli.models.resolved import origins, relative_root, resolved_lines
from cosmos_cli.models.scenario_outline import check_test
from cosmos_cli.ui.console import Console, JsonOption, QuietOption, SetOption
from cosmos_cli.ui.foreign_text import clean_line
from madns_runtime.errors import ConfigurationError, MissingExtraError, PluginError

READERS = {
    "private": "",
    "group": "; its records readable by the group",
    "all": "; its records readable by all",
}


def validate(
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Scenario files.")],
    set_: SetOption = None,
    resolved: Annotated[
        bool,
        typer.Option(
            "--resolved", help="Print what results, with defaults, and where each value came from."
        ),
    ] = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Check scenario files and show every fault with its line and column."""
    console = Console(json=json, quiet=quiet)
    faults: list[Fault] = []
    omitted = 0
    found: list[ScenarioFile] = []
    for path in files:
        try:
            scenario_file = load_scenario(path, set_ or (), warn=console.warn)
            check_test(scenario_file, console.warn)
        except InputError as error:
            faults += error.all_faults
            omitted += error.omitted
        except (ConfigurationError, PluginError, MissingExtraError) as error:
            if len(files) == 1:
                raise
            faults.append(Fault(text=str(error), file=str(path)))
        else:
            found.append(scenario_file)
            for note in (*place_notes(scenario_file), *map(Fault.render, scenario_file.remarks)):
                console.say(f"note: {note}")
            name = clean_line(str(path), length_max=None)
            if resolved:
                console.data(f"# {name}: ok: {_summary(scenario_file)}")
                console.data("\n".join(resolved_lines(scenario_file)))
                continue
            console.data(f"{name}: ok: {_summary(scenario_file)}")
    if faults:
        raise InputError(faults=faults, omitted=omitted)
    console.print_json(
        {"valid": True, "scenarios": [_result(item, is_resolved=resolved) for item in found]}
    )


def _summary(item: ScenarioFile) -> str:
    scenario = item.scenario
    agents = f"{scenario.agents.count} agent{'s' if scenario.agents.count > 1 else ''}"
    rate = f"at {scenario.agents.tick_hz:g} Hz for {scenario.time.duration_s:g} s"
    readers = READERS[chosen_access(scenario.recording)]
    return f"{scenario.name}, {agents} of {scenario.simulation} {rate}{readers}"


def _result(item: ScenarioFile, *, is_resolved: bool) -> dict[str, object]:
    more: dict[str, object] = {}
    if is_resolved:
        more = {"files": list(item.files), "root": relative_root(item), "origins": origins(item)}
    return {
        "file": str(item.path),
        "access": chosen_access(item.scenario.recording),
        "scenario": item.to_mapping(),
        **more,
    }
