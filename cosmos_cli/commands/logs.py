"""`cosmos logs`: what the host, the agents and their flight software said in a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Annotated

import typer

from cosmos_cli.collect.log_follower import LogFollower, sources_elsewhere
from cosmos_cli.collect.machine_sources import HOST, RecordingMachines
from cosmos_cli.commands.fleet_command import (
    AcceptHostKeysOption,
    PresentInventoryOption,
    ask_whether_moved,
)
from cosmos_cli.commands.run_arguments import RunArgument, RunsOption
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.evidence.run_directory import RunDirectory, runs_root
from cosmos_cli.evidence.run_log import LogLine, LogReading, in_order
from cosmos_cli.evidence.run_search import find_run
from cosmos_cli.evidence.table_labels import run_labels
from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import MachineFailure
from cosmos_cli.launch.living_processes import by_name, targets_of
from cosmos_cli.models.document import did_you_mean
from cosmos_cli.ui.console import Console, JsonOption, QuietOption
from cosmos_cli.ui.plural import counted
from madns_runtime.plain_values import first_few

NAMED_MAX = 5
SHOWN_MAX = 3
"""Agents, and machines, that are named where none is like what was asked for."""
LINES_DEFAULT = 10_000
LINES_MAX = 1_000_000
NO_TIME = " " * 12


class LogLevel(StrEnum):
    """The least loud that is shown; what stands on standard error always is."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"
    CRITICAL = "critical"


SourceArgument = Annotated[
    str | None,
    typer.Argument(metavar="[AGENT]", help="An agent, host, or a machine; default: all."),
]
FollowOption = Annotated[bool, typer.Option("--follow", "-f", help="Go on until the run ends.")]
LevelOption = Annotated[LogLevel, typer.Option("--level", help="The least loud that is shown.")]
LinesOption = Annotated[
    int | None,
    typer.Option(
        *("--lines", "-n"),
        min=0,
        max=LINES_MAX,
        metavar="N",
        help="The last N lines; default: 10000, with --follow all.",
    ),
]


