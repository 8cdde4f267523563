"""One `cosmos run` from a checked scenario to a judged run directory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from cosmos_cli.errors import CosmosError, ExitCode, InputError
from cosmos_cli.launch.operator import Operator
from cosmos_cli.launch.outcome import LaunchOutcome, LaunchRequest, View, with_manual_agents
from cosmos_cli.launch.signals import OperatorSignals
from cosmos_cli.models.loading import ScenarioFile
from cosmos_cli.plan import LaunchPlan, make_plan
from cosmos_cli.rundir import RunDirectory, begin_run, create_run
from madns_runtime.config import RunConfig
from madns_runtime.processes import register

if TYPE_CHECKING:
    from cosmos_cli.collect import RunSummary

OPERATOR_NICE = 5
"""What the operator draws and collects can wait; agents on the same processors cannot."""


class CollectionInterrupted(CosmosError):
    """The run is over, but its operator did not wait for the verdict."""

    exit_code = ExitCode.INTERRUPTED
    kind = "interrupted"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """How a scenario is to be run."""

    runs: Path
    """Folder of all runs."""
    manual: tuple[str, ...] = ()
    """Agents that a person starts by hand."""
    has_report: bool = True


def execute(
    scenario: ScenarioFile, options: RunOptions, make_view: Callable[[str, float], View]
) -> RunSummary:
    """
    Run a scenario on this computer and judge it.

    Args:
        scenario: What to run.
        options: How.
        make_view: Called with the run's name and simulated time, s; returns where talk goes.

    Raises:
        InputError: An option does not fit the scenario, or no run directory can be made.
        CollectionInterrupted: What is on disk can be collected again.
    """
    prepared = _prepare(scenario, options)
    request = LaunchRequest(
        config=prepared.config,
        directory=prepared.run.path,
        machines=prepared.plan.agents_by_machine,
        manual=options.manual,
        nice=OPERATOR_NICE,
    )
    run = prepared.run
    with OperatorSignals() as signals, register(run.name, "operator", "operator", run.path) as own:
        view = make_view(run.name, prepared.config.time.duration_s)
        try:
            view.say(_greeting(prepared))
            if own.problem is not None:
                view.say(own.problem, "warning")
            outcome = Operator(request, view, signals).run()
            signals.raise_from_now()
            has_report = options.has_report and outcome.interruption != "at once"
            return _finish(prepared, outcome, has_report=has_report, view=view)
        except KeyboardInterrupt:
            raise CollectionInterrupted(
                f"interrupted while collecting; the records are on disk, judge and package them with:"
                f" cosmos collect {run.path}"
            ) from None
        finally:
            view.close()


@dataclass(frozen=True, slots=True)
class _Prepared:
    run: RunDirectory
    config: RunConfig
    plan: LaunchPlan


def _prepare(scenario: ScenarioFile, options: RunOptions) -> _Prepared:
    plan = make_plan(scenario.scenario)
    _check_manual(options.manual, plan)
    run = create_run(options.runs, scenario.scenario.name)
    config = with_manual_agents(scenario.run_config(run.name), options.manual)
    try:
        begin_run(run, config, plan.to_mapping())
        (run.path / "scenario.yaml").write_text(scenario_text(scenario), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{run.path}: cannot write there: {error.strerror or error}") from error
    return _Prepared(run, config, plan)


def scenario_text(scenario: ScenarioFile) -> str:
    """Return the scenario as it was run: the file itself, or with --set applied and defaults filled in."""
    if not scenario.overrides:
        return scenario.text
    changes = "".join(f"\n#   --set {override}" for override in scenario.overrides)
    resolved = yaml.safe_dump(scenario.to_mapping(), sort_keys=False, allow_unicode=True)
    return f"# {scenario.path.name}, with its defaults and:{changes}\n{resolved}"


def _finish(
    prepared: _Prepared, outcome: LaunchOutcome, *, has_report: bool, view: View
) -> RunSummary:
    # Imported late: the tables' library is large, and the run need not wait for it.
    from cosmos_cli.collect import finish_run
    from cosmos_cli.expectation import Expected

    view.state("COLLECTING")
    return finish_run(
        prepared.run,
        outcome.host_result,
        Expected.of(prepared.config, prepared.plan.agents_by_machine),
        interrupted=outcome.interruption != "no",
        problems=outcome.problems,
        has_report=has_report,
        progress=view.work,
    )


def _check_manual(manual: tuple[str, ...], plan: LaunchPlan) -> None:
    names = [name for agents in plan.agents_by_machine.values() for name in agents]
    unknown = [name for name in manual if name not in names]
    if unknown:
        shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
        raise InputError(f"--manual {', '.join(unknown)}: no such agent; there are {shown}")


def _greeting(prepared: _Prepared) -> str:
    agents, time = prepared.config.agents, prepared.config.time
    return (
        f"{prepared.run.name}: {agents.count} agents at {agents.tick_hz:g} Hz for"
        f" {time.duration_s:g} s; records go to {prepared.run.path}"
    )
