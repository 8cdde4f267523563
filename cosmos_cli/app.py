"""The entry point `cosmos`: runs the command that is meant, and turns every error into text and an exit code."""

from __future__ import annotations

import contextlib
import errno
import gc
import os
import resource
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import typer

from cosmos_cli.commands.command_group import USAGE_ERROR, LazyGroup
from cosmos_cli.errors import CosmosError, ExitCode, InputError, describe, in_one_line
from cosmos_cli.ui import invocation
from cosmos_cli.ui.console import (
    Console,
    OutputLost,
    let_go_of_output,
    open_standard_streams,
    print_error,
    print_json,
    print_json_line,
    tell_lost_output,
)
from cosmos_cli.ui.out_of_memory import is_out_of_memory, memory_text
from madns_runtime import __version__
from madns_runtime.errors import MadnsError

EXIT_CODE_UNREAD = 128 + signal.SIGPIPE
"""As a shell tells of a program that wrote to a reader which has gone: no failure, and nothing that is whole."""
QUICK = ("ping", "exec", "up")
"""Commands whose every millisecond is told, and which leave nothing to be done here."""
OF_LINES = ("logs",)
"""Commands whose --json is one object per line, an error's as well."""
CLICK_ERROR: Any = USAGE_ERROR.__mro__[1]
"""Base of all errors of usage."""
HERE_GONE = "the current folder is gone: it was deleted; change to another one with cd"


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


class AtOnce(int):
    """Exit code of a process that is not taken down in order: a library that found no memory may crash at that."""


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
    if isinstance(code, AtOnce) or (arguments and arguments[0] in QUICK):
        # What the system frees anyway is not freed here: nothing of a quick command is left to be done.
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def run(arguments: list[str]) -> int:
    """Run the command line and return its exit code; every error has become text by then."""
    invocation.forget()
    try:
        code = typer.main.get_command(make_app()).main(
            arguments, prog_name="cosmos", standalone_mode=False
        )
        return _flushed(int(code) if isinstance(code, int) else int(ExitCode.OK))
    except (CosmosError, MadnsError) as error:
        description = describe(error)
        is_lost = description["exit_code"] == ExitCode.BAD_INPUT and _is_here_gone()
        text = _with_arguments_in_one_line(str(error), arguments)
        return _report(
            description,
            f"{text}\n{HERE_GONE}" if is_lost else text,
            _wants_json(arguments),
            bare=bool(isinstance(error, InputError) and error.faults),
        )
    except CLICK_ERROR as error:
        return _report_usage(error, _wants_json(arguments))
    except (KeyboardInterrupt, typer.Abort):
        return _report(
            _plain("interrupted", "interrupted", int(ExitCode.INTERRUPTED)),
            "interrupted",
            _wants_json(arguments),
            bare=True,
        )
    except BrokenPipeError:
        return _leave_quietly()
    except SystemExit as ended:
        if not isinstance(ended.__context__, BrokenPipeError):  # typer's answer to one is 1
            raise
        return _leave_quietly()
    except OutputLost as error:
        tell_lost_output(error)
        return int(ExitCode.RUN_FAILED)
    except Exception as error:  # noqa: BLE001 - the last seam: a defect of ours still ends in one line
        return _report_unexpected(error, _wants_json(arguments))


def _wants_json(arguments: Sequence[str]) -> bool:
    """Tell whether --json was asked for; before the command's words are understood, whether they seem to."""
    current = invocation.current()
    if current is not invocation.NOTHING:
        return current.has_option("--json")
    end = arguments.index("--") if "--" in arguments else len(arguments)
    return "--json" in arguments[:end]


def _print_description(description: dict[str, Any]) -> None:
    """Print an error as JSON, unless the command's one document is printed already: whoever reads it takes no second."""
    if invocation.current().verb in OF_LINES:
        print_json_line(description)
    elif not invocation.has_result():
        print_json(description)


def _plain(kind: str, message: str, exit_code: int) -> dict[str, Any]:
    return {"error": {"kind": kind, "message": message}, "exit_code": exit_code}


def _report(description: dict[str, Any], text: str, wants_json: bool, *, bare: bool = False) -> int:
    """Print an error; *bare* without the word: where file:line:col starts the line, and where nothing is wrong."""
    try:
        if wants_json:
            _print_description(description)
        print_error(text, bare=bare)
    except OSError:  # nobody is there to read it; the exit code still tells
        _leave_quietly()
    return int(description["exit_code"])


def _with_arguments_in_one_line(text: str, arguments: Sequence[str]) -> str:
    """Return an error without the ends of lines of what was typed: a script may hand on a name that it was given."""
    typed = {part for argument in arguments for part in (argument, *argument.split("=", 1))}
    for part in sorted(typed, key=len, reverse=True):
        if "\n" in part.strip():
            text = text.replace(part, in_one_line(part))
    return text


def _report_usage(error: Any, wants_json: bool) -> int:
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()
        return int(ExitCode.BAD_INPUT)
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "cosmos"
    message = error.format_message().replace(":\n\t", ": ").replace(",\n\t", ", ")  # choices
    text = f"{message}\nsee `{command} --help`"
    return _report(_plain("usage", message, ExitCode.BAD_INPUT), text, wants_json)


def _report_unexpected(error: Exception, wants_json: bool) -> int:
    if is_out_of_memory(error):
        told = _plain("memory", memory_text(), int(ExitCode.MACHINES))
        return AtOnce(_report(told, memory_text(), wants_json))

    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        text = f"{error.strerror}: `ulimit -n` is {limit}: raise it, or end programs that hold many open"
        return _report(_plain("descriptors", text, int(ExitCode.MACHINES)), text, wants_json)
    if isinstance(error, FileNotFoundError) and _is_here_gone():
        told = _plain(InputError.kind, HERE_GONE, ExitCode.BAD_INPUT)
        return _report(told, HERE_GONE, wants_json)
    if isinstance(error, RuntimeError) and _has_no_home():
        text = "no home folder is known of this user: set HOME to a folder of yours"
        return _report(_plain(InputError.kind, text, ExitCode.BAD_INPUT), text, wants_json)
    head = f"unexpected {type(error).__name__}: {error}"
    if os.environ.get("COSMOS_DEBUG"):
        print_error(traceback.format_exc().rstrip(), bare=True)
        advice = "this is a defect of COSMoS; please report it with the traceback above"
    else:
        advice = f"this is a defect of COSMoS; please report it {_kept_traceback()}"
    text = f"{head}\n{advice}"
    return _report(_plain("unexpected", text, ExitCode.RUN_FAILED), text, wants_json)


def _is_here_gone() -> bool:
    """Tell whether the current folder was deleted: no path can be made out of there, not even an absolute one."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _has_no_home() -> bool:
    """Tell whether neither HOME nor the system names the user's folder, as in a container that is given any user."""
    try:
        Path.home()
    except RuntimeError:
        return True
    return False


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
    """The reader of our output has gone, as `head` does; the interpreter must not complain at exit."""
    let_go_of_output()
    return EXIT_CODE_UNREAD


if __name__ == "__main__":
    main()
