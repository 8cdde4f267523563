"""Every command that a machine is given is one that each login shell reads alike: POSIX's, fish, tcsh."""

import dataclasses
import os
import re
import shlex
import subprocess

import pytest

from cosmos_cli.fleet.helper import start_command as helper_command
from cosmos_cli.fleet.shell import for_login_shell, watched
from cosmos_cli.launch.child import RemoteProgram, relay_command, start_command
from cosmos_cli.launch.machines import MachinePaths

PROGRAM = RemoteProgram(
    name="agents", module="madns_runtime.agent", run_directory="/home/pi/it's/runs/1", stderr="a/b"
)
PATHS = MachinePaths(
    root="/home/pi/it's",
    python="/usr/bin/python3",
    base_directory="/home/pi/it's/trees/1",
    state="/home/pi/it's/state",
    variables={"PYTHONPATH": "/home/pi/it's"},
)
COMMANDS = {
    "plain": for_login_shell("true"),
    "helper": helper_command(None, 100),
    "helper with a Python": helper_command("/opt/py thon/bin/python3", 100),
    "watched": watched(r"""printf '%s\\n' "it's" !x"""),
    "lines": watched("echo a\necho 'b\\nc'"),
    "lines as root": watched("echo a\necho 'b\\nc'", is_root=True),
    "as root": watched(r"""printf '%s\\n' "it's" !x""", is_root=True),
    "start": start_command(PROGRAM, PATHS),
    "relay": relay_command(PROGRAM, 1, PATHS),
}
NOT_ALIKE = re.compile(r"[\\!\n]")
"""What fish (the first) and tcsh (the others) read within single quotes, and other shells do not."""


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_login_shell_is_asked_for_one_program_with_plain_words(command):
    words = shlex.split(command)

    assert words[:3] == ["exec", "/bin/sh", "-c"]
    assert len(words) == 4
    bare = re.sub(r"""'[^']*'|"'"|\\[\\!]""", "", command)
    assert re.fullmatch(r"[\w /-]*", bare), "outside of quotes stands what a shell may read"


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_no_quotes_hold_what_some_shell_would_read_within_them(command):
    quoted = re.findall(r"""'([^']*)'|"'"|\\[\\!]""", command)

    assert not [text for text in quoted if NOT_ALIKE.search(text)]


@pytest.mark.parametrize("script", [r"echo 'a\\b\'", "echo it's !!", "", r"\\!\!"])
def test_script_arrives_as_it_was(script):
    assert shlex.split(for_login_shell(script))[3] == script


@pytest.mark.process
@pytest.mark.parametrize(
    "script", ["printf '%s|' a 'b\nc' 'd\\ne' 'f\\\\' '%b'\n", "exit 3\necho never"]
)
def test_script_of_several_lines_does_the_same_in_one(script):
    sent = for_login_shell(script)
    expected, got = (
        subprocess.run(["/bin/sh", "-c", each], capture_output=True, timeout=60, check=False)
        for each in (script, sent)
    )

    assert "\n" not in sent
    assert (got.returncode, got.stdout, got.stderr) == (expected.returncode, expected.stdout, b"")


ARGUMENT_BYTES_MAX = 128 * 1024
"""Of Linux, for each."""


def test_script_with_many_quotation_marks_still_fits_one_argument():
    assert len(watched("echo 'it'\n" * 800, is_root=True)) < ARGUMENT_BYTES_MAX


PATHS_LEFT = ["/nowhere", "", "/nowhere:/usr/local/bin"]


@pytest.mark.process
@pytest.mark.parametrize("path", PATHS_LEFT)
def test_program_is_started_where_the_path_lacks_the_systems_own_programs(tmp_path, path):
    program = dataclasses.replace(PROGRAM, run_directory=f"{tmp_path}/runs/1")
    paths = dataclasses.replace(PATHS, root=str(tmp_path), python="/usr/bin/true")

    done = run_with_path(start_command(program, paths), path)

    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.process
@pytest.mark.parametrize("path", PATHS_LEFT)
def test_helper_finds_sudo_and_a_watcher_sleep_where_the_path_lacks_them(tmp_path, path):
    python = tmp_path / "python3"
    python.write_text("#!/bin/sh\ncommand -v id\n")
    python.chmod(0o755)

    helper = run_with_path(helper_command(str(python), 1), path)
    asked = run_with_path(watched("command -v id"), path)

    assert [helper.stdout, asked.stdout] == [b"/usr/bin/id\n"] * 2


@pytest.mark.process
def test_another_pythons_home_is_kept_from_an_environments_interpreter(tmp_path):
    """As a start-up file there may export it: with it no environment finds its own modules."""
    python = tmp_path / "python3"
    python.write_text('#!/bin/sh\necho "home ${PYTHONHOME-none}"\n')
    python.chmod(0o755)
    program = dataclasses.replace(PROGRAM, run_directory=f"{tmp_path}/runs/1")
    paths = dataclasses.replace(PATHS, root=str(tmp_path), python=str(python))
    commands = (
        helper_command(str(python), 1),
        start_command(program, paths),
        relay_command(program, 1, paths),
    )

    said = [run_with_path(f"export PYTHONHOME=/other; {each}", "/usr/bin") for each in commands]

    assert [done.stdout.splitlines()[-1] for done in said] == [b"home none"] * 3


@pytest.mark.process
def test_path_that_has_the_systems_programs_stays_as_it_is():
    done = run_with_path(watched("echo $PATH"), "/opt/mine:/usr/bin:/sbin")

    assert done.stdout == b"/opt/mine:/usr/bin:/sbin\n"


def run_with_path(command, path):
    """Run a command as a login shell with this PATH does; its standard input stays open as long as it runs."""
    reads, writes = os.pipe()
    try:
        return subprocess.run(
            ["/bin/sh", "-c", command],
            env={"PATH": path},
            stdin=reads,
            capture_output=True,
            timeout=60,
            check=False,
        )
    finally:
        os.close(reads)
        os.close(writes)
