"""
The entry point `cosmos`: finds the command, runs it, and turns every error into text and an exit code.

A command's module is imported when it is invoked, so that quick commands stay quick.
"""

from __future__ import annotations

import contextlib
import copy
import gc
import importlib
import math
import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import typer
import typer.core

from cosmos_cli.errors import CosmosError, ExitCode, InputError, describe
from cosmos_cli.models.inventory_arguments import split_variable
from cosmos_cli.ui import invocation, step_times
from cosmos_cli.ui.console import (
    Console,
    OutputLost,
    let_go_of_output,
    open_standard_streams,
    print_error,
    print_json,
    tell_lost_output,
)
from cosmos_cli.ui.out_of_memory import is_out_of_memory, memory_text
from madns_runtime import __version__
from madns_runtime.errors import MadnsError

COMMANDS = (
    "init",
    "validate",
    "schema",
    "plan",
    "inventory",
    "up",
    "ping",
    "facts",
    "doctor",
    "devices",
    "exec",
    "packages",
    "reboot",
    "wipe",
    "run",
    "test",
    "inject",
    "ps",
    "down",
    "logs",
    "runs",
    "collect",
    "judge",
    "report",
    "diff",
    "rerun",
    "tabulate",
    "bench",
)
INVENTORY_VARIABLE = "COSMOS_INVENTORY"
GARBAGE_AFTER = 50_000
"""Objects made between two looks for garbage: what is imported later makes many, too."""
TIMED = (
    *("up", "ping", "facts", "doctor", "exec", "packages", "reboot", "wipe"),
    *("run", "collect", "logs", "ps", "down"),
)
"""Commands that take -v: they do one thing after the other, here and on machines."""
QUICK = ("ping", "exec", "up")
"""Commands whose every millisecond is told, and which leave nothing to be done here."""
USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
CLICK_ERROR: Any = USAGE_ERROR.__mro__[1]
"""Base of all errors of usage. Typer carries its own click since 0.2x, so click's own class would not match."""


class LazyGroup(typer.core.TyperGroup):
    """The command group: `cosmos_cli.commands.<verb>` holds a function of the verb's name."""

    verbs: Sequence[str] = COMMANDS
    prefix = ""
    """Verb of a group within the group, and a space."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the verbs in the order in which one meets them."""
        return list(self.verbs)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import one command and build it; None for an unknown one."""
        if cmd_name not in self.verbs:
            return None
        if cmd_name not in self.commands:
            self.commands[cmd_name] = load_command(f"{self.prefix}{cmd_name}")
        return self.commands[cmd_name]

    def invoke(self, ctx: Any) -> Any:
        """Run the command; typer would make a silent exit code of Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that is meant; typer looks for similar names among loaded ones only."""
        if args and args[0] not in self.verbs and not args[0].startswith("-"):
            import difflib  # for typing errors alone

            close = difflib.get_close_matches(args[0], self.verbs, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(self.verbs)}"
            raise USAGE_ERROR(f"no command {self.prefix + args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)


class StrictCommand(typer.core.TyperCommand):
    """A command that refuses an option given twice where one value counts: the first would be dropped in silence."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command's words."""
        seen: set[str] = set()
        for parameter in self.make_parser(ctx).parse_args(args=list(args))[2]:
            name = str(parameter.name)
            if name in seen and _counts_once(parameter):
                words = "/".join([*parameter.opts[:1], *parameter.secondary_opts[:1]])
                hint = f"; join the patterns: {words} 'A,B'" if name == "limit" else ""
                raise USAGE_ERROR(f"{words} is given twice, and only one could count{hint}", ctx)
            seen.add(name)
        invocation.record(
            str(self.name),
            args,
            frozenset(name for p in self.params if _takes_value(p) for name in p.opts),
            has_tail=not ctx.allow_interspersed_args,
        )
        return super().parse_args(ctx, args)


def _takes_value(parameter: Any) -> bool:
    is_option = parameter.param_type_name == "option"
    return is_option and not (parameter.is_flag or parameter.count)


