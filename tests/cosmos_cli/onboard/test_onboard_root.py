"""Who may not become root, and where sudo is slow or missing, is told apart."""

import io

import pytest

from cosmos_cli.fleet.helper import Helper
from cosmos_cli.onboard import facts, request_loop
from cosmos_cli.onboard.request_loop import HelperRefusal, Rooted, VerbRequest

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("script", "kind", "text"),
    [
        ("exec sleep 2", "timeout", "sudo -n true has not ended in 0.2 s"),
        ('[ "$2" = true ] || exec sleep 2', "timeout", "sudo -n has started nothing in 0.2 s"),
        ("echo sudo: a password is required >&2; exit 1", "no_sudo", "a password is required"),
        (None, "no_sudo", "cannot become root without a password: there is no sudo"),
    ],
)
def test_reason_for_no_root_is_told(tmp_path, monkeypatch, script, kind, text):
    monkeypatch.setattr(request_loop, "SUDO_TIMEOUT_S", 0.2 if kind == "timeout" else 20.0)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin" if script else str(tmp_path))
    if script:
        (tmp_path / "sudo").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "sudo").chmod(0o755)

    with pytest.raises(HelperRefusal) as caught:
        Rooted([], b"").relay({"verb": "lock"}, b"", io.BytesIO())

    assert caught.value.kind == kind
    assert text in caught.value.text
    assert ("name server" in caught.value.advice) == (kind == "timeout")


@pytest.mark.parametrize("is_streamed", [False, True])
def test_first_answer_of_root_waits_for_sudo_and_later_ones_do_not(is_streamed):
    """A machine tells itself that its sudo is slow; who waits for less long learns nothing."""

    class Played(Helper):
        def __init__(self):
            self.greeting = {"uid": 1000}
            self.waits = []
            self._is_root_asked = False
            self.machine = "pi01"

        def _ask(self, *_, **__):
            pass

        def _read_answer(self, expected, *, timeout_s):
            self.waits.append(timeout_s)
            is_piece = is_streamed and len(self.waits) % 2 == 1
            return {"ok": True, "value": None, "piece": is_piece}, b""

    helper = Played()
    for as_root in (False, True, True):
        if is_streamed:
            list(helper.pieces("living", as_root=as_root, timeout_s=20.0))
        else:
            helper.call("living", as_root=as_root, timeout_s=20.0)

    long_s = 20.0 + 2 * request_loop.SUDO_TIMEOUT_S
    each = 2 if is_streamed else 1
    assert [wait > long_s for wait in helper.waits] == [index == each for index in range(3 * each)]


@pytest.mark.parametrize(
    ("script", "can", "said"),
    [
        ("exit 0", True, None),
        (
            "echo beware >&2; echo sudo: you must have a tty >&2; exit 1",
            False,
            "sudo: you must have a tty",
        ),
        ("sleep 5 >&2 & exit 1", False, ""),
        ("exec sleep 60", False, "sudo has not ended in 0.2 s"),
        (None, False, "there is no sudo"),
    ],
)
def test_facts_tell_what_sudo_says_of_who_may_not(tmp_path, monkeypatch, script, can, said):
    monkeypatch.setattr(facts, "SUDO_TIMEOUT_S", 0.2 if script == "exec sleep 60" else 20.0)
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin" if script else str(tmp_path))
    if script:
        (tmp_path / "sudo").write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / "sudo").chmod(0o755)

    told = facts.facts(VerbRequest(arguments={"sudo": True}))

    assert (told["sudo"], told["sudo_refusal"]) == (can, said)
