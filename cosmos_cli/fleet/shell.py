"""
Commands for a machine's login shell, whichever that is, and those that end with whoever asked for them. Pure.

sshd hands a command to the login shell of the user, which may be fish or tcsh: neither reads what POSIX says.

Without a terminal, sshd lets a command run on when its connection closes. So a shell beside it waits for
the end of standard input, on which nothing is ever sent, and then ends the whole process group.
"""

from __future__ import annotations

import re
import shlex

NO_SUDO_MARK = "cosmos: no sudo"
BEGIN_MARK = "cosmos: the command begins"
FORCED_AFTER_S = 2
SYSTEM_PATH = "case :$PATH: in *:/usr/bin:*) ;; *) PATH=$PATH:/usr/bin:/bin; export PATH;; esac; "
"""Begins a script: a start-up file may have left a PATH without the system's own programs, such as mkdir and sudo."""
NO_PYTHON_HOME = "unset PYTHONHOME; "
"""Begins a script that starts a Python environment's interpreter: with another Python's home it finds no module."""

# $1 is the command. `read` returns at the end of standard input only; sshd and LocalConnection start each
# command in a session, thus a process group, of its own. A subshell keeps an `exit` in the command from
# leaving the watcher behind.
_WATCH = (
    "c=$1; shift; exec 3<&0 </dev/null; "
    '{ read -r _ <&3; trap "" TERM; kill -TERM 0; '
    f"sleep {FORCED_AFTER_S}; kill -KILL 0; }} >/dev/null 2>&1 & w=$!; "
    'exec 3<&-; (eval "$c"); s=$?; kill $w; exit $s'
)


def for_login_shell(script: str) -> str:
    """
    Return a command that has /bin/sh run *script*, for any login shell: POSIX's, fish, tcsh.

    Single quotes do not hide a backslash from fish, nor an exclamation mark from tcsh: those stand outside of
    them, where all shells read them alike. Nor do they hide the end of a line from tcsh: a script of several
    lines is sent as one, which has /bin/sh make it anew.
    """
    if "\n" in script:
        one_line = script.replace("\\", r"\\").replace("\n", r"\n")
        script = f'eval "$(printf %b {shlex.quote(one_line)})"'
    quoted = re.sub(r"[\\!]", r"'\\\g<0>'", shlex.quote(script))
    return f"exec /bin/sh -c {quoted}"


def watched(command: str, *, is_root: bool = False, has_mark: bool = False) -> str:
    """
    Return a shell command that does the same and is ended, with its children, when standard input ends.

    Args:
        command: Quoted once, however it is sent on: each level makes five of a quotation mark, and Linux takes
            128 KiB as one argument.
        is_root: Whether it is root's; NO_SUDO_MARK is the last that is said where the user may not.
        has_mark: Whether BEGIN_MARK is written to standard error first, for `without_mark`.
    """
    begin = f"echo {shlex.quote(BEGIN_MARK)} >&2; " if has_mark else ""
    root = (
        f'if [ "$(id -u)" != 0 ]; then sudo -n true || {{ echo {shlex.quote(NO_SUDO_MARK)} >&2; exit 1; }};'
        f' exec sudo -n /bin/sh -c {shlex.quote(_WATCH)} sh "$1"; fi; '
    )
    return for_login_shell(
        f"{SYSTEM_PATH}{begin}set -- {shlex.quote(command)}; {root if is_root else ''}{_WATCH}"
    )


def without_mark(errors: bytes) -> bytes | None:
    """Return a command's standard error without its BEGIN_MARK; None for one that never began, as where a start-up file exits."""
    before, mark, after = errors.partition(f"{BEGIN_MARK}\n".encode())
    return before + after if mark else None
