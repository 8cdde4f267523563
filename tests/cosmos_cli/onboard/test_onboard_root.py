"""Who may not become root, and where sudo is slow or missing, is told apart."""

import io

import pytest

from cosmos_cli.onboard import facts, request_loop
from cosmos_cli.onboard.request_loop import HelperRefusal, Rooted, VerbRequest

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("script", "kind", "text"),
    [
        ("exec sleep 2", "timeout", "sudo -n true has not ended in 0.2 s"),
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
