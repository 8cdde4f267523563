"""A head start connects where the command will connect, and nowhere else; what fails there fails as ever."""

from __future__ import annotations

import contextlib
import errno
import socket
import sys
import threading

import pytest

from cosmos_cli.app import load_command
from cosmos_cli.fleet import headstart
from cosmos_cli.fleet.connect import ConnectOptions, connect
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.fleet import fleet_of
from cosmos_cli.fleet.wire import connect_tcp


@pytest.fixture(autouse=True)
def nothing_is_left():
    before_s = sys.getswitchinterval()
    yield
    headstart.close()
    sys.setswitchinterval(before_s)


@pytest.fixture
def server():
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(5)
        yield listening


@pytest.fixture
def inventory(tmp_path, monkeypatch, server):
    """Return an inventory of one machine, read before."""
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("COSMOS_INVENTORY", raising=False)
    config = tmp_path / "ssh_config"
    config.write_text("")
    monkeypatch.setenv("COSMOS_SSH_CONFIG", str(config))
    path = tmp_path / "inventory.yaml"
    port = server.getsockname()[1]
    path.write_text(f"all: {{hosts: {{pi1: {{ansible_host: 127.0.0.1, ansible_port: {port}}}}}}}\n")
    fleet_of(path)
    return path


def begun():
    return list(headstart._ways)


def test_known_machine_is_spoken_to_before_the_command_asks(inventory, server):
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    accepted, _ = server.accept()

    with accepted:
        accepted.settimeout(5)
        assert accepted.recv(8) == b"SSH-2.0-"
        wire = connect_tcp(*server.getsockname(), timeout_s=5)

        assert wire.transport is not None
        assert wire.transport.wire is wire
        assert wire.peer_address == "127.0.0.1"
        assert begun() == []
        wire.transport.close()
        wire.close()


def test_machine_that_was_not_connected_in_time_is_left_to_the_command(
    inventory, server, monkeypatch
):
    monkeypatch.setattr(headstart, "_speak", lambda: None)
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    accepted, _ = server.accept()

    with accepted:
        wire = connect_tcp(*server.getsockname(), timeout_s=5)
        wire.send(b"hello")

        assert accepted.recv(5) == b"hello"
        assert wire.transport is None
        wire.close()


def test_what_fails_while_it_is_spoken_to_fails_where_it_is_wanted(inventory, server):
    def answer():
        for _ in range(2):  # the second one is asked only if the first has failed by then
            with contextlib.suppress(OSError), server.accept()[0] as accepted:
                accepted.sendall(b"HTTP/1.0 400 no such thing\r\n" * 200)

    threading.Thread(target=answer, daemon=True).start()
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    (target,) = fleet_of(inventory).targets

    with pytest.raises(MachineFailure) as caught:
        connect(target, ConnectOptions(timeout_s=3))

    assert caught.value.kind is FailureKind.LOST
    assert "Indecipherable protocol version" in str(caught.value)


def test_way_that_the_machine_has_closed_meanwhile_is_not_taken(inventory, server):
    """An SSH server closes a connection on which nobody logs in."""
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    (way,) = headstart._ways.values()
    server.accept()[0].close()
    way.transport.join(5)

    wire = connect_tcp(*server.getsockname(), timeout_s=5)
    accepted, _ = server.accept()

    with accepted:
        wire.send(b"hello")
        assert accepted.recv(5) == b"hello"
        assert wire.transport is None
        wire.close()


def test_machine_that_says_nothing_more_ends_at_the_deadline(inventory, server):
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    accepted, _ = server.accept()
    (target,) = fleet_of(inventory).targets

    with accepted, pytest.raises(MachineFailure) as caught:
        accepted.sendall(b"SSH-2.0-silent\r\n")
        connect(target, ConnectOptions(timeout_s=1.0))

    assert caught.value.kind is FailureKind.FROZEN


