"""How to log in at a machine: the inventory first, then the ssh configuration, then ssh's defaults."""

import getpass
import os
from pathlib import Path

import pytest
from ssh_harness import write_configuration

from cosmos_cli.errors import InputError
from cosmos_cli.fleet.ssh.known_hosts import HostKey, KnownHosts
from cosmos_cli.fleet.ssh.settings import settings_of
from cosmos_cli.fleet.target import Target


@pytest.fixture
def configure(home):
    return lambda *lines: write_configuration(home / ".ssh" / "config", *lines)


def settings(**values):
    return settings_of(Target(**({"name": "pi", "address": "10.0.0.7"} | values)))


@pytest.mark.parametrize("error", [KeyError, OSError])  # before and from Python 3.13
def test_a_user_without_a_name_logs_in_by_that_of_the_inventory(configure, monkeypatch, error):
    def fail():
        raise error("getpwuid(): uid not found: 12345")

    monkeypatch.setattr(getpass, "getuser", fail)
    configure(f"Match localuser {os.getuid()}", "  Port 3")

    assert (settings(user="lab").user, settings().user) == ("lab", str(os.getuid()))
    assert settings().port == 3


def test_defaults_are_those_of_ssh(home, monkeypatch):
    monkeypatch.delenv("COSMOS_SSH_CONFIG")
    (home / ".ssh" / "config").unlink()

    found = settings()

    assert (found.host, found.port, found.user) == ("10.0.0.7", 22, getpass.getuser())
    assert found.names == ("10.0.0.7",)
    assert found.key_files[0] == home / ".ssh" / "id_ed25519"
    assert not found.are_keys_named
    assert found.known_hosts[0] == home / ".ssh" / "known_hosts"
    assert Path("/etc/ssh/ssh_known_hosts") in found.known_hosts
    assert not found.accepts_new_host_keys
    assert (found.jumps, found.proxy_command, found.agent_socket) == ((), None, None)


def test_configuration_beside_the_keys_is_read_when_none_is_named(home, monkeypatch):
    monkeypatch.delenv("COSMOS_SSH_CONFIG")
    (home / ".ssh" / "config").write_text("User pi\n")

    assert settings().user == "pi"


def test_inventory_wins(configure):
    configure("Host *", "  User other", "  Port 1", "  IdentityFile /other")

    found = settings(user="pi", port=2222, key_file="/key")

    assert (found.user, found.port, found.key_files) == ("pi", 2222, (Path("/key"),))
    assert found.identities_only


def test_named_configuration_that_is_missing_is_told(monkeypatch, tmp_path):
    monkeypatch.setenv("COSMOS_SSH_CONFIG", str(tmp_path / "none"))

    with pytest.raises(InputError, match="COSMOS_SSH_CONFIG: .*none: no such file"):
        settings()


def test_alias_becomes_a_name_and_its_port_part_of_the_known_name(configure):
    configure("Host pi", "  HostName pi.lab", "  Port 2222")

    found = settings(address="pi")

    assert (found.host, found.port) == ("pi.lab", 2222)
    assert found.names == ("[pi.lab]:2222", "pi.lab")


def test_host_key_alias_is_the_known_name(configure):
    configure("HostKeyAlias board")

    assert settings(port=2222).names == ("board",)


@pytest.mark.parametrize(
    ("word", "accepts"),
    [("accept-new", True), ("no", True), ("off", True), ("ask", False), ("yes", False)],
)
def test_what_strict_host_key_checking_means(configure, word, accepts):
    configure(f"StrictHostKeyChecking {word}")

    assert settings().accepts_new_host_keys is accepts


def test_jumps_are_read_with_user_and_port(configure):
    configure("ProxyJump gate,pi@inner:2222,ssh://[fd00::1]:23")

    assert [(j.address, j.user, j.port) for j in settings().jumps] == [
        ("gate", None, None),
        ("inner", "pi", 2222),
        ("fd00::1", None, 23),
    ]


