"""Access to a run: the scenario's, else the environment's, else private."""

from __future__ import annotations

import dataclasses
import os
import typing

from cosmos_cli.errors import InputError
from madns_runtime.config import Recording, RunConfig
from madns_runtime.recording.access import DEFAULT, Access

ACCESS_VARIABLE = "COSMOS_ACCESS"


def chosen_access(recording: Recording) -> Access:
    """
    Return the access of a run with these settings.

    Raises:
        InputError: They say nothing, and COSMOS_ACCESS is none of the three.
    """
    if recording.access is not None:
        return recording.access
    given = os.environ.get(ACCESS_VARIABLE) or DEFAULT
    if given not in typing.get_args(Access):
        expected = ", ".join(typing.get_args(Access))
        raise InputError(f"{ACCESS_VARIABLE}: expected one of {expected}, got {given!r}")
    return typing.cast("Access", given)


def with_access(config: RunConfig, access: Access) -> RunConfig:
    """Return the configuration with `recording.access` filled in: no machine asks its own environment."""
    return dataclasses.replace(
        config, recording=dataclasses.replace(config.recording, access=access)
    )
