"""What everything in the operator's loop shares."""

from __future__ import annotations

import selectors
from dataclasses import dataclass

from cosmos_cli.launch.background import Background
from cosmos_cli.launch.deadlines import Deadlines


@dataclass(frozen=True, slots=True)
class Loop:
    """The loop's descriptors, moments and threads."""

    selector: selectors.BaseSelector
    deadlines: Deadlines
    background: Background

    @classmethod
    def make(cls) -> Loop:
        """Return a loop in which nothing is waited for."""
        selector = selectors.DefaultSelector()
        return cls(selector, Deadlines(), Background(selector))
