"""`cosmos exec`: one command on all machines at once."""

from __future__ import annotations

import dataclasses
import functools
import shlex
from collections.abc import Callable
from typing import Annotated, Any

import typer

from cosmos_cli.commands.fleet_command import (
    FORKS_DEFAULT,
    TIMEOUT_S_MAX,
    AcceptHostKeysOption,
    ForksOption,
    InventoryOption,
    LimitOption,
    fleet_of,
    warn_of_same,
)
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.fleet.connection import Completed, Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure, runs_no_commands
from cosmos_cli.fleet.outcome import Outcome, failed
from cosmos_cli.fleet.retry_file import offer_retry
from cosmos_cli.fleet.shell import NO_SUDO_MARK, watched, without_mark
from cosmos_cli.fleet.target import require_root
from cosmos_cli.ui.console import WORK_GOES_ON, Console, JsonOption, QuietOption
from cosmos_cli.ui.foreign_text import clean_text
from cosmos_cli.ui.plural import counted

CONTEXT_SETTINGS = {"allow_interspersed_args": False}
"""All words after the command's first belong to it, with or without -- before."""
TIMEOUT_S = 600.0
LEFT_OPEN = "what it left running there holds its output, and is not waited for"


def exec(  # noqa: A001 - the verb's name is the function's
    inventory: InventoryOption,
    command: Annotated[
        list[str],
        typer.Argument(
            metavar="COMMAND...",
            help="One argument is a line for /bin/sh; several are a program and its arguments.",
        ),
    ],
    limit: LimitOption = None,
    sudo: Annotated[bool, typer.Option("--sudo", help="As root, through sudo -n.")] = False,
    timeout_s: Annotated[
        float,
        typer.Option(
            "--timeout", metavar="S", min=0.1, max=TIMEOUT_S_MAX, help="Time for the command, s."
        ),
    ] = TIMEOUT_S,
    forks: ForksOption = FORKS_DEFAULT,
    accept_new_host_keys: AcceptHostKeysOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> int:
    """
    Run a command on every machine at once; it ends with this one, also on Ctrl-C.

    Ends with 1 when it failed on any machine or the disk did not take what they said, with 3 when a machine itself
    failed.
    """
    console = Console(json=json, quiet=quiet, instead=WORK_GOES_ON)
    if not any(word.strip() for word in command):
        raise InputError("expected a command behind --, got an empty text")
    fleet = fleet_of(inventory, limit, forks, accept_new_host_keys)
    warn_of_same(console, fleet)
    line = command[0] if len(command) == 1 else shlex.join(command)
    width = max(len(target.name) for target in fleet.targets)
    try:
        outcomes = fleet.each_target(
            _task(line, is_root=sudo, timeout_s=timeout_s),
            lambda outcome: _print(console, outcome, width),
        )
    except KeyboardInterrupt:
        console.say("what still ran there is ended")
        raise
    bad = len(failed(outcomes))
    nonzero = sum(bool(outcome.value and outcome.value.exit_status) for outcome in outcomes)
    exit_code = ExitCode.MACHINES if bad else ExitCode.RUN_FAILED if nonzero else ExitCode.OK
    retry = offer_retry(
        console,
        fleet.sources,
        failed=[o.machine for o in outcomes if o.value is None or o.value.exit_status],
        count=len(outcomes),
    )
    console.say(_verdict(len(outcomes), bad, nonzero))
    console.print_json(
        {
            "command": line,
            "machines": [outcome.to_mapping(_mapping(outcome.value)) for outcome in outcomes],
            "retry": retry,
            "exit_code": int(exit_code),
        }
    )
    # What machines said is nowhere else: a full disk that took it must not pass for success.
    return int(exit_code) or (int(ExitCode.RUN_FAILED) if console.lost else 0)


def _task(line: str, *, is_root: bool, timeout_s: float) -> Callable[[Connection], Completed]:
    shell_line = watched(line, is_root=is_root, has_mark=True)

    def task(connection: Connection) -> Completed:
        if is_root:
            require_root(connection.target, "leave out --sudo, or that machine with --limit")
        done = connection.run(shell_line, stdin=None, timeout_s=timeout_s)
        errors = without_mark(done.stderr)
        if errors is None:
            said = (done.stderr or done.stdout).decode(errors="replace")
            raise runs_no_commands(done.exit_status, said)
        done = dataclasses.replace(done, stderr=errors)
        if is_root and done.stderr.rstrip().endswith(NO_SUDO_MARK.encode()):
            said = done.stderr.decode(errors="replace").replace(NO_SUDO_MARK, "").strip()
            raise MachineFailure(
                FailureKind.NO_SUDO,
                f"cannot become root without a password: {said}",
                "let the user run sudo without one (a file in /etc/sudoers.d)",
            )
        return done

    return task


def _print(console: Console, outcome: Outcome[Completed], width: int) -> None:
    """
    Print what a machine said, each line under its name: output as data, errors as talk.

    Its colours and cursor movements are shown as escapes, on a terminal, too: other than Ansible, which passes
    them on, for one machine could then write over what the others said. Under --json they stand as they came.
    """
    head = f"{outcome.machine:<{width}}"
    done = outcome.value
    if done is None:
        console.say(f"{head} ! {outcome.failure}")
        return
    errors = functools.partial(console.say, length_max=None)
    for text, tell in ((done.stdout, console.data), (done.stderr, errors)):
        if text:
            lines = clean_text(text.decode(errors="replace")).removesuffix("\n").split("\n")
            tell("\n".join(f"{head} | {line}" for line in lines))
    if done.is_left_open:
        console.say(f"{head} ! {LEFT_OPEN}")
    if status := done.exit_status:
        words = f"ended by signal {-status}" if status < 0 else f"exit status {status}"
        console.say(f"{head} ! {words}")


def _mapping(done: Completed | None) -> dict[str, Any]:
    if done is None:
        return {
            "exit_status": None,
            "stdout": None,
            "stderr": None,
            "cut_bytes": 0,
            "left_running": False,
        }
    return {
        "exit_status": done.exit_status,
        "stdout": done.stdout.decode(errors="replace"),
        "stderr": done.stderr.decode(errors="replace"),
        "cut_bytes": done.cut_bytes,
        "left_running": done.is_left_open,
    }


def _verdict(count: int, bad: int, nonzero: int) -> str:
    parts = [f"{count - bad - nonzero} ok"]
    parts += [f"{nonzero} exit status not 0"] if nonzero else []
    parts += [f"{counted(bad, 'machine')} failed"] if bad else []
    return f"{counted(count, 'machine')}: {', '.join(parts)}"