def test_jump_that_is_none_and_command_that_is_none_are_no_proxies(configure):
    configure("ProxyJump none", "ProxyCommand none")

    assert (settings().jumps, settings().proxy_command) == ((), None)


@pytest.mark.parametrize(
    ("lines", "jumps", "command"),
    [
        (["ProxyCommand none", "ProxyJump gate"], [], None),
        (["ProxyCommand nc gate", "ProxyJump gate"], [], "nc gate"),
        (["ProxyJump gate", "ProxyCommand nc gate"], ["gate"], None),
        (["ProxyJump none", "ProxyCommand nc gate"], [], "nc gate"),
    ],
)  # as `ssh -G` has it
def test_of_jump_and_command_the_first_counts(configure, lines, jumps, command):
    configure(*lines)

    assert [jump.address for jump in settings().jumps] == jumps
    assert settings().proxy_command == command


def test_jump_that_is_not_understood_is_told(configure):
    configure("ProxyJump pi@")

    with pytest.raises(InputError, match="ProxyJump of pi: expected"):
        settings()


def test_agent_may_be_another_or_none(configure, monkeypatch):
    monkeypatch.setenv("SSH_AUTH_SOCK", "/own")
    monkeypatch.setenv("OTHER", "/other")

    assert settings().agent_socket == "/own"
    configure("IdentityAgent none")
    assert settings_again().agent_socket is None
    configure("IdentityAgent $OTHER")
    assert settings_again().agent_socket == "/other"


def settings_again():
    """Read the configuration once more, which a process does not: it runs one command."""
    from cosmos_cli.fleet.ssh import settings as ssh_settings

    ssh_settings._read.cache_clear()
    return settings()


def test_several_known_hosts_files_are_read_in_their_order(home):
    (home / ".ssh" / "config").write_text(
        'UserKnownHostsFile ~/a "/with space/b"\nGlobalKnownHostsFile none\n'
    )

    assert settings().known_hosts == (home / "a", Path("/with space/b"))


def test_own_known_hosts_that_are_none_leave_everybodys_as_it_is(home, tmp_path):
    everybodys = tmp_path / "ssh_known_hosts"
    (home / ".ssh" / "config").write_text(
        f"UserKnownHostsFile none\nGlobalKnownHostsFile {everybodys}\n"
    )
    known = KnownHosts(settings().known_hosts)

    known.record("pi", HostKey(kind="ssh-ed25519", blob=b"a"))

    assert everybodys in settings().known_hosts
    assert not everybodys.exists()


def test_home_of_nobody_leads_nowhere(configure):
    configure("IdentityFile ~no-such-user/key")

    assert settings().key_files == (Path("~no-such-user/key"),)


@pytest.mark.parametrize(
    ("written", "seconds"),
    [
        ("3", 3),
        ("5S", 5),
        ("1m30", 90),
        ("1h2m3s", 3723),
        ("none", None),
        ("0", None),
        ("99999w", 65_535),
    ],
)
def test_connect_timeout_is_a_time_as_ssh_writes_it(configure, written, seconds):
    configure(f"ConnectTimeout {written}")

    assert settings().connect_timeout_s == seconds


def test_connect_timeout_that_is_none_leaves_it_to_what_stands_below(configure):
    configure("ConnectTimeout none", "ConnectTimeout 7")

    assert settings().connect_timeout_s == 7


def test_identity_file_that_is_none_offers_no_usual_key(configure, monkeypatch):
    monkeypatch.setenv("SSH_AUTH_SOCK", "/agent")
    configure("IdentityFile none")

    found = settings()

    assert found.key_files == ()
    assert (found.identities_only, found.agent_socket) == (False, "/agent")  # the agent's count


@pytest.mark.timeout(60)
@pytest.mark.parametrize("written", ["soon", "1mm", "10x", "-1", "1.5", "1" * 200 + "x", "m"])
def test_connect_timeout_that_is_no_time_is_refused(configure, written):
    configure(f"ConnectTimeout {written}")

    with pytest.raises(InputError, match=f"ConnectTimeout: expected a time .*got '{written}'"):
        settings()
