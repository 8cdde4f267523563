"""
Turns of the threads that import: one at a time.

Two threads that import modules which need each other (invoke's own copy of yaml asks for yaml's compiled part, say)
may wait for each other, which ends in a _DeadlockError, or find the other's module half made.
"""

from __future__ import annotations

import threading
from typing import Final

IMPORT_TURN: Final = threading.RLock()
"""Held around every import inside a function: such are for what would delay each start, and threads meet them."""