def logs(
    run: RunArgument = "last",
    source: SourceArgument = None,
    follow: FollowOption = False,
    level: LevelOption = LogLevel.DEBUG,
    lines: LinesOption = None,
    folder: RunsOption = None,
    inventory: PresentInventoryOption = None,
    accept_new_host_keys: AcceptHostKeysOption = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Show what host, agents and flight software said, with UTC and simulated time: log streams and standard errors.

    Also of a run that lives, here or on its machines. --json prints one object per line. Ends with 3 when a
    machine cannot be asked.
    """
    console = Console(json=as_json, quiet=quiet)
    found = find_run(runs_root(folder), run)
    sources = RecordingMachines.read(found)
    names = _names(sources)
    source = _by_name(source, found, names)
    _expect_known(source, found, sources, names)
    printer = _Printer(console, width=max(map(len, names)))
    reading = LogReading(source=source, level=level.value)
    failed: set[str] = set()
    elsewhere = sources_elsewhere(found)
    options = ConnectOptions(
        accept_new_host_keys=accept_new_host_keys,
        listed=by_name(targets_of(inventory if elsewhere else None, None)),
    )

    failures: list[MachineFailure] = []

    def follower() -> LogFollower:
        return LogFollower(
            run=found,
            sources=elsewhere,
            reading=reading,
            options=options,
            on_failure=_failure_teller(console, failures),
            failed=failed,
        )

    if lines is not None or not follow:
        last = _Last(LINES_DEFAULT if lines is None else lines)
        for portion in follower().lines(is_following=False):
            last.add(portion)
        printer.print(last.lines())
        if last.left_out and lines is None:
            console.say(f"{counted(last.left_out, 'earlier line')} left out; --lines shows more")
    if follow:
        for portion in follower().lines(is_following=True):
            printer.print(portion)
        is_known = sources.host_machine not in failed
        console.say(
            f"{found.name} has ended"
            if is_known
            else f"{found.name}: {sources.host_machine}, its host's machine, gives no answer: whether it goes on is not"
            " known; repeat the command when that is back"
        )
    if failed:
        ask_whether_moved(console, failures, inventory, f"logs {found.shell_path}")
    is_silent = not printer.count and lines != 0
    machine = sources.machine_of_agent.get(source or "")
    _tell_rest(console, found, reading, level, is_silent=is_silent, machine=machine)
    return int(ExitCode.MACHINES if failed else ExitCode.OK)


def _failure_teller(
    console: Console, failures: list[MachineFailure]
) -> Callable[[str, MachineFailure], None]:
    """Return what tells the failure of a machine when it happens, and keeps it."""

    def tell(machine: str, failure: MachineFailure) -> None:
        failures.append(failure)
        console.say(f"{machine}: its log cannot be read: {failure}")

    return tell


def _by_name(source: str | None, run: RunDirectory, names: Sequence[str]) -> str | None:
    """
    Return the name of whom *source* means by its label, or itself.

    Raises:
        InputError: Several bear that label.
    """
    if source is None or source in names:
        return source
    found = [agent for agent, label in run_labels(run).names.items() if label == source]
    if len(found) > 1:
        named = ", ".join(found[:NAMED_MAX]) + (", ..." if len(found) > NAMED_MAX else "")
        raise InputError(f"{counted(len(found), 'agent')} are called {source!r}; name one: {named}")
    return found[0] if found else source


class _Printer:
    """Prints lines: time, source, level, text."""

    def __init__(self, console: Console, *, width: int) -> None:
        self.count = 0
        self._console = console
        self._width = width

    def print(self, lines: Sequence[LogLine]) -> None:
        """Print them in their order; each line of a text stands under its own head."""
        for line in lines:
            self.count += 1
            if self._console.json:
                self._console.print_json_line(line.to_mapping())
                continue
            time = line.utc[11:23].ljust(len(NO_TIME)) if line.utc else NO_TIME
            simulated = "" if line.t_s is None else f"{line.t_s:.3f}"
            head = f"{time}  {simulated:>10}  {line.source:<{self._width}}  {line.level:<8}  "
            self._console.data(
                "\n".join(head + part.rstrip("\r") for part in line.text.rstrip("\n").split("\n"))
            )


class _Last:
    """The last lines by time, in bounded memory."""

    def __init__(self, count_max: int) -> None:
        self.left_out = 0
        self._count_max = count_max
        self._lines: list[LogLine] = []

    def add(self, lines: Sequence[LogLine]) -> None:
        """Take lines."""
        self._lines += lines
        if len(self._lines) > 2 * self._count_max + 1000:
            self.lines()

    def lines(self) -> list[LogLine]:
        """Return them in order."""
        ordered = in_order(self._lines)
        first = max(0, len(ordered) - self._count_max)
        self.left_out += first
        self._lines = ordered[first:]
        return self._lines


def _names(sources: RecordingMachines) -> list[str]:
    return [
        HOST,
        *sources.machine_of_agent,
        *[source.machine for source in sources.remote],
        *dict.fromkeys(sources.machine_of_agent.values()),
    ]


def _expect_known(
    source: str | None, run: RunDirectory, sources: RecordingMachines, names: Sequence[str]
) -> None:
    """
    Refuse a source that the run has not; of a run without a plan nothing is known.

    Raises:
        InputError: It is none of the agents, the host or a machine.
    """
    if source is None or source in names or not sources.machine_of_agent:
        return
    hint = did_you_mean(source, names) if len(names) < 50 else ""
    if not hint.endswith("?"):
        agents = list(sources.machine_of_agent)
        machines = [name for name in dict.fromkeys(names) if name not in (HOST, *agents)]
        hint = f"; there are {HOST}, {first_few(agents, SHOWN_MAX)}, and as machines {first_few(machines, SHOWN_MAX)}"
    raise InputError(f"{run.name} has no agent, host or machine named {source}{hint}")


def _tell_rest(
    console: Console,
    run: RunDirectory,
    reading: LogReading,
    level: LogLevel,
    *,
    is_silent: bool,
    machine: str | None,
) -> None:
    """Tell what could not be read, and that nothing was said; *machine* is that of the one agent that is meant."""
    if reading.damaged:
        console.say(f"{counted(reading.damaged, 'line')} could not be read")
    if is_silent:
        config = run.read_config()
        loudness = f" at recording.verbosity {config.recording.verbosity}" if config else ""
        what = "nothing" if level is LogLevel.DEBUG else f"nothing as loud as {level.value}"
        place = HOST if config is not None and config.time.is_lockstep else machine
        # Agents may share a process: what it prints is nobody's own.
        printed = f"; what its process printed: cosmos logs {run.shell_path} {place}"
        console.say(
            f"{run.name}: {what} was said{loudness}{printed if machine is not None else ''}"
        )
