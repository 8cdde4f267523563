"""The table of checks in the documentation is that of the program."""

from __future__ import annotations

import re
from pathlib import Path

from cosmos_cli.commands.command_group import COMMANDS
from cosmos_cli.doctor.judge import CHECKS

FLEET = Path(__file__).parents[3] / "docs/fleet.md"


def test_every_check_is_documented_in_its_order() -> None:
    section = FLEET.read_text(encoding="utf-8").split("\n## Doctor\n")[1].split("\n## ")[0]
    table = section.split("| check |")[1]

    assert re.findall(r"^\| `(\w+)` \|", table, flags=re.MULTILINE) == list(CHECKS)


def test_every_command_that_is_named_exists() -> None:
    named = set(re.findall(r"(?:`|\n    )cosmos ([a-z]+)", FLEET.read_text(encoding="utf-8")))

    assert {"doctor", "reboot", "packages"} <= named <= set(COMMANDS)
