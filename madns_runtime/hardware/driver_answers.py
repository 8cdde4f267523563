"""Values that a driver's methods return beside samples, looked at before they are used, and what they raise, in words."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from typing import Any

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.plugin.code_places import error_text
from madns_runtime.plugin.context import clean_text, describe_exception


def describe_fault(error: BaseException, where: str, called: Any = None) -> str:
    """Return in words what a driver's method *called* raised, or that its answer was refused; *where* names it."""
    if isinstance(error, MachineError):
        return clean_text(error_text(error))
    if isinstance(error, PluginError):
        return f"{where}: {clean_text(error_text(error))}"
    return describe_exception(error, where, called)


def identity_of(told: Any) -> str:
    """
    Return the identity that `open` gave; of nothing an empty one.

    Raises:
        PluginError: It is no text.
    """
    if told is None:
        return ""
    if not isinstance(told, str):
        raise PluginError(f"expected a text as the device's identity, got {told!r:.80}")
    return clean_text(told)


def descriptor_of(told: Any) -> int | None:
    """
    Return the descriptor that `fileno` gave.

    Raises:
        PluginError: It is none, not open, or that of a regular file, which is readable at any time.
    """
    if told is None:
        return None
    if not isinstance(told, int) or not 0 <= told < 1 << 31:
        raise PluginError(f"expected an open descriptor (a number), or None; got {told!r:.80}")
    try:
        mode = os.fstat(told).st_mode
    except OSError as error:
        raise PluginError(f"expected an open descriptor, got {told}: {error.strerror}") from None
    if stat.S_ISREG(mode):
        raise PluginError(
            "expected a descriptor that is readable when there is something new, got a regular file's, which always is:"
            " return None, to be read at the device's rate"
        )
    return told


def details_of(told: Any) -> Mapping[str, Any]:
    """
    Return what `health` gave; of nothing an empty mapping.

    Raises:
        PluginError: It is no mapping.
    """
    if told is None:
        return {}
    if not isinstance(told, Mapping):
        raise PluginError(f"expected a mapping of what is known of its state, got {told!r:.80}")
    return told
