"""
Setting of this machine's SSH server for PAM, which grants a login its limits; read, never asked as root.

As sshd reads it: keywords in whatever case, a value after blanks or one `=`, perhaps in double quotes, the
first one that is meant for all logins counts, Include takes patterns.
"""

from __future__ import annotations

import glob
import itertools
import os
import re

INCLUDE_DEPTH_MAX = 16
FILES_MAX = 200
TEXT_BYTES_MAX = 262_144
_LINE = re.compile(r'\s*"?([A-Za-z]+)"?(?:\s*=\s*|\s+)(.*)')
_WORD = re.compile(r'"([^"]*)"|([^\s"]+)')


def uses_pam(etc: str) -> bool | None:
    """
    Tell whether logins go through PAM; None when the configuration cannot be read.

    Args:
        etc: Where /etc is.
    """
    values: list[str] = []
    try:
        _read(f"{etc}/ssh/sshd_config", etc, values, 0)
    except OSError:
        return None
    return values[0].lower() == "yes" if values else False


def _read(path: str, etc: str, values: list[str], depth: int) -> None:
    """
    Gather what a file and those that it includes say, the first one first.

    Raises:
        OSError: One of them cannot be read, so that nobody knows what comes first.
    """
    with open(path, "rb") as file:
        text = file.read(TEXT_BYTES_MAX).decode(errors="replace")
    is_meant = True
    for line in text.splitlines():
        match = _LINE.match(line)
        if match is None or line.lstrip().startswith("#"):
            continue
        keyword, words = match[1].lower(), _words(match[2])
        if keyword == "match":
            is_meant = [word.lower() for word in words] == ["all"]
        if not is_meant:
            continue  # what holds for some logins only may not say it
        if keyword == "usepam" and words:
            values.append(words[0])
        if keyword == "include" and depth < INCLUDE_DEPTH_MAX:
            for pattern in words:
                for included in _files(pattern, etc):
                    _read(included, etc, values, depth + 1)
        if values:
            return


def _words(text: str) -> list[str]:
    """Return the words of a value, without quotes and what follows a #."""
    matches = itertools.takewhile(
        lambda match: not (match[2] or "").startswith("#"), _WORD.finditer(text)
    )
    return [match[2] if match[1] is None else match[1] for match in matches]


def _files(pattern: str, etc: str) -> list[str]:
    if pattern.startswith("/etc/"):
        pattern = f"{etc}/{pattern.removeprefix('/etc/')}"
    elif not os.path.isabs(pattern):
        pattern = f"{etc}/ssh/{pattern}"
    return sorted(glob.glob(pattern))[:FILES_MAX]
