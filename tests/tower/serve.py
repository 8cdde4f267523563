"""The supervisor's process when a test starts it: its specification comes in, its state goes out."""

from __future__ import annotations

import json
import sys
from typing import Any

from .board import BoardError
from .console import show
from .disk import DiskError
from .network import NetworkError
from .roots import RootError
from .specification import TowerSpec
from .supervisor import Options, Supervisor

STARTUP_ERRORS = (BoardError, DiskError, NetworkError, RootError, OSError)


def print_state(state: dict[str, Any]) -> None:
    """Write one line for whoever started this process, when every board is up."""
    show(json.dumps(state))


def main() -> None:
    """Run one tower until standard input ends."""
    spec = TowerSpec.from_mapping(json.loads(sys.argv[1]))
    try:
        Supervisor(Options(spec=spec, ends_with_input=True, tell=lambda _: None)).run(print_state)
    except STARTUP_ERRORS as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
