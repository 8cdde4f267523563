"""A job of the host's: packed to travel, done in a worker, and what is told of one that has no value."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from concurrent.futures.process import _RemoteTraceback
from multiprocessing.reduction import ForkingPickler
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plain_values import LINE_CHARACTERS_MAX
from madns_runtime.plugin.code_places import error_text, line_of
from madns_runtime.plugin.context import clean_text, describe_exception

WORKER_DIED = "a worker of the executor has died: was it killed, or is memory short?"


class JobFailed(PluginError):
    """
    A submitted function raised, or it or its value cannot travel; the text says which, what and where.

    It travels back instead of the exception itself, whose traceback stays in the worker and which may
    not even be picklable.
    """


def run_job(function: Callable[..., Any], *arguments: Any) -> Any:
    """
    Do one job, in a worker.

    Raises:
        JobFailed: The function raised.
    """
    worker = os.getpid()
    try:
        return function(*arguments)
    except BaseException as error:  # a plug-in may raise anything
        name = getattr(function, "__qualname__", repr(function))
        raise JobFailed(describe_exception(error, name, function)) from error
    finally:
        # One that it forked would answer, too, and take the next jobs.
        if os.getpid() != worker:
            os._exit(0)


def describe_failed_job(error: BaseException, doing: str) -> str:
    """Say why a job, called *doing*, has no value: it raised, or cannot travel, or its executor works no more."""
    if isinstance(error, BrokenExecutor):
        return f"{doing}: {describe_broken(error)}"
    if isinstance(error, JobFailed):
        return f"{doing}: {error}"
    if isinstance(
        error.__cause__, _RemoteTraceback
    ):  # raised behind the job, in a worker of a pool
        return f"{doing}: {describe_unsent_value(error)}"
    return describe_exception(error, doing)


def describe_broken(error: BrokenExecutor) -> str:
    """Say why an executor works no more: a worker has died, or what a job returned cannot be unpacked."""
    told = str(error.__cause__ or "").strip().removesuffix("'''").strip().rpartition("\n")[2]
    return f"what it returned cannot be unpacked: {clean_text(told)}" if told else WORKER_DIED


def describe_unsent_job(function: Callable[..., Any], error: BaseException) -> str:
    """Say that a job has no form in which it reaches a worker, and what has one."""
    name, line = getattr(function, "__qualname__", repr(function)), line_of(function)
    return (
        f"{name}{line and f' ({line})'} cannot be sent to a worker ({_reason(error)}); give submit a function at the"
        " top of a module and plain arguments"
    )


def describe_unsent_value(error: BaseException) -> str:
    """Say that what a job returned has no form in which it reaches the host, and what has one."""
    return (
        f"what it returned cannot be sent back ({_reason(error)}); return plain values, arrays, or instances of classes"
        " at the top of a module"
    )


def _reason(error: BaseException) -> str:
    text = clean_text(error_text(error)).partition("\n")[0][:LINE_CHARACTERS_MAX]
    return text or type(error).__name__


def pack_job(function: Callable[..., Any], arguments: tuple[Any, ...]) -> bytes:
    """
    Return a job as it is now.

    A pool encodes what it is given later, in a thread of its own: what the submitter changes meanwhile, such as an
    array of states, would reach the job or not, whichever is first.

    Raises:
        JobFailed: A part of it has no such form, as a lock has none.
    """
    buffer = io.BytesIO()
    try:
        ForkingPickler(buffer, 5).dump((function, arguments))
    except Exception as error:  # classes of a plug-in may raise anything
        raise JobFailed(describe_unsent_job(function, error)) from error
    return buffer.getvalue()


def run_packed_job(packed: bytes) -> Any:
    """
    Do one job that `pack_job` has packed in the host's process, in a worker.

    Raises:
        JobFailed: The function raised, or cannot be found here.
    """
    try:
        function, arguments = ForkingPickler.loads(packed)
    except BaseException as error:  # an import may raise anything
        raise JobFailed(describe_exception(error, "unpacking the job")) from error
    return run_job(function, *arguments)
