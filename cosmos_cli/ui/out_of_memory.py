"""
Memory that the system refuses: told as what it is, whoever met it first.

It shows as a MemoryError anywhere, as a library that cannot be mapped, a thread or process that cannot be started.
Little is imported here: there may be no room for more.
"""

from __future__ import annotations

import errno
import resource

CAUSES_MAX = 20
SIGNS = ("can't start new thread", "failed to map segment", "cannot allocate memory")


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error, or what led to it, is that there was no more memory."""
    present: BaseException | None = error
    for _ in range(CAUSES_MAX):
        if present is None:
            return False
        if isinstance(present, MemoryError) or getattr(present, "errno", None) == errno.ENOMEM:
            return True
        # The interpreter's ways to say it, at times.
        if isinstance(present, SyntaxError | SystemError) and _limits():
            return True
        if isinstance(present, ImportError | RuntimeError):
            text = str(present).lower()
            if any(sign in text for sign in SIGNS):
                return True
        present = present.__cause__ or present.__context__
    return False


def memory_text() -> str:
    """Return what to tell."""
    told = [f"`ulimit {name}` is {value // 1024} KiB" for name, value in _limits().items()]
    why = f" ({', '.join(told)}: raise it)" if told else "; end other programs, or ask for less"
    return f"out of memory: the system gives this process no more{why}"


def _limits() -> dict[str, int]:
    """Return what the shell has limited, by its option, bytes."""
    kinds = {"-v": resource.RLIMIT_AS, "-d": resource.RLIMIT_DATA}
    found = {name: resource.getrlimit(kind)[0] for name, kind in kinds.items()}
    return {name: value for name, value in found.items() if value != resource.RLIM_INFINITY}
