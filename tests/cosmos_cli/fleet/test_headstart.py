"""A head start connects where the command will connect, and nowhere else; what fails there fails as ever."""

from __future__ import annotations

import errno
import socket

import pytest

from cosmos_cli.fleet import headstart
from cosmos_cli.fleet.fleet import fleet_of
from cosmos_cli.fleet.wire import connect_tcp


@pytest.fixture(autouse=True)
def nothing_is_left():
    yield
    headstart.close()


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


def test_known_machine_is_connected_to_before_the_command_asks(inventory, server):
    headstart.begin(["exec", "-i", str(inventory), "--", "true"])
    accepted, _ = server.accept()

    with accepted:
        wire = connect_tcp(*server.getsockname(), timeout_s=5)
        wire.send(b"hello")

        assert accepted.recv(5) == b"hello"
        assert wire.peer_address == "127.0.0.1"
        assert begun() == []
        wire.close()


@pytest.mark.parametrize(
    "arguments",
    [
        ["exec", "--help", "-i", "{}"],
        ["exec", "-i", "{}", "--limit", "pi1"],  # another selection, not seen before
        ["exec", "--", "-i", "{}"],
        ["exec", "-i"],
        ["collect", "-i", "{}"],
        [],
    ],
)
def test_nothing_is_begun_for_other_command_lines(inventory, arguments):
    headstart.begin([word.format(inventory) for word in arguments])

    assert begun() == []


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
        assert accepted.recv(1) == b""