def _counts_once(parameter: Any) -> bool:
    """Whether a second value would replace the first; a flag says the same however often it is given."""
    if parameter.param_type_name != "option" or parameter.multiple or parameter.count:
        return False
    return not parameter.is_flag or bool(parameter.secondary_opts)


def load_command(verb: str) -> Any:
    """Import `cosmos_cli.commands.<verb>` and return its function as a command, or as a group of its SUBCOMMANDS."""
    module = importlib.import_module(f"cosmos_cli.commands.{verb.replace(' ', '_')}")
    gc.set_threshold(GARBAGE_AFTER)
    gc.enable()
    function = getattr(module, verb.rpartition(" ")[2])
    if hasattr(module, "SUBCOMMANDS"):
        return _as_group(function, verb, module.SUBCOMMANDS)
    settings = getattr(module, "CONTEXT_SETTINGS", None)
    command = _as_command(function, name=verb, cls=StrictCommand, context_settings=settings)
    if verb in TIMED:
        command.params.append(_verbose_option())
    for parameter in command.params:
        parameter.callback = parameter.callback or _refuse_not_finite
        if parameter.envvar == INVENTORY_VARIABLE:
            parameter.type = _with_own_split(parameter.type)
    return command


def _verbose_option() -> Any:
    """Return the option -v, which is the same for every command and no command's affair."""

    def told(
        verbose: int = typer.Option(
            0,
            *("--verbose", "-v"),
            count=True,
            max=step_times.VERBOSITY_MAX,
            clamp=True,
            expose_value=False,
            callback=step_times.set_verbosity,
            show_default=False,
            help="Say on stderr how long each step of each machine took; -vv: each question, too.",
        ),
    ) -> None:
        """Hold the option."""

    return next(option for option in _as_command(told).params if option.name == "verbose")


def each_command() -> Iterator[tuple[str, Any]]:
    """Yield every command with its words, those of groups within the group as well."""
    for verb in COMMANDS:
        command = load_command(verb)
        if isinstance(command, LazyGroup):
            yield from (
                (f"{verb} {name}", load_command(f"{verb} {name}")) for name in command.verbs
            )
        else:
            yield verb, command


def _as_group(function: Any, verb: str, verbs: Sequence[str]) -> Any:
    """Return a group within the group; its commands stand in `cosmos_cli.commands.<verb>_<subcommand>`."""
    app = typer.Typer(
        name=verb, cls=LazyGroup, add_completion=False, no_args_is_help=True, rich_markup_mode=None
    )
    app.callback()(function)
    group: Any = typer.main.get_command(app)
    group.verbs, group.prefix = verbs, f"{verb} "
    return group


def _as_command(function: Any, **settings: Any) -> Any:
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    single.command(**settings)(function)
    return typer.main.get_command(single)


def _with_own_split(kind: Any) -> Any:
    """Return an option's type that reads several inventories from one variable; the original is shared by all texts."""
    own = copy.copy(kind)
    own.split_envvar_value = split_variable
    return own


