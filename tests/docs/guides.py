"""What a person reads, and what of it is a command."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
"""Texts that tell what to type; the changelog tells what was, too."""
FLEET = (ROOT / "docs" / "fleet.md").read_text("utf-8")

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", flags=re.M | re.S)
_SPAN = re.compile(r"`([^`\n]+(?:\n[^`\n]+)?)`")


def blocks(text, language):
    """Return the contents of all fenced blocks in one language."""
    return [body for name, body in _FENCE.findall(text) if name == language]


def spans(text):
    """Return everything between backticks, blocks left out; a table's \\| is a |."""
    found = _SPAN.findall(_FENCE.sub("", text))
    return [" ".join(span.replace("\\|", "|").split()) for span in found]


def commands(text):
    """Return every `cosmos ...` that a text names, as words, without what a comment says."""
    return _lines_like(text, r"cosmos [a-z]+\b(?!:)")


def benchmark_commands(text):
    """Return every `python benchmarks/...` that a text names, in the same way."""
    return _lines_like(text, r"python benchmarks/\w+\.py\b")


def _lines_like(text, pattern):
    text = re.sub(r"\\\n\s*", "", text)
    lines = [line for block in blocks(text, "sh") for line in block.splitlines()]
    lines += [line[4:] for line in _FENCE.sub("", text).splitlines() if line.startswith("    ")]
    lines += spans(text)
    found = [re.sub(r"^\.venv/bin/", "", line.strip()) for line in lines]
    return [shlex.split(line, comments=True) for line in found if re.match(pattern, line)]


def row_keys(text, heading):
    """Return what stands between backticks in the first column of the table under a heading."""
    section = text.split(f"\n{heading}\n", 1)[1].split("\n#", 1)[0]
    firsts = re.findall(r"^\| ([^|]*`[^|]*?) \|", section.replace("\\|", "/"), flags=re.M)
    return [key for first in firsts for key in re.findall(r"`([^`]+)`", first)]


def run(command, folder, **variables):
    """Run lines of a guide in a shell that finds `cosmos`, in a folder, with a register of processes there."""
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "COSMOS_STATE_DIR": str(folder / "state"),
        **variables,
    }
    return subprocess.run(
        ["bash", "-ec", command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
