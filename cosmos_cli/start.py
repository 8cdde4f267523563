"""
Where `cosmos` starts: machines are spoken to first, then the rest of the program is imported.

Nothing is imported above that waits for it to be needed: a fleet's servers work meanwhile.
"""

from __future__ import annotations

import gc
import sys


def main() -> None:
    """Run the command line and end the process with its exit code."""
    gc.disable()  # imports make many objects and no garbage; the command itself is collected again
    try:
        # Here, where Ctrl-C is heard: whoever starts the wrong command stops it in its first moment.
        from cosmos_cli.fleet import headstart

        headstart.begin(sys.argv[1:])
        from cosmos_cli import app
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(130)
    app.main()


if __name__ == "__main__":
    main()
