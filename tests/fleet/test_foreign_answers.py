"""What boards answer is foreign text: hostile boards behind a real sshd, and every command that asks them."""

import json
import subprocess
import sys

import pytest
from harness.wheel_cache import begin_cache
from up_tower import UpTower

pytestmark = pytest.mark.root

COSMOS = (sys.executable, "-m", "cosmos_cli.start")
HOSTILE = r"\033]0;owned\007\033[2J\033[31m\302\2331m\177\342\200\256\342\200\213[red]{task}"
"""As printf takes it; \302\233 is the one-character beginning of a control sequence."""
RAW = set(map(chr, [*range(9), *range(11, 32), *range(0x7F, 0xA0), 0x202E, 0x200B]))
"""No control but the tab and the end of a line, no letter that turns others round or is not seen."""
LIAR = f"""#!/bin/sh
printf '{HOSTILE}\\n{HOSTILE}\\n' >&2
printf '{HOSTILE}\\n'
exit 3
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return begin_cache(tmp_path_factory.mktemp("cache"))


@pytest.fixture
def fleet(tower8, tmp_path, cache):
    fleet = UpTower(tower8, tmp_path, cache)
    fleet.write(boards=["pi01", "pi02"])
    return fleet


def said(fleet, *arguments):
    """Run a command off a terminal, both streams together."""
    done = subprocess.run(
        [*COSMOS, *arguments, "-i", str(fleet.inventory)],
        env=fleet.cosmos.environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=180,
        check=False,
    )
    return done.returncode, done.stdout.decode()


def assert_harmless(text):
    found = RAW & set(text)
    assert not found, ascii(text)


@pytest.mark.parametrize("stream", ["", " >&2"])
def test_exec_shows_escapes_of_a_board_and_loses_none(fleet, stream):
    code, text = said_exec(fleet, f"printf '{HOSTILE}\\na\\tb\\r\\n'{stream}")

    assert code == 0
    assert_harmless(text)
    assert r"pi01 | \x1b]0;owned\x07\x1b[2J\x1b[31m\x9b1m\x7f\u202e\u200b[red]{task}" in text
    assert "pi02 | a\tb\n" in text


def said_exec(fleet, line, *options):
    inventory = ["-i", str(fleet.inventory)]
    done = subprocess.run(
        [*COSMOS, "exec", *inventory, *options, "--", line],
        env=fleet.cosmos.environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=180,
        check=False,
    )
    return done.returncode, done.stdout.decode()


def test_json_of_exec_holds_the_output_as_it_came(fleet):
    _, text = said_exec(fleet, f"printf '{HOSTILE}'", "--json", "-q")

    assert_harmless(text)
    assert json.loads(text)["machines"][0]["stdout"].startswith("\x1b]0;owned\x07\x1b[2J")


@pytest.mark.parametrize(
    "lie",
    [
        "python",
        *(pytest.param(lie, marks=pytest.mark.nightly) for lie in ("system", "sudo", "apt")),
    ],
)
def test_no_command_lets_a_hostile_board_steer_the_terminal(fleet, lie):
    places = {
        "python": "/usr/bin/python3",
        "sudo": "/usr/bin/sudo",
        "apt": "/usr/bin/apt-get",
    }
    for name in ("pi01", "pi02"):
        if lie == "system":
            command = (
                f"printf \"PRETTY_NAME='{HOSTILE}'\\nID='{HOSTILE}'\\n\" | sudo tee /etc/os-release"
            )
        else:
            move = f"sudo mv {places[lie]} {places[lie]}.true"
            write = f'printf %s "$L" > /tmp/l && chmod 755 /tmp/l && {move}'
            last = f"sudo{'.true' if lie == 'sudo' else ''} cp /tmp/l {places[lie]}"
            command = f"L=$(cat <<'END'\n{LIAR}END\n)\n{write} && {last}"
        fleet.tower.run(name, command)

    for arguments in (
        ("ping",),
        ("up", "--check"),
        ("up",),
        ("doctor",),
        ("ps",),
        ("wipe", "--yes"),
        ("packages", "install", "cosmos-test-hello"),
        ("reboot", "--yes", "--timeout", "1"),
        ("ping", "--json"),
    ):
        code, text = said(fleet, *arguments)

        assert "defect" not in text, (arguments, text)
        assert code in (0, 1, 2, 3, 4), (arguments, text)
        assert_harmless(text)
