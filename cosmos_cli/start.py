"""Start of `cosmos`: Ctrl-C and a memory that is full end it with a word and a code also while it is imported."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from types import ModuleType

from cosmos_cli.ui.out_of_memory import is_out_of_memory, memory_text

EXIT_CODE_MACHINES = 3
"""As cosmos_cli.errors says, which may not be there yet."""


def main() -> None:
    """Run the command line and end the process with its exit code."""
    try:
        _run()
    finally:
        _let_go_of_talk()


def _let_go_of_talk() -> None:
    """Give up what stderr does not take, as on a full disk: the interpreter would end with 120, whatever the verdict."""
    try:
        if sys.stderr is not None:
            sys.stderr.flush()
    except (OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 2)
        os.close(null)


def _run() -> None:
    gc.disable()  # imports make many objects and no garbage; the command itself is collected again
    # numpy's pool starts a thread per processor, which waits busily: a tenth of what this process of a short run computes.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        _import_app().main()
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):
            sys.stderr.write("interrupted\n")
        sys.exit(130)
    except Exception as error:
        if is_out_of_memory(error):  # and not even any to tell by the usual ways
            os.write(2, f"error: {memory_text()}\n".encode())
            os._exit(EXIT_CODE_MACHINES)
        raise


def _import_app() -> ModuleType:
    """Import the program; an agent's board, with the base install only, is told what the command line needs."""
    try:
        # Here, where Ctrl-C is heard: whoever starts the wrong command stops it in its first moment.
        from cosmos_cli import app
    except ModuleNotFoundError as error:
        if error.name != "typer":
            raise
        sys.exit(
            "error: the command line needs the operator's packages; "
            "install them with: pip install 'cosmos-madns[host]'"
        )
    return app


if __name__ == "__main__":
    main()
