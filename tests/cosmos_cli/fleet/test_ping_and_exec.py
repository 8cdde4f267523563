"""`cosmos ping` and `cosmos exec` on real sshds, and on machines that fail in their own ways."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness.ports import free_port
from ssh_harness import needs_sshd, write_configuration
from sshd import Sshd, silent_server

from cosmos_cli.app import run

pytestmark = pytest.mark.process

WAIT_S = 120.0


@pytest.fixture(scope="module")
def servers(tmp_path_factory):
    needs_sshd()
    with contextlib.ExitStack() as stack:
        yield [
            stack.enter_context(
                Sshd(tmp_path_factory.mktemp(f"s{n}"), address=f"127.0.0.{n}", environment=f"N={n}")
            )
            for n in (1, 2, 3)
        ]


@pytest.fixture
def inventory(servers, tmp_path, known_hosts, home):
    """Write an inventory of the servers and of further machines, and return its path."""
    # Several logins at once take a busy computer long.
    write_configuration(home / ".ssh" / "config", "Host *", "  ConnectTimeout 60")
    known_hosts.write_text("".join(server.known_hosts_line() for server in servers))

    def write(**further):
        hosts = {f"pi{n}": entry(server) for n, server in enumerate(servers, start=1)} | further
        lines = [f"    {name}: {json.dumps(values)}" for name, values in hosts.items()]
        file = tmp_path / "inventory.yaml"
        file.write_text("\n".join(["all:", "  hosts:", *lines]) + "\n")
        return str(file)

    return write


def entry(server, **changed):
    return server.variables | changed


def test_ping_says_a_line_a_machine_and_a_verdict(inventory, capsys):
    assert run(["ping", "-i", inventory()]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.split()[:3] for line in lines[:3]) == [
        [f"pi{n}", f"127.0.0.{n}", "ok"] for n in (1, 2, 3)
    ]
    assert lines[3] == "3 machines: all answered"


def test_ping_of_machines_that_fail_says_why_and_hides_nobody(inventory, capsys, servers):
    refused = entry(servers[0], ansible_port=free_port("127.0.0.1"))
    file = inventory(
        bad1=refused,
        bad2=entry(servers[0], ansible_user="nobody-of-this-name"),
        here={"ansible_connection": "local"},
    )

    assert run(["ping", "-i", file]) == 3

    lines = capsys.readouterr().out.splitlines()
    told = {line.split()[0]: line for line in lines[:-1]}
    assert set(told) == {"pi1", "pi2", "pi3", "bad1", "bad2", "here"}
    assert "connection refused" in told["bad1"]
    assert "no login as nobody-of-this-name" in told["bad2"]
    assert lines[-1] == "6 machines: 4 answered, 2 failed"


NO_LOGIN = (
    "echo This account is currently not available.; exit 1",
    ("exit status 1", "This account is"),
)
"""What a login shell such as /usr/sbin/nologin says and does, and what is told of it."""


@pytest.mark.parametrize(
    "case",
    [
        ("ping", *NO_LOGIN),
        ("facts", *NO_LOGIN),
        ("ping", "true", ("exit status 0",)),  # as a login shell /bin/true has it
        ("exec", *NO_LOGIN),
        ("exec", "true", ("exit status 0",)),
    ],
    ids=lambda case: f"{case[0]} {case[1].split()[0]}",
)
def test_user_who_may_run_no_commands_is_a_failure(inventory, capsys, tmp_path, known_hosts, case):
    command, does, told = case
    with Sshd(tmp_path / "nologin", extra=f"ForceCommand {does}") as server:
        file = inventory(none=entry(server))
        with known_hosts.open("a") as known:
            known.write(server.known_hosts_line())
        what = ["id"] if command == "exec" else []
        assert run([command, "-i", file, "--json", "--limit", "none", *what]) == 3

    failure = json.loads(capsys.readouterr().out)["machines"][0]["failure"]
    assert failure["kind"] == "authentication"
    assert "no command does" in failure["text"]
    assert all(words in failure["text"] for words in told)


def test_empty_command_is_refused(inventory, capsys):
    assert run(["exec", "-i", inventory(), "--", " "]) == 2

    assert "expected a command behind --" in capsys.readouterr().err


def test_ping_tells_scripts_the_same(inventory, capsys):
    file = inventory(bad={"ansible_host": "no-such-machine.invalid"})

    assert run(["ping", "-i", file, "--json", "--limit", "pi1,bad"]) == 3

    told = json.loads(capsys.readouterr().out)
    assert told["exit_code"] == 3
    good, bad = told["machines"]
    assert (good["machine"], good["ok"], good["failure"]) == ("pi1", True, None)
    assert good["ssh_ms"] > 0 < good["exec_ms"]
    assert (bad["ok"], bad["failure"]["kind"], bad["ssh_ms"]) == (False, "unreachable", None)


def test_frozen_machine_delays_nobody_else(inventory, capsys, home):
    address = "127.0.0.9"
    config = home / ".ssh" / "config"
    config.write_text(f"Host {address}\n  ConnectTimeout 1\n{config.read_text()}")
    with silent_server(address) as port:
        file = inventory(frozen={"ansible_host": address, "ansible_port": port})
        assert run(["ping", "-i", file]) == 3

    lines = capsys.readouterr().out.splitlines()
    told = next(line for line in lines if "frozen" in line)
    assert re.search(r"nothing was said in (1|0\.\d+) s", told)  # what opening has left of 1 s
    assert lines[-1] == "4 machines: 3 answered, 1 failed"


def test_exec_prints_output_under_the_machines_names(inventory, capsys):
    assert run(["exec", "-i", inventory(), "--", "echo one $N; echo two; echo talk >&2"]) == 0

    said = capsys.readouterr()
    assert sorted(said.out.splitlines()) == sorted(
        line for n in (1, 2, 3) for line in (f"pi{n} | one {n}", f"pi{n} | two")
    )
    assert sorted(said.err.splitlines()) == [
        "3 machines: 3 ok",
        *(f"pi{n} | talk" for n in (1, 2, 3)),
    ]


@pytest.mark.parametrize("dashes", [["--"], []])
def test_exec_of_several_words_is_a_program_and_its_arguments(inventory, capsys, dashes):
    words = ["printf", "%s,", "a b", "$HOME", "-l", "--limit"]

    assert run(["exec", "-i", inventory(), "-l", "pi1", *dashes, *words]) == 0

    assert capsys.readouterr().out == "pi1 | a b,$HOME,-l,--limit,\n"


def test_exec_that_fails_on_a_machine_ends_with_1(inventory, capsys):
    assert run(["exec", "-i", inventory(), "test $N = 2 && exit 7; kill -9 $$"]) == 1

    said = capsys.readouterr().err
    assert "pi2 ! exit status 7" in said
    assert "pi1 ! ended by signal 9" in said
    assert "3 machines: 0 ok, 3 exit status not 0" in said


def test_exec_on_a_machine_that_fails_ends_with_3_and_shows_the_others(inventory, capsys, servers):
    file = inventory(bad=entry(servers[0], ansible_port=free_port("127.0.0.1")))

    assert run(["exec", "-i", file, "echo $N; exit $N"]) == 3

    said = capsys.readouterr()
    assert sorted(said.out.splitlines()) == ["pi1 | 1", "pi2 | 2", "pi3 | 3"]
    assert "bad ! 127.0.0.1 port" in said.err
    assert "4 machines: 0 ok, 3 exit status not 0, 1 machine failed" in said.err


def test_exec_tells_scripts_all_of_it(inventory, capsys):
    assert (
        run(["exec", "-i", inventory(), "--json", "-l", "pi2", "echo $N; echo e >&2; exit 4"]) == 1
    )

    told = json.loads(capsys.readouterr().out)
    assert (told["command"], told["exit_code"]) == ("echo $N; echo e >&2; exit 4", 1)
    (machine,) = told["machines"]
    assert (machine["machine"], machine["ok"]) == ("pi2", True)
    assert (machine["exit_status"], machine["stdout"], machine["stderr"]) == (4, "2\n", "e\n")
    assert (machine["cut_bytes"], machine["left_running"]) == (0, False)


def test_exec_shows_output_as_soon_as_its_machine_is_done(inventory):
    command = "test $N = 1 || sleep 60; echo quick"
    with cosmos("exec", "-i", inventory(), command) as process:
        assert process.stdout.readline() == b"pi1 | quick\n"
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 130


def test_exec_beyond_its_time_is_ended_there_too(inventory, capsys, tmp_path):
    command = f"echo $$ > {tmp_path}/$N; sleep 300"

    assert run(["exec", "-i", inventory(), "--timeout", "10", command]) == 3

    assert "did not end in 10 s" in capsys.readouterr().err
    assert all(is_gone(tmp_path / str(n)) for n in (1, 2, 3))


@pytest.mark.parametrize("name", ["pi1", "here"])
def test_exec_does_not_wait_for_what_a_command_leaves_running(inventory, capsys, tmp_path, name):
    """Such as a server in the background: its command has ended, though the output is still open."""
    file = inventory(here={"ansible_connection": "local"})
    command = f"sleep 300 & echo $! > {tmp_path}/left; echo begun; exit 4"

    status = run(["exec", "-i", file, "--json", "-l", name, "--timeout", "120", command])

    (machine,) = json.loads(capsys.readouterr().out)["machines"]
    os.kill(int((tmp_path / "left").read_text()), signal.SIGKILL)
    assert (status, machine["exit_status"], machine["stdout"]) == (1, 4, "begun\n")
    assert machine["left_running"] is True


def test_exec_says_that_something_was_left_running(inventory, capsys, tmp_path):
    assert run(["exec", "-i", inventory(), "-l", "pi1", f"sleep 300 & echo $! > {tmp_path}/1"]) == 0

    os.kill(int((tmp_path / "1").read_text()), signal.SIGKILL)
    assert "pi1 ! what it left running there holds its output" in capsys.readouterr().err


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_interrupted_exec_leaves_nothing_running_there(inventory, tmp_path, how):
    """Also when it is killed: whatever happens here, the machine sees its connection end."""
    with cosmos("exec", "-i", inventory(), f"echo $$ > {tmp_path}/$N; sleep 300; true") as process:
        until_s = time.monotonic() + WAIT_S
        while sum(map(is_written, tmp_path.glob("[123]"))) < 3 and time.monotonic() < until_s:
            time.sleep(0.02)
        process.send_signal(how)
        status = process.wait(WAIT_S)
        talk = process.stderr.read()

    assert status == (130 if how is signal.SIGINT else -signal.SIGKILL)
    assert all(is_gone(tmp_path / str(n)) for n in (1, 2, 3))
    if how is signal.SIGINT:
        assert b"interrupted" in talk
        assert b"Traceback" not in talk


def test_interrupt_while_a_machine_does_not_answer_is_heard_at_once(inventory):
    with silent_server() as port:
        file = inventory(frozen={"ansible_host": "127.0.0.1", "ansible_port": port})
        with cosmos("exec", "-i", file, "-l", "pi1,frozen", "echo done") as process:
            assert process.stdout.readline() == b"pi1    | done\n"
            start_s = time.monotonic()
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 130
            assert time.monotonic() - start_s < WAIT_S / 2


@pytest.mark.parametrize("arguments", [["ping"], ["up"], ["packages", "upgrade"]])
def test_interrupted_command_says_so_to_people_and_to_scripts(inventory, arguments):
    with silent_server() as port, socket.create_server(("127.0.0.1", 0)) as noticing:
        file = inventory(
            frozen={"ansible_host": "127.0.0.1", "ansible_port": port},
            asked={"ansible_host": "127.0.0.1", "ansible_port": noticing.getsockname()[1]},
        )
        with cosmos(*arguments, "-i", file, "-l", "frozen,asked", "--json") as process:
            noticing.settimeout(WAIT_S)
            noticing.accept()[0].close()  # the command is under way
            process.send_signal(signal.SIGINT)
            said, talk = process.communicate(timeout=WAIT_S)

    assert process.returncode == 130
    assert json.loads(said)["error"]["kind"] == "interrupted"
    *before, last = talk.splitlines()
    assert last == b"interrupted"
    # Of one that may take minutes, how far it came, too.
    assert any(b" of 2 machines done" in line for line in before) == (arguments == ["up"])


@pytest.mark.parametrize(
    ("host", "told"),
    [
        ("pi9", "--host pi9: no machine is named pi9, did you mean pi2?"),
        ("pi3", "--host pi3: pi3 is in the inventory, but --limit leaves it out"),
        ("all", "--host all: all is a group; name one machine"),
    ],
)
def test_host_that_is_no_machine_of_the_fleet_is_bad_input(inventory, capsys, host, told):
    assert run(["up", "-i", inventory(), "-l", "pi1,pi2", "--host", host]) == 2

    assert told in capsys.readouterr().err


def test_exec_as_root_where_the_inventory_forbids_it_is_refused(inventory, capsys, servers):
    file = inventory(tame=entry(servers[0], ansible_become=False))

    assert run(["exec", "-i", file, "-l", "tame", "--sudo", "id"]) == 3

    assert "ansible_become: false" in capsys.readouterr().err


def test_faulty_ssh_configuration_is_bad_input_and_said_once(inventory, capsys, home):
    (home / ".ssh" / "config").write_text("Match phase moon\n")

    assert run(["ping", "-i", inventory()]) == 2

    assert capsys.readouterr().err.count("criterion of Match is not understood") == 1


def test_unknown_host_keys_are_accepted_when_that_is_wanted(
    inventory, capsys, known_hosts, servers
):
    file = inventory()
    known_hosts.unlink()

    assert run(["ping", "-i", file]) == 3
    assert capsys.readouterr().out.count("--accept-new-host-keys") == 3
    assert run(["ping", "-i", file, "--accept-new-host-keys"]) == 0
    assert sorted(known_hosts.read_text().splitlines(keepends=True)) == sorted(
        server.known_hosts_line() for server in servers
    )


@contextlib.contextmanager
def cosmos(*arguments):
    process = subprocess.Popen(
        [sys.executable, "-m", "cosmos_cli.start", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


def is_written(file: Path) -> bool:
    """Whether a command there has written its number: the file is there a moment before."""
    return bool(file.read_text())


def is_gone(file: Path) -> bool:
    """Whether the process group of which a command there wrote the number ends within a bound."""
    until_s = time.monotonic() + WAIT_S
    try:
        group = os.getpgid(int(file.read_text()))
        while time.monotonic() < until_s:
            os.killpg(group, 0)
            time.sleep(0.05)
    except ProcessLookupError:
        return True
    return False
