"""What failed on some machines can be repeated for them alone: a file that --limit and Ansible read."""

from __future__ import annotations

import json
import shlex
import stat

import pytest
from ssh_harness import needs_sshd
from sshd import Sshd

from cosmos_cli.app import run
from cosmos_cli.fleet import retry_file
from cosmos_cli.ui.invocation import Invocation

VALUED = frozenset({"--inventory", "-i", "--limit", "-l", "--timeout", "--forks"})


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    needs_sshd()
    with Sshd(tmp_path_factory.mktemp("retried")) as one:
        yield one


@pytest.fixture
def inventory(server, tmp_path, known_hosts, monkeypatch):
    """Two names of one machine, and one that nobody answers to."""
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    known_hosts.write_text(server.known_hosts_line())
    there = server.variables
    hosts = {"pi1": there, "bad": {"ansible_host": "no-such-machine.invalid"}, "pi2": there}
    path = tmp_path / "my tower.yaml"
    path.write_text(json.dumps({"all": {"hosts": hosts}}))
    return str(path)


def files(tmp_path):
    folder = tmp_path / "state" / "failed"
    return sorted(folder.iterdir()) if folder.exists() else []


@pytest.mark.process
@pytest.mark.parametrize(
    ("verb", "words"),
    [
        ("ping", []),
        ("exec", ["--", "true"]),
        ("doctor", []),
        ("wipe", ["--yes"]),
        pytest.param("up", [], marks=pytest.mark.nightly),
        ("ps", []),
    ],
)
def test_machines_that_failed_are_kept_and_the_command_is_named(
    verb, words, inventory, tmp_path, capsys
):
    code = run([verb, "-i", inventory, "--limit", "pi1,bad", *words])

    error = capsys.readouterr().err
    (kept,) = files(tmp_path)
    assert code == 3
    assert kept.read_text() == "bad\n"
    again = ["cosmos", verb, "--limit", f"@{kept}", "-i", inventory, *words]
    assert "1 machine of 2 failed (bad); again for it alone:" in error
    assert shlex.join(again) in error
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert stat.S_IMODE(kept.parent.stat().st_mode) == 0o700


@pytest.mark.process
def test_end_of_all_runs_is_repeated_for_nobody(inventory, tmp_path, capsys):
    """Runs that begin meanwhile would end, too."""
    assert run(["down", "-i", inventory, "--all", "--json"]) == 3

    assert json.loads(capsys.readouterr().out)["retry"] is None
    assert files(tmp_path) == []


def test_command_that_is_named_works_on_those_machines(inventory, tmp_path, capsys):
    assert run(["exec", "-i", inventory, "--json", "--", "test", "!", "-e", "x"]) == 3
    answer = json.loads(capsys.readouterr().out)
    command = shlex.split(answer["retry"]["command"])
    assert answer["retry"]["file"] == str(files(tmp_path)[0])

    assert run(command[1:]) == 3
    again = json.loads(capsys.readouterr().out)

    assert [machine["machine"] for machine in again["machines"]] == ["bad"]
    assert again["retry"] is None  # all of them failed: the command stays as it is


def test_command_that_fails_on_a_machine_counts_as_the_machine_does(
    inventory, tmp_path, capsys, server
):
    (tmp_path / "once").write_text("")
    line = f"rm {tmp_path / 'once'}"

    assert run(["exec", "-i", inventory, "-l", "pi1:pi2", "--forks", "1", line]) == 1

    assert files(tmp_path)[0].read_text() == "pi2\n"


def test_nothing_is_kept_where_nothing_failed(inventory, tmp_path, capsys):
    assert run(["ping", "-i", inventory, "--limit", "pi*", "--json"]) == 0

    assert json.loads(capsys.readouterr().out)["retry"] is None
    assert files(tmp_path) == []


def test_file_that_cannot_be_written_is_no_failure(inventory, tmp_path, capsys):
    (tmp_path / "state").write_text("in the way")

    assert run(["ping", "-i", inventory]) == 3
    assert "again for" not in capsys.readouterr().err


def test_only_the_newest_are_kept(inventory, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(retry_file, "KEPT_MAX", 1)
    run(["exec", "-i", inventory, "true"])
    run(["ping", "-i", inventory])

    assert [path.name.split("-")[0] for path in files(tmp_path)] == ["ping"]


@pytest.mark.parametrize(
    ("words", "rest"),
    [
        (["-i", "a", "-l", "x"], ["-i", "a"]),
        (["-lx", "-ia", "--json"], ["-ia", "--json"]),
        (["--limit=x", "s.yaml"], ["s.yaml"]),
        (["--timeout", "-l", "-i", "a"], ["--timeout", "-l", "-i", "a"]),
        (["--", "-l", "x"], ["--", "-l", "x"]),
        (["-ql", "x", "-i", "a"], ["-q", "-i", "a"]),
        (["-vvqlx", "-i", "a"], ["-vvq", "-i", "a"]),
        (["-qi", "-l", "-l", "x"], ["-qi", "-l"]),
        (["-il", "-q"], ["-il", "-q"]),
    ],
)
def test_limit_of_a_command_line_is_replaced(words, rest):
    invocation = Invocation(verb="up", words=tuple(words), valued=VALUED)

    assert shlex.split(invocation.with_limit("@f")) == ["cosmos", "up", "--limit", "@f", *rest]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["-i", "a b", "-i", "c", "s.yaml"], " -i 'a b' -i c"),
        (["--inventory=a", "-l", "x:!y"], " -i a --limit 'x:!y'"),
        (["-qia", "--timeout", "-i", "-lx"], " -i a --limit x"),
        (["-qi", "a", "--", "-i", "b"], " -i a"),
        (["s.yaml"], " -i INVENTORY"),
    ],
)
def test_machines_of_a_command_line_are_told_to_another(words, told, monkeypatch):
    monkeypatch.delenv("COSMOS_INVENTORY", raising=False)

    invocation = Invocation(verb="up", words=tuple(words), valued=VALUED)

    assert invocation.machine_options == told
    assert invocation.inventory_options == told.split(" --limit")[0]


def test_inventory_that_the_environment_names_is_not_told(monkeypatch):
    monkeypatch.setenv("COSMOS_INVENTORY", "a.yaml")

    invocation = Invocation(verb="run", words=("s.yaml",), valued=VALUED)

    assert (invocation.machine_options, invocation.inventory_options) == ("", "")


def test_limit_behind_bundled_options_is_replaced_before_words_for_machines():
    words = ("-qi", "a", "-l", "x", "ls", "-l", "x")
    invocation = Invocation(verb="exec", words=words, valued=VALUED, has_tail=True)

    assert shlex.split(invocation.with_limit("@f"))[4:] == ["-qi", "a", "ls", "-l", "x"]


def test_words_for_machines_stay_as_they_are():
    words = ("-i", "a", "ls", "-l", "x")
    invocation = Invocation(verb="exec", words=words, valued=VALUED, has_tail=True)

    assert shlex.split(invocation.with_limit("@f"))[4:] == list(words)


def test_folder_with_a_space_is_no_obstacle(inventory, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "my state"))
    run(["ping", "-i", inventory, "--json"])
    command = json.loads(capsys.readouterr().out)["retry"]["command"]

    run(shlex.split(command)[1:])

    assert [m["machine"] for m in json.loads(capsys.readouterr().out)["machines"]] == ["bad"]
