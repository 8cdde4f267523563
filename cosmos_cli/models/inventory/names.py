"""
Names of machines, and the ranges in them: pi[01:24], pi[1:9:2], rack[a:c]-pi[1:4]. Pure.

They mean what they mean to Ansible; a range that Ansible reads in a way that nobody expects, such as
[ab:cd], is refused.
"""

from __future__ import annotations

import itertools
import math
import re
import string
from collections.abc import Sequence

from cosmos_cli.models.text_forms import RECORDED_NAME

MACHINES_MAX = 5000
GROUP_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")
RESERVED_NAMES = ("host",)
"""Names of folders in a run's directory."""

_BRACKETS = re.compile(r"\[([^\[\]]*)\]")
_PORT = re.compile(r"((?:[^:\[\]]|\[[^\[\]]*\])*):([0-9]{1,9})")
_LABELS = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9_-]*[A-Za-z0-9])?")
_DIGITS = re.compile(r"[0-9]{1,18}")


def split_port(pattern: str) -> tuple[str, int | None]:
    """
    Split pi[1:3]:2222 into the name with its ranges and the port, None if there is none.

    Raises:
        ValueError: The port is none, or Ansible would take it for a part of the name.
    """
    match = _PORT.fullmatch(pattern)
    if match is None:
        return pattern, None
    name, port = match.group(1), int(match.group(2))
    labels = _BRACKETS.sub("0", name).split(".")
    is_understood = all(_LABELS.fullmatch(label) for label in labels)
    if name.startswith("[") or "[:" in name or not is_understood:
        raise ValueError(f"Ansible does not find the port in {pattern!r}: write ansible_port")
    if not 0 < port < 65536:
        raise ValueError(f"expected a port from 1 to 65535, got {port}")
    return name, port


def expand(pattern: str) -> list[str]:
    """
    Return the machines that a name with ranges means: pi[01:03] is pi01, pi02, pi03, both ends included.

    Raises:
        ValueError: It is no name, or a range is empty, too long, or not of numbers or letters.
    """
    pieces: list[Sequence[str]] = []
    position = 0
    for match in _BRACKETS.finditer(pattern):
        pieces += [[pattern[position : match.start()]], _range(match.group(1))]
        position = match.end()
    pieces.append([pattern[position:]])
    count = math.prod(map(len, pieces))
    if count > MACHINES_MAX:
        raise ValueError(f"expected at most {MACHINES_MAX} machines, got {count}")
    names = ["".join(parts) for parts in itertools.product(*pieces)]
    for name in names:
        _check_name(name, pattern)
    return names


def listed_machine(text: str) -> tuple[str, int | None]:
    """
    Return the name and the port of one machine of a list such as `pi01,pi02:2222,`.

    Raises:
        ValueError: It is no name of a machine, or a file or a range, which Ansible would take for a name.
    """
    if "/" in text or text.endswith((".yml", ".yaml", ".json")):
        raise ValueError(
            f"expected names of machines in a list, got {text!r}: give each file with an -i of its own"
        )
    if "[" in text:
        raise ValueError(
            f"Ansible knows no ranges in a list of machines: write each of {text!r}, or a file"
        )
    if "@" in text:
        raise ValueError(
            f"expected the name of a machine, got {text!r}: who logs in is said by ansible_user in a"
            " file, or by User in ~/.ssh/config"
        )
    name, port = split_port(text)
    _check_name(name, text)
    return name, port


def _check_name(name: str, pattern: str) -> None:
    if "[" in name or "]" in name:
        raise ValueError(f"expected a range such as pi[01:24], got {pattern!r}")
    if name in RESERVED_NAMES:
        raise ValueError(f"{name!r} is reserved; give the machine another name")
    if not RECORDED_NAME.fullmatch(name):
        text = f"expected letters, digits, '.', '_' or '-', got {name!r}"
        if ":" in name:
            text += ": give the machine a name, and its address in ansible_host"
        elif " " in name:
            text += ": write a colon after each machine, and each on its own line"
        raise ValueError(text)


def _range(text: str) -> Sequence[str]:
    """Return what stands for [*text*]."""
    bounds = text.split(":")
    if len(bounds) not in (2, 3):
        raise ValueError(f"expected a range such as [01:24], [1:9:2] or [a:f], got [{text}]")
    first, last, step_text = bounds[0] or "0", bounds[1], bounds[2] if bounds[2:] else "1"
    if not _DIGITS.fullmatch(step_text) or int(step_text) < 1:
        raise ValueError(f"expected a step >= 1, got {step_text!r} in [{text}]")
    if _DIGITS.fullmatch(first) and _DIGITS.fullmatch(last):
        return _numbers(first, last, int(step_text))
    if all(len(end) == 1 and end in string.ascii_letters for end in (first, last)):
        return _letters(first, last, int(step_text))
    raise ValueError(f"expected two numbers or two letters as ends, got [{text}]")


def _numbers(first: str, last: str, step: int) -> Sequence[str]:
    is_padded = first[0] == "0" and len(first) > 1
    if is_padded and len(first) != len(last):
        raise ValueError(f"expected ends of the same width, got [{first}:{last}]")
    numbers = range(int(first), int(last) + 1, step)
    if not numbers:
        raise ValueError(f"expected a rising range, got [{first}:{last}]")
    if len(numbers) > MACHINES_MAX:
        raise ValueError(f"expected at most {MACHINES_MAX} machines, got {len(numbers)}")
    width = len(first) if is_padded else 0
    return [f"{number:0{width}d}" for number in numbers]


def _letters(first: str, last: str, step: int) -> Sequence[str]:
    start, end = string.ascii_letters.index(first), string.ascii_letters.index(last)
    if end < start:
        raise ValueError(f"expected a rising range, got [{first}:{last}]")
    return string.ascii_letters[start : end + 1 : step]