def _refuse_not_finite(context: Any, parameter: Any, value: Any) -> Any:
    """Return an option's value; every range lets nan pass, and nobody means it or infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        raise typer.BadParameter(f"expected a finite number, got {value}", context, parameter)
    return value


def make_app() -> typer.Typer:
    """Return the application; tests run it through typer's CliRunner."""
    app = typer.Typer(
        name="cosmos",
        cls=LazyGroup,
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(cosmos)
    return app


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        Console().data(f"cosmos {__version__}")
        raise typer.Exit


def cosmos(
    version: bool = typer.Option(
        False, "--version", is_eager=True, callback=_print_version, help="Print the version."
    ),
    debug: bool = typer.Option(
        False, "--debug", envvar="COSMOS_DEBUG", help="Show the traceback of an unexpected error."
    ),
) -> None:
    """Test the flight software of satellite constellations and other swarms in real time."""
    if debug:
        os.environ["COSMOS_DEBUG"] = "1"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process with the exit code of DESIGN 9."""
    open_standard_streams()
    if not sys.warnoptions:
        # numpy's, of records that diverged: what comes of them tells, and a line of our source helps nobody.
        warnings.simplefilter("ignore", RuntimeWarning)
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    code = run(arguments)
    # At its end the interpreter would look through all objects for cycles, for 50 ms, and free them one by one.
    gc.freeze()
    if arguments and arguments[0] in QUICK:
        # What the system frees anyway is not freed here: nothing of a quick command is left to be done.
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code; every error has become text by then."""
    wants_json = "--json" in arguments
    try:
        code = typer.main.get_command(make_app()).main(
            arguments, prog_name="cosmos", standalone_mode=False
        )
        return _flushed(int(code) if isinstance(code, int) else int(ExitCode.OK))
    except (CosmosError, MadnsError) as error:
        return _report(
            describe(error),
            str(error),
            wants_json,
            bare=bool(isinstance(error, InputError) and error.faults),
        )
    except CLICK_ERROR as error:
        return _report_usage(error, wants_json)
    except (KeyboardInterrupt, typer.Abort):
        return _report(
            _plain("interrupted", "interrupted", int(ExitCode.INTERRUPTED)),
            "interrupted",
            wants_json,
            bare=True,
        )
    except BrokenPipeError:
        return _leave_quietly()
    except OutputLost as error:
        tell_lost_output(error)
        return int(ExitCode.RUN_FAILED)
    except Exception as error:  # noqa: BLE001 - the last seam: a defect of ours still ends in one line
        return _report_unexpected(error, wants_json)


def _plain(kind: str, message: str, exit_code: int) -> dict[str, Any]:
    return {"error": {"kind": kind, "message": message}, "exit_code": exit_code}


def _report(description: dict[str, Any], text: str, wants_json: bool, *, bare: bool = False) -> int:
    """Print an error; *bare* without the word: where file:line:col starts the line, and where nothing is wrong."""
    try:
        if wants_json:
            print_json(description)
        print_error(text, bare=bare)
    except OSError:  # nobody is there to read it; the exit code still tells
        _leave_quietly()
    return int(description["exit_code"])


def _report_usage(error: Any, wants_json: bool) -> int:
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return int(ExitCode.BAD_INPUT)
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "cosmos"
    text = f"{error.format_message()}\nsee `{command} --help`"
    return _report(_plain("usage", error.format_message(), ExitCode.BAD_INPUT), text, wants_json)


def _report_unexpected(error: Exception, wants_json: bool) -> int:
    if is_out_of_memory(error):
        return _report(
            _plain("memory", memory_text(), int(ExitCode.MACHINES)), memory_text(), wants_json
        )

    head = f"unexpected {type(error).__name__}: {error}"
    if os.environ.get("COSMOS_DEBUG"):
        print_error(traceback.format_exc().rstrip(), bare=True)
        advice = "this is a defect of COSMoS; please report it with the traceback above"
    else:
        advice = f"this is a defect of COSMoS; please report it {_kept_traceback()}"
    text = f"{head}\n{advice}"
    return _report(_plain("unexpected", text, ExitCode.RUN_FAILED), text, wants_json)


def _kept_traceback() -> str:
    """Keep the traceback of the error in a file, and say where; a full disk must not hide the error itself."""
    try:
        handle, path = tempfile.mkstemp(prefix="cosmos-error-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            traceback.print_exc(file=file)
    except OSError as error:
        return (
            f"with the traceback that COSMOS_DEBUG=1 shows; it could not be kept in a file:"
            f" {error.strerror or error}"
        )
    return f"with the traceback in {path}"


def _flushed(code: int) -> int:
    """Return the command's code when all it printed has left, else that of a failure if it had none."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return code or _leave_quietly()
    except OSError as error:
        tell_lost_output(error)
        return code or int(ExitCode.RUN_FAILED)
    return code


def _leave_quietly() -> int:
    """Whoever read our output has gone, as `head` does; the interpreter must not complain at exit."""
    let_go_of_output()
    return int(ExitCode.RUN_FAILED)


if __name__ == "__main__":
    main()
