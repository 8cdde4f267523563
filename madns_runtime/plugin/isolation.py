"""
Runs a plug-in's code that is imported or asked, not driven by the loop: its talk goes to stderr, its faults have a place.

Standard output is data, for scripts; a plug-in's `print` must not spoil it. And a plug-in may end the
process (`sys.exit`) where it meant to end itself: that is a fault of the plug-in like any other.
"""

from __future__ import annotations

import itertools
import signal
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from madns_runtime.errors import MadnsError, MissingExtraError, PluginError
from madns_runtime.plugin.code_places import blame, error_text
from madns_runtime.plugin.time_limit import PluginStopped, hold

ITEMS_MAX = 1_000_000
"""Items of an answer: what has no end would fill the memory before its time is over."""
EXTRA_OF_MODULE = {
    "pyarrow": "host",
    "scipy": "host",
    "sgp4": "host",
    "zstandard": "host",
    "sense_hat": "sense-hat",
}


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
        PluginError: It raised, took too long, or wanted to end the process; the message gives file and line.
        MissingExtraError: It needs an optional dependency that is not installed.
        MadnsError: What it raised knowingly, as it is.
    """
    try:
        with hold():
            value = function(*arguments)
            return finish(value) if finish else value
    except MadnsError:
        raise
    except BaseException as error:  # a plug-in may raise anything
        if is_interruption(error):
            raise
        extra = missing_extra(error)
        if extra is not None:
            raise extra from error
        raise PluginError(f"{blame(error, function)}: {name}(): {said(error)}") from error


def unfolded(found: Any) -> Any:
    """
    Return a list of what a generator, or another iterable, gives: a generator does its work only then.

    Raises:
        ValueError: It gives more than ITEMS_MAX.
    """
    if isinstance(found, str | Mapping) or not isinstance(found, Iterable):
        return found
    items = list(itertools.islice(found, ITEMS_MAX + 1))
    if len(items) > ITEMS_MAX:
        raise ValueError(f"it gave more than {ITEMS_MAX} values; is there an end?")
    return items


def is_interruption(error: BaseException) -> bool:
    """Tell whether an error is somebody's Ctrl-C: where that is not heard, a plug-in raised it."""
    is_heard = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return isinstance(error, KeyboardInterrupt) and is_heard


def is_from_outside(error: BaseException) -> bool:
    """Tell whether an error that left a plug-in's code is none of its own: somebody's Ctrl-C, or the end of its time."""
    return isinstance(error, PluginStopped) or is_interruption(error)


def missing_extra(error: BaseException) -> MissingExtraError | None:
    """Return the error that names the command to install what is missing; None if it is something else."""
    if not isinstance(error, ModuleNotFoundError):
        return None
    missing = (error.name or "").partition(".")[0]
    extra = EXTRA_OF_MODULE.get(missing)
    return MissingExtraError(missing, extra) if extra else None


def said(error: BaseException) -> str:
    """Return an error's kind and words on one line."""
    if isinstance(error, SystemExit):
        return f"it called sys.exit({'' if error.code is None else repr(error.code)})"
    if isinstance(error, PluginStopped):
        return str(error)
    text = str(error.msg) if isinstance(error, SyntaxError) else error_text(error)
    text = " ".join(text.split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
