"""The host's jobs in the executor: each has an owner, who takes its value, or has given it up."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from madns_runtime.errors import PluginError
from madns_runtime.plugin.api import HostContext

Owner = Callable[[Any], None]
"""Takes a job's value."""


class JobTable:
    """
    The jobs under way, each with its owner.

    Args:
        context: Whose executor works.
    """

    def __init__(self, context: HostContext) -> None:
        self._context = context
        self._owners: dict[int, Owner] = {}

    def submit(self, owner: Owner, function: Callable[..., Any], *arguments: Any) -> int:
        """Have a function computed for an owner and return the job's number."""
        job = self._context.submit(function, *arguments)
        self._owners[job] = owner
        return job

    def give_up(self, job: int) -> bool:
        """Let nobody take a job's value when it comes; False if it has come already."""
        if job not in self._owners:
            return False
        self._owners[job] = _nobody
        return True

    def take(self, job: int, value: Any) -> None:
        """
        Hand a job's value to its owner.

        Raises:
            PluginError: No such job is under way.
        """
        owner = self._owners.pop(job, None)
        if owner is None:
            raise PluginError(f"constellation: job {job} is not under way")
        owner(value)


def _nobody(_value: Any) -> None:
    """Take what is wanted no more."""
