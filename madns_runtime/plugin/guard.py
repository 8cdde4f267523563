"""
Runs a plug-in's code that is imported or asked, not driven by the loop: its talk goes to stderr, its faults have a place.

Standard output is data, for scripts; a plug-in's `print` must not spoil it. And a plug-in may end the
process (`sys.exit`) where it meant to end itself: that is a fault of the plug-in like any other.
"""

from __future__ import annotations

import contextlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator
from typing import Any

from madns_runtime.errors import MadnsError, MissingExtraError, PluginError

EXTRA_OF_MODULE = {
    "pyarrow": "host",
    "scipy": "host",
    "sgp4": "host",
    "zstandard": "host",
    "sense_hat": "sense-hat",
}


@contextlib.contextmanager
def talk_on_stderr() -> Iterator[None]:
    """Let what is printed meanwhile go to stderr."""
    with contextlib.redirect_stdout(sys.stderr):
        yield


def call_plugin(
    name: str,
    function: Callable[..., Any],
    *arguments: Any,
    finish: Callable[[Any], Any] | None = None,
) -> Any:
    """
    Call a plug-in's function.

    Args:
        name: What it is called in the contract, such as check; for the message.
        function: What to call.
        arguments: For the function.
        finish: Takes what it returns and may run more of it: a generator does its work only then.

    Raises:
        PluginError: It raised, or wanted to end the process; the message gives file and line.
        MissingExtraError: It needs an optional dependency that is not installed.
        MadnsError: What it raised knowingly, as it is.
    """
    try:
        with talk_on_stderr():
            value = function(*arguments)
            return finish(value) if finish else value
    except MadnsError:
        raise
    except (Exception, SystemExit) as error:
        extra = missing_extra(error)
        if extra is not None:
            raise extra from error
        raise PluginError(f"{blame(error, function)}: {name}(): {said(error)}") from error


def missing_extra(error: BaseException) -> MissingExtraError | None:
    """Return the error that names the command to install what is missing; None if it is something else."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    missing = (error.name or "").partition(".")[0]
    return (
        MissingExtraError(missing, EXTRA_OF_MODULE[missing]) if missing in EXTRA_OF_MODULE else None
    )


def said(error: BaseException) -> str:
    """Return an error's kind and words on one line."""
    if isinstance(error, SystemExit):
        return f"it called sys.exit({'' if error.code is None else repr(error.code)})"
    text = str(error.msg) if isinstance(error, SyntaxError) else str(error)
    text = " ".join(text.split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def place_of(thing: Any) -> str:
    """Return file:line where a function or class is written; its name if that is not known."""
    try:
        thing = inspect.unwrap(thing)
        file = inspect.getsourcefile(thing)
        line = inspect.getsourcelines(thing)[1]
    except (OSError, TypeError, ValueError):
        return str(getattr(thing, "__qualname__", thing))
    return f"{file}:{line}"


def blame(error: BaseException, thing: Callable[..., Any]) -> str:
    """Return the last line of a function's or class's own file that took part in an error: its writer looks there first."""
    try:
        own = inspect.getsourcefile(inspect.unwrap(thing))
    except TypeError:
        own = None
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == own]
    return f"{own}:{frames[-1].lineno}" if frames else place_of(thing)
