"""`cosmos down`: end runs from outside, here and on their machines, and only what they started."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from cosmos_cli.collect.machine_sources import RecordingMachine, RecordingMachines
from cosmos_cli.collect.retrieval_state import asked_sources
from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    TIMEOUT_S_MAX,
    AcceptHostKeysOption,
    ForksOption,
    LimitOption,
    SomeInventoryOption,
    ask_whether_moved,
    where_words,
)
from cosmos_cli.errors import ExitCode, InputError, MachinesError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.outcome import Outcome, failed, failure_teller
from cosmos_cli.fleet.retry_file import offer_retry_of
from cosmos_cli.fleet.target import Target
from cosmos_cli.launch.living_processes import (
    Fleetwide,
    LivingRun,
    Seen,
    by_name,
    is_called,
    living_runs,
    targets_of,
    unfinished_runs,
)
from cosmos_cli.onboard.processes import RunEnding, end_entries
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.name_ranges import compact
from cosmos_cli.ui.plural import counted
from madns_runtime.processes import ProcessEntry

CLEAN_TIMEOUT_S = 30.0
FORCED_TIMEOUT_S = 5.0


@dataclass(slots=True, kw_only=True)
class Doomed:
    """A run that is to end."""

    run: str
    directory: str
    here: LivingRun | None = None
    there: dict[str, RecordingMachine] = field(default_factory=dict)
    """By machine."""
    host: str | None = None
    """The machine of its host; None for this computer."""

    def is_on(self, targets: Sequence[Target]) -> bool:
        """Tell whether a part of it is on one of these machines."""
        is_here = self.here is not None and any(each.connection == "local" for each in targets)
        return is_here or any(each.name in self.there for each in targets)

    def is_called(self, which: str) -> bool:
        """Tell whether *which* is its name, its number or a directory of it, here or on a machine."""
        there = {source.directory for source in self.there.values()}
        return which in {self.directory, *there} or is_called(self.run, self.directory, which)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """Result of ending a run."""

    run: str
    here: RunEnding
    there: list[Outcome[RunEnding]]

    @property
    def is_left(self) -> bool:
        """Whether a process of it still lives, here or on a machine that answered."""
        return bool(self.here.left) or any(each.value and each.value.left for each in self.there)


def down(
    runs: Annotated[
        list[str] | None,
        typer.Argument(metavar="RUN...", help="Names, numbers or directories of runs."),
    ] = None,
    all_: Annotated[
        bool,
        typer.Option(
            "--all", help="End every living run; with --limit, those with a part on these machines."
        ),
    ] = False,
    inventory: SomeInventoryOption = None,
    limit: LimitOption = None,
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout",
            metavar="S",
            min=0.0,
            max=TIMEOUT_S_MAX,
            help="Time for a clean shutdown, s.",
        ),
    ] = CLEAN_TIMEOUT_S,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    End runs, here and on their machines: cleanly if they can, by force if they must.

    With an inventory also runs that are only found on its machines. Ends with 3 when a machine does
    not answer, with 1 when something lives still.
    """
    console = Console(json=json, quiet=quiet, instead="the exit code tells what lives still")
    listed = targets_of(inventory, limit)
    targets = [t for t in listed if t.connection != "local"]
    fleet = Fleetwide(
        options=ConnectOptions(accept_new_host_keys=accept_new_host_keys, listed=by_name(targets)),
        forks=forks,
        tell=failure_teller(console.say),
    )
    outcomes = fleet.look(targets)
    known = _every_run(targets, outcomes)
    unasked = [outcome.machine for outcome in failed(outcomes)]
    if all_ and limit is not None:
        known = [run for run in known if run.is_on(listed)]
    chosen = choose(known, runs or [], is_all=all_, unasked=unasked)
    ended = [_end(run, fleet, timeout_s, console.say) for run in chosen]
    bad = [each for one in ended for each in failed(one.there)] + failed(outcomes)
    for line in (line for one in ended for line in _lines(one)):
        console.data(line)
    if not chosen:
        where = where_words(len(outcomes) - len(unasked))
        console.say(f"no run lives {where}{_unasked_words(unasked)}")
    named = ["--all"] if all_ else runs or []
    failures = [outcome.failure for outcome in bad]
    ask_whether_moved(console, failures, inventory, shlex.join(["down", *named]))
    exit_code = _exit_code(ended, bad)
    # Runs that begin meanwhile are not to end by a repetition.
    retry = None if all_ else offer_retry_of(console, inventory, targets, [o.machine for o in bad])
    console.print_json(
        {
            "runs": [_mapping(one) for one in ended],
            "machines": [outcome.to_mapping() for outcome in outcomes],
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    return int(exit_code)


def _exit_code(ended: Sequence[Ended], bad: Sequence[Outcome[Any]]) -> ExitCode:
    if any(one.is_left for one in ended):
        return ExitCode.RUN_FAILED
    return ExitCode.MACHINES if bad else ExitCode.OK


def _every_run(targets: Sequence[Target], outcomes: Sequence[Outcome[list[Seen]]]) -> list[Doomed]:
    """Return the runs that are known here, and those that were seen on machines besides."""
    known = known_runs(living_runs(), unfinished_runs())
    return known + found_runs(known, targets, outcomes)


def known_runs(here: Sequence[LivingRun], unfinished: Sequence[RunDirectory]) -> list[Doomed]:
    """Return every run that lives here, or may live on the machines of its plan, by name."""
    found = {run.directory: Doomed(run=run.run, directory=run.directory, here=run) for run in here}
    for run in unfinished:
        found.setdefault(str(run.path), Doomed(run=run.name, directory=str(run.path)))
    for doomed in found.values():
        _add_machines(doomed, RunDirectory(Path(doomed.directory)))
    return sorted(found.values(), key=lambda each: (each.run, each.directory))


def found_runs(
    known: Sequence[Doomed], targets: Sequence[Target], outcomes: Sequence[Outcome[list[Seen]]]
) -> list[Doomed]:
    """Return the runs that were seen on machines and that nothing here knows of."""
    planned = {(s.machine, s.directory) for each in known for s in each.there.values()}
    target_of = by_name(targets)
    found: dict[str, Doomed] = {}
    for seen in (seen for outcome in outcomes for seen in outcome.value or ()):
        if (seen.machine, seen.directory) in planned:
            continue
        # One run has a folder of one name on all of its machines.
        folder = Path(seen.directory).name
        doomed = found.setdefault(folder, Doomed(run=seen.entry.run, directory=folder))
        source = RecordingMachine(target=target_of[seen.machine], directory=seen.directory)
        doomed.there[seen.machine] = source
        doomed.host = seen.machine if seen.entry.role == "host" else doomed.host
    return sorted(found.values(), key=lambda each: (each.run, each.directory))


def _add_machines(doomed: Doomed, run: RunDirectory) -> None:
    sources = RecordingMachines.read(run)
    doomed.there = {source.machine: source for source in asked_sources(run)}
    doomed.host = sources.host_machine


def choose(
    known: Sequence[Doomed],
    wanted: Sequence[str],
    *,
    is_all: bool,
    unasked: Sequence[str] = (),
) -> list[Doomed]:
    """
    Return the runs that are meant; *unasked* machines may have others.

    Raises:
        InputError: Nothing or something unknown was named, or a name that fits several.
        MachinesError: A run was named that none but the *unasked* machines may have.
    """
    if is_all and wanted:
        raise InputError(
            f"--all ends every living run, not only {', '.join(wanted)}; give one of both"
        )
    if is_all:
        return list(known)
    names = ", ".join(run.run for run in known) or "none"
    names += _unasked_words(unasked)
    if not wanted:
        raise InputError(f"name the runs to end, or give --all; living runs: {names}")
    chosen: list[Doomed] = []
    for which in wanted:
        found = [run for run in known if run.is_called(which)]
        found = found or _otherwise_called(which, known)
        if not found:
            unknown = MachinesError if unasked else InputError
            raise unknown(f"{which}: no such run lives on this machine; living runs: {names}")
        if len(found) > 1:
            directories = ", ".join(run.directory for run in found)
            raise InputError(f"{which}: several living runs; give the directory: {directories}")
        chosen += [run for run in found if run not in chosen]
    return chosen


def _unasked_words(machines: Sequence[str]) -> str:
    return f"; {compact(machines)} could not be asked" if machines else ""


def _otherwise_called(which: str, known: Sequence[Doomed]) -> list[Doomed]:
    """Return the run that `last` means; or one of which nothing says that it lives: its machines are asked."""
    try:
        run = find_run(runs_root(), which, is_read=False)
    except InputError:
        return []
    living = [each for each in known if each.directory == str(run.path)]
    if living:
        return living
    doomed = Doomed(run=run.name, directory=str(run.path))
    _add_machines(doomed, run)
    return [doomed]


def _end(run: Doomed, fleet: Fleetwide, clean_s: float, say: Callable[[str], None]) -> Ended:
    """End it where its operator is first, else its host: who follows them needs no force."""
    if run.there:
        say(f"{run.run}: asking {counted(len(run.there), 'machine')} to end it")
    first = [source for name, source in run.there.items() if name == run.host]
    rest = [source for name, source in run.there.items() if name != run.host]
    here = RunEnding(run=run.run)
    there: list[Outcome[RunEnding]] = []
    is_led_from_there = bool(first) and (run.here is None or not run.here.of_role("operator"))
    if is_led_from_there:
        there += fleet.end(first, clean_s=clean_s, forced_s=FORCED_TIMEOUT_S)
    if run.here is not None:
        here = end_entries(
            run.here.processes,
            directory=run.directory,
            clean_s=clean_s,
            forced_s=FORCED_TIMEOUT_S,
            say=say,
        )
    others = rest if is_led_from_there else first + rest
    there += fleet.end(others, clean_s=clean_s, forced_s=FORCED_TIMEOUT_S)
    return Ended(run=run.run, here=here, there=there)


def _lines(ended: Ended) -> list[str]:
    lines = [_words(ended.here)] if ended.here.ended or ended.here.left else []
    lines += [
        f"{each.machine}: {_words(each.value) if each.value else f'failed: {each.failure}'}"
        for each in ended.there
    ]
    return [f"{ended.run}: {line}" for line in lines or ["nothing of it lives"]]


def _words(ending: RunEnding) -> str:
    if ending.left:
        pids = ", ".join(str(entry.pid) for entry in ending.left)
        return f"still living: {pids}"
    if not ending.ended:
        return "nothing of it lives"
    by_force = f", {len(ending.killed)} of them by force" if ending.killed else ""
    return f"ended {counted(len(ending.ended), 'process')}{by_force}"


def _mapping(ended: Ended) -> dict[str, Any]:
    return {
        "run": ended.run,
        **_ending(ended.here),
        "machines": [
            outcome.to_mapping(_ending(outcome.value) if outcome.value else None)
            for outcome in ended.there
        ],
    }


def _ending(ending: RunEnding) -> Mapping[str, Any]:
    return {
        "ended": [_process(entry) for entry in ending.ended],
        "killed": [_process(entry) for entry in ending.killed],
        "left": [_process(entry) for entry in ending.left],
    }


def _process(entry: ProcessEntry) -> dict[str, Any]:
    return {"role": entry.role, "name": entry.name, "pid": entry.pid}
