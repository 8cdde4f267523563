"""UDP between a machine and the operator is tried both ways, and a silence is put into words."""

import _socket
import socket
import threading
import time

import pytest

from cosmos_cli.onboard import runtime_check
from cosmos_cli.onboard.request_loop import HelperRefusal
from cosmos_cli.provision import udp_echo as module
from cosmos_cli.provision.udp_echo import Echo

PATIENCE_S = 60.0


@pytest.fixture
def echo():
    with Echo("127.0.0.1") as echo:
        yield echo


@pytest.fixture
def link():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.settimeout(PATIENCE_S)
        yield link


def test_round_trip_is_measured_and_counted(echo, monkeypatch):
    monkeypatch.setattr(runtime_check, "ECHO_WAITS_S", (PATIENCE_S,))
    question = echo.question("127.0.0.1")

    assert 0 < runtime_check.round_trip_ms(question) < PATIENCE_S * 1000
    assert echo.heard(question) == 1


def test_many_machines_share_one_echo(echo):
    questions = [echo.question("127.0.0.1") for _ in range(20)]
    found = []
    threads = [
        threading.Thread(target=lambda q=q: found.append(runtime_check.round_trip_ms(q)))
        for q in questions
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)

    assert len(found) == 20
    assert all(echo.heard(question) for question in questions)


def test_strangers_get_no_answer(echo, link):
    question = echo.question("127.0.0.1")
    nonce = bytes.fromhex(question["nonce_hex"])
    for packet in (b"", b"x" * 16, b"y" * 1000, nonce[:15], nonce + b"z" * 1000):
        link.sendto(packet, ("127.0.0.1", echo.port))

    link.settimeout(0.2)
    with pytest.raises(TimeoutError):
        link.recv(100)
    assert echo.heard(question) == 0


def test_answer_has_no_more_bytes_than_the_question(echo, link):
    nonce = bytes.fromhex(echo.question("127.0.0.1")["nonce_hex"])
    link.sendto(nonce + b"\x02", ("127.0.0.1", echo.port))

    assert link.recv(1000) == nonce + b"\x02"


def test_lost_datagrams_are_sent_again(monkeypatch, echo):
    """The first two go nowhere, as on a lossy link."""
    monkeypatch.setattr(runtime_check, "ECHO_WAITS_S", (0.1, 0.1, PATIENCE_S))
    question = echo.question("127.0.0.1")
    sent = []

    class Lossy(_socket.socket):
        def sendto(self, packet, where):
            sent.append(packet)
            return super().sendto(packet, where) if len(sent) > 2 else len(packet)

    monkeypatch.setattr(_socket, "socket", Lossy)

    assert runtime_check.round_trip_ms(question) > 0
    assert len(sent) == 3
    assert echo.heard(question) == 1


def test_who_answers_has_seconds_to_come_to_it(monkeypatch, link):
    """As on an operator's computer that packs wheels for many boards meanwhile."""
    link.bind(("127.0.0.1", 0))
    waits_s = []

    def wait(_link, _nonce, until_s):
        waits_s.append(until_s - time.monotonic())
        return len(waits_s) == 3

    monkeypatch.setattr(runtime_check, "_comes_back", wait)
    question = {"address": "127.0.0.1", "port": link.getsockname()[1], "nonce_hex": "00" * 16}

    assert runtime_check.round_trip_ms(question) >= 0
    assert waits_s[0] < 0.5  # a datagram that is lost costs little
    assert waits_s[2] > 2.0


def test_silence_names_the_address_and_what_to_do(monkeypatch, link):
    monkeypatch.setattr(runtime_check, "ECHO_WAITS_S", (0.02,) * 3)
    link.bind(("127.0.0.1", 0))
    port = link.getsockname()[1]

    with pytest.raises(HelperRefusal) as caught:
        runtime_check.round_trip_ms({"address": "127.0.0.1", "port": port, "nonce_hex": "00" * 16})

    assert caught.value.text == f"no UDP from here to 127.0.0.1:{port}"
    assert "is a firewall closing it?" in caught.value.advice


def test_address_that_is_none_is_told(monkeypatch):
    monkeypatch.setattr(runtime_check, "ECHO_WAITS_S", (0.02,) * 3)

    with pytest.raises(HelperRefusal, match=r"no UDP from here to no\.such\.host\.invalid:9 \("):
        runtime_check.round_trip_ms(
            {"address": "no.such.host.invalid", "port": 9, "nonce_hex": "00" * 16}
        )


def test_foreign_answers_are_not_taken_for_ours(monkeypatch):
    """Somebody else answers on that port."""
    monkeypatch.setattr(runtime_check, "ECHO_WAITS_S", (0.05,) * 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        other.settimeout(PATIENCE_S)

        def answer():
            for _ in range(3):
                _, sender = other.recvfrom(100)
                other.sendto(b"z" * 17, sender)

        thread = threading.Thread(target=answer)
        thread.start()
        question = {"address": "127.0.0.1", "port": other.getsockname()[1], "nonce_hex": "00" * 16}
        with pytest.raises(HelperRefusal, match="no UDP"):
            runtime_check.round_trip_ms(question)
        thread.join(PATIENCE_S)


def test_questions_are_bounded(monkeypatch, echo):
    monkeypatch.setattr(module, "NONCES_MAX", 3)
    questions = [echo.question("127.0.0.1") for _ in range(5)]

    assert len(echo._nonces) == 3
    assert runtime_check.round_trip_ms(questions[-1]) > 0


def test_closing_twice_is_harmless():
    echo = Echo("127.0.0.1")
    echo.close()
    echo.close()

    assert not echo._thread.is_alive()


@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_machines_of_both_families_are_heard(address):
    """Whichever way a board is reached, its datagrams come the same way."""
    with Echo() as echo:
        if ":" in address and echo.family != socket.AF_INET6:
            pytest.skip("no IPv6 here")

        assert runtime_check.round_trip_ms(echo.question(address)) > 0
