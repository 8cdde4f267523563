"""Chooses how a run is shown."""

from __future__ import annotations

import sys
import time

from cosmos_cli.console import is_terminal
from cosmos_cli.launch.outcome import View
from cosmos_cli.view.plain import PlainView, SilentView


def make_view(title: str, duration_s: float, *, quiet: bool) -> View:
    """Return the view that fits standard error: live on a terminal, lines elsewhere, errors only if *quiet*."""
    if quiet:
        return SilentView(sys.stderr, duration_s, now_s=time.monotonic)
    if is_terminal(sys.stderr):
        from cosmos_cli.view.live import LiveView  # rich costs a tenth of a second to import

        return LiveView(sys.stderr, title, duration_s=duration_s)
    return PlainView(sys.stderr, duration_s, now_s=time.monotonic)
