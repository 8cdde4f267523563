"""
The entry point `cosmos`: finds the command, runs it, and turns every error into text and an exit code.

A command's module is imported when it is invoked, so that quick commands stay quick.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import math
import os
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import Any, NoReturn

from cosmos_cli.errors import CosmosError, ExitCode, InputError, describe
from cosmos_cli.fleet import headstart
from madns_runtime.errors import MadnsError

try:
    import typer
    import typer.core
except ModuleNotFoundError:  # an agent's board has the base install only
    sys.exit(
        "error: the command line needs the operator's packages; "
        "install them with: pip install 'cosmos-madns[host]'"
    )

COMMANDS = (
    "init",
    "validate",
    "schema",
    "plan",
    "inventory",
    "up",
    "ping",
    "doctor",
    "exec",
    "packages",
    "reboot",
    "wipe",
    "run",
    "ps",
    "down",
    "runs",
    "collect",
    "report",
    "diff",
)
GARBAGE_AFTER = 50_000
"""Objects made between two looks for garbage: what is imported later makes many, too."""
USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
CLICK_ERROR: Any = USAGE_ERROR.__mro__[1]
"""Base of all errors of usage. Typer carries its own click since 0.2x, so click's own class would not match."""


class LazyGroup(typer.core.TyperGroup):
    """The command group: `cosmos_cli.commands.<verb>` holds a function of the verb's name."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the verbs in the order in which one meets them."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import one command and build it; None for an unknown one."""
        if cmd_name not in COMMANDS:
            return None
        if cmd_name not in self.commands:
            self.commands[cmd_name] = load_command(cmd_name)
        return self.commands[cmd_name]

    def invoke(self, ctx: Any) -> Any:
        """Run the command; typer would make a silent exit code of Ctrl-C."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise typer.Abort from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that is meant; typer looks for similar names among loaded ones only."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            import difflib

            close = difflib.get_close_matches(args[0], COMMANDS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(COMMANDS)}"
            raise USAGE_ERROR(f"no command {args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)


def load_command(verb: str) -> Any:
    """Import `cosmos_cli.commands.<verb>` and return its function as a command."""
    module = importlib.import_module(f"cosmos_cli.commands.{verb}")
    gc.set_threshold(GARBAGE_AFTER)
    gc.enable()
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    settings = getattr(module, "CONTEXT_SETTINGS", None)
    single.command(name=verb, context_settings=settings)(getattr(module, verb))
    command = typer.main.get_command(single)
    for parameter in command.params:
        parameter.callback = parameter.callback or _refuse_not_finite
    return command


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
        from madns_runtime import __version__

        typer.echo(f"cosmos {__version__}")
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
    from cosmos_cli.console import open_standard_streams

    open_standard_streams()
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    code = run(arguments)
    # At its end the interpreter would look through all objects for cycles, for 50 ms, and free them one by one.
    gc.freeze()
    if headstart.is_quick(arguments):
        _end_at_once(code)
    sys.exit(code)


def _end_at_once(code: int) -> NoReturn:
    """End without freeing what the system frees anyway: nothing of a quick command is left to be done."""
    with contextlib.suppress(OSError, ValueError):
        sys.stderr.flush()
    os._exit(code)


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code; every error has become text by then."""
    wants_json = "--json" in arguments
    try:
        code = typer.main.get_command(make_app()).main(
            arguments, prog_name="cosmos", standalone_mode=False
        )
        return _flushed(int(code) if isinstance(code, int) else int(ExitCode.OK))
    except (CosmosError, MadnsError) as error:
        has_places = isinstance(error, InputError) and error.faults
        return _report(describe(error), str(error), wants_json, bare=bool(has_places))
    except CLICK_ERROR as error:
        return _report_usage(error, wants_json)
    except (KeyboardInterrupt, typer.Abort):
        told = _plain("interrupted", "interrupted", int(ExitCode.INTERRUPTED))
        return _report(told, "interrupted", wants_json, bare=True)
    except BrokenPipeError:
        return _leave_quietly()
    except OSError as error:
        return _report_lost_output(error, wants_json)
    except Exception as error:  # noqa: BLE001 - the last seam: a defect of ours still ends in one line
        return _report_unexpected(error, wants_json)
    finally:
        headstart.close()


def _plain(kind: str, message: str, exit_code: int) -> dict[str, Any]:
    return {"error": {"kind": kind, "message": message}, "exit_code": exit_code}


def _report(description: dict[str, Any], text: str, wants_json: bool, *, bare: bool = False) -> int:
    """Print an error; *bare* without the word: where file:line:col starts the line, and where nothing is wrong."""
    from cosmos_cli.console import print_error, print_json

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
    head = f"unexpected {type(error).__name__}: {error}"
    if os.environ.get("COSMOS_DEBUG"):
        traceback.print_exc()
        advice = "this is a defect of COSMoS; please report it with the traceback above"
    else:
        handle, path = tempfile.mkstemp(prefix="cosmos-error-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            traceback.print_exc(file=file)
        advice = f"this is a defect of COSMoS; please report it with the traceback in {path}"
    text = f"{head}\n{advice}"
    return _report(_plain("unexpected", text, ExitCode.RUN_FAILED), text, wants_json)


def _flushed(code: int) -> int:
    """Return the command's code when all it printed has left, else that of a failure if it had none."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        return code or _leave_quietly()
    except OSError as error:
        from cosmos_cli.console import tell_lost_output

        tell_lost_output(error)
        return code or int(ExitCode.RUN_FAILED)
    return code


def _report_lost_output(error: OSError, wants_json: bool) -> int:
    from cosmos_cli.console import OutputLost, tell_lost_output

    if not isinstance(error, OutputLost):
        return _report_unexpected(error, wants_json)
    tell_lost_output(error)
    return int(ExitCode.RUN_FAILED)


def _leave_quietly() -> int:
    """Whoever read our output has gone, as `head` does; the interpreter must not complain at exit."""
    from cosmos_cli.console import let_go_of_output

    let_go_of_output()
    return int(ExitCode.RUN_FAILED)


if __name__ == "__main__":
    main()