@pytest.mark.parametrize(
    "arguments",
    [
        ["exec", "--help", "-i", "{}"],
        ["exec", "-i", "{}", "--limit", "pi1"],  # another selection, not seen before
        ["exec", "--", "-i", "{}"],
        ["exec", "-i"],
        ["exec", "true", "-i", "{}"],  # what follows is the command's
        ["exec", "-i", "{}", "-i", "other.yaml", "--", "true"],  # the last one counts
        ["ping", "-i", "{}", "--new-option"],  # it may mean anything
        ["ping", "--inventory=", "{}"],
        ["ping", "-i", "{}", "--forks", "0"],
        ["collect", "-i", "{}"],
        [],
    ],
)
def test_nothing_is_begun_for_other_command_lines(inventory, arguments):
    headstart.begin([word.format(inventory) for word in arguments])

    assert begun() == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["ping", "-i", "other.yaml", "-i", "{}"],
        ["ping", "-i{}", "-q", "--json", "--forks=2"],
        ["up", "scenario.yaml", "--check", "-i", "{}"],
        ["exec", "--timeout", "3", "-i", "{}", "ls", "-i", "other.yaml"],
    ],
)
def test_options_are_read_as_the_command_reads_them(inventory, monkeypatch, arguments):
    monkeypatch.setenv("COSMOS_INVENTORY", "no-such.yaml")

    headstart.begin([word.format(inventory) for word in arguments])

    assert len(begun()) == 1


@pytest.mark.parametrize("verb", headstart.VERBS)
def test_every_option_of_a_quick_command_is_known(verb):
    for parameter in load_command(verb).params:
        if parameter.param_type_name == "option" and parameter.name != "help":
            known = headstart.FLAGS if parameter.is_flag else headstart.VALUED
            names = {headstart.SHORT.get(name, name) for name in parameter.opts}

            assert names <= set(known)
            assert parameter.envvar == headstart.VARIABLES.get(*names) or parameter.is_flag


def test_no_more_ways_are_begun_than_machines_are_worked_on_at_once(
    tmp_path, inventory, monkeypatch
):
    port = inventory.read_text().split("ansible_port: ")[1].split("}")[0]
    inventory.write_text(
        f"all: {{vars: {{ansible_port: {port}}}, hosts: {{"
        + ", ".join(f"pi{n}: {{ansible_host: 127.0.0.{n}}}" for n in range(1, 6))
        + "}}\n"
    )
    fleet_of(inventory)
    monkeypatch.setenv("COSMOS_FORKS", "2")

    headstart.begin(["ping", "-i", str(inventory)])

    assert len(begun()) == 2


def test_nothing_is_begun_for_an_inventory_that_was_not_read_as_it_is(inventory):
    inventory.write_text(inventory.read_text().replace("pi1", "pi2"))

    headstart.begin(["ping", f"--inventory={inventory}"])

    assert begun() == []


def test_inventory_of_the_environment_counts(inventory, monkeypatch):
    monkeypatch.setenv("COSMOS_INVENTORY", str(inventory))

    headstart.begin(["up"])

    assert len(begun()) == 1


def test_machines_behind_another_are_left_to_the_command(inventory, tmp_path):
    (tmp_path / "ssh_config").write_text("Host 127.0.0.1\n    ProxyJump other\n")

    headstart.begin(["ping", "-i", str(inventory)])

    assert begun() == []


def test_refused_connection_is_told_where_the_way_is_wanted(inventory, server):
    host, port = server.getsockname()
    server.close()
    headstart.begin(["ping", "-i", str(inventory)])

    with pytest.raises(OSError) as caught:
        connect_tcp(host, port, timeout_s=5)

    assert caught.value.errno == errno.ECONNREFUSED


def test_what_nobody_took_is_closed(inventory, server):
    headstart.begin(["ping", "-i", str(inventory)])
    accepted, _ = server.accept()

    headstart.close()

    with accepted:
        accepted.settimeout(5)
        while accepted.recv(4096):
            pass
