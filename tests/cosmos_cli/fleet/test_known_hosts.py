"""Which host keys are known, changed, revoked; and how an unknown one is recorded."""

import base64
import fcntl
import os
import re
import stat
import subprocess
import threading
from pathlib import Path

import pytest
from ssh_harness import needs_sshd

from cosmos_cli.fleet.ssh.known_hosts import (
    HostKey,
    KnownHost,
    KnownHosts,
    Standing,
    names_of,
    parse,
)

A = HostKey(kind="ssh-ed25519", blob=b"a" * 51)
B = HostKey(kind="ssh-ed25519", blob=b"b" * 51)
RSA = HostKey(kind="ssh-rsa", blob=b"r" * 279)
PI = ("pi",)


def line(name, key, marker=""):
    return f"{marker} {name} {key.kind} {base64.b64encode(key.blob).decode()} comment\n".lstrip()


@pytest.fixture
def hosts(tmp_path):
    def write(*lines, name="known_hosts"):
        file = tmp_path / name
        file.write_text("".join(lines), encoding="utf-8")
        return file

    return write


def standing(file, names, key):
    return KnownHosts([file]).judge(names, key).standing


def test_key_that_stands_there_is_known(hosts):
    assert Standing.KNOWN is standing(hosts(line("pi,10.0.0.1", A)), PI, A)
    assert Standing.KNOWN is standing(hosts(line("pi,10.0.0.1", A)), ("10.0.0.1",), A)


def test_machine_without_a_line_is_unknown(hosts):
    assert Standing.UNKNOWN is standing(hosts(line("other", A)), PI, A)


def test_missing_file_knows_nobody(tmp_path):
    assert Standing.UNKNOWN is standing(tmp_path / "none", PI, A)


def test_other_key_of_the_same_kind_is_a_change_and_its_line_is_named(hosts):
    verdict = KnownHosts([hosts("# comment\n", line("pi", A))]).judge(PI, B)

    assert Standing.CHANGED is verdict.standing
    assert verdict.against is not None
    assert (verdict.against.line, verdict.against.key) == (2, A)


def test_key_of_another_kind_is_a_change_too(hosts):
    # Algorithms are ordered by what is known; who shows another kind has none of the known ones.
    assert Standing.CHANGED is standing(hosts(line("pi", RSA)), PI, A)


def test_one_of_several_keys_is_enough(hosts):
    assert Standing.KNOWN is standing(hosts(line("pi", B), line("pi", A)), PI, A)


def test_revoked_key_is_refused_though_it_is_known(hosts):
    file = hosts(line("pi", A), line("*", A, marker="@revoked"))

    assert Standing.REVOKED is standing(file, PI, A)
    assert Standing.REVOKED is standing(file, ("unknown",), A)


def test_revoked_line_does_not_make_other_keys_changed(hosts):
    assert Standing.UNKNOWN is standing(hosts(line("pi", A, marker="@revoked")), PI, B)


def test_authority_is_no_key_of_a_machine_but_one_that_signs(hosts):
    known = KnownHosts([hosts(line("pi*", A, marker="@cert-authority"), line("pi2", B))])

    assert Standing.UNKNOWN is known.judge(PI, A).standing
    assert Standing.KNOWN is known.judge(("pi2",), B).standing
    assert Standing.KNOWN is known.judge_authority(PI, A).standing
    assert Standing.UNKNOWN is known.judge_authority(PI, B).standing
    assert Standing.UNKNOWN is known.judge_authority(("other",), A).standing
    assert known.has_authority(PI)
    assert not known.has_authority(("other",))
    assert known.kinds(PI) == []


def test_revoked_authority_is_none_though_it_is_listed(hosts):
    file = hosts(line("pi", A, marker="@cert-authority"), line("*", A, marker="@revoked"))

    verdict = KnownHosts([file]).judge_authority(PI, A)

    assert Standing.REVOKED is verdict.standing
    assert verdict.against is not None
    assert verdict.against.line == 2


def test_patterns_and_negations_are_understood(hosts):
    file = hosts(line("pi*,!pi9", A), line("[10.0.0.?]:2222", B))

    assert Standing.KNOWN is standing(file, ("pi1",), A)
    assert Standing.UNKNOWN is standing(file, ("pi9",), A)
    assert Standing.KNOWN is standing(file, ("[10.0.0.7]:2222",), B)
    assert Standing.UNKNOWN is standing(file, ("10.0.0.7",), B)


def test_names_of_a_port_of_its_own_fall_back_to_the_plain_name(hosts):
    names = names_of("Pi", 2222)

    assert names == ("[pi]:2222", "pi")
    assert Standing.KNOWN is standing(hosts(line("pi", A)), names, A)
    assert Standing.UNKNOWN is standing(hosts(line("pi", A)), names, B)
    assert Standing.CHANGED is standing(hosts(line("pi", A), line("[pi]:2222", B)), names, A)


def test_alias_stands_for_all_names():
    assert names_of("10.0.0.1", 2222, "Known") == ("known",)
    assert names_of("10.0.0.1", 22) == ("10.0.0.1",)


def test_lines_that_are_none_are_passed_over():
    text = "\n# a\npi ssh-ed25519\npi ssh-ed25519 !!!\n@no-such-marker * ssh-rsa QUJD\npi x QUJD\n"

    assert [KnownHost(patterns="pi", key=HostKey(kind="x", blob=b"ABC"), file="f", line=6)] == list(
        parse(text, "f")
    )


def test_kinds_are_those_of_the_name_that_is_known(hosts):
    known = KnownHosts([hosts(line("pi", RSA), line("pi", A), line("pi", B), line("x", A))])

    assert known.kinds(("[pi]:2222", "pi")) == ["ssh-rsa", "ssh-ed25519"]
    assert known.kinds(("nobody",)) == []


def test_files_are_asked_in_turn(hosts):
    files = [hosts(line("x", A)), hosts(line("pi", A), name="global")]

    assert Standing.KNOWN is KnownHosts(files).judge(PI, A).standing


def test_file_that_has_changed_is_read_again(hosts):
    file = hosts(line("pi", A))
    known = KnownHosts([file])
    known.judge(PI, A)
    hosts(line("pi", A), line("new", B))

    assert Standing.KNOWN is known.judge(("new",), B).standing


def test_recorded_key_is_appended_to_the_first_file_and_nothing_else_changes(hosts, tmp_path):
    first, second = hosts(line("x", B).rstrip("\n")), hosts(line("y", B), name="global")

    verdict = KnownHosts([first, second]).record("[pi]:22022", A)

    assert Standing.KNOWN is verdict.standing
    added = line("[pi]:22022", A).replace(" comment", "")
    assert line("x", B) + added == first.read_text()
    assert line("y", B) == second.read_text()


def test_new_file_is_readable_by_its_owner_only(tmp_path):
    file = tmp_path / "ssh" / "known_hosts"

    KnownHosts([file]).record("pi", A)

    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    assert Standing.KNOWN is standing(file, PI, A)


def test_changed_key_is_never_recorded(hosts):
    file = hosts(line("pi", A))

    assert Standing.CHANGED is KnownHosts([file]).record("pi", B).standing
    assert line("pi", A) == file.read_text()


def test_key_recorded_meanwhile_by_somebody_else_is_not_recorded_twice(hosts):
    file = hosts()
    known = KnownHosts([file])
    known.judge(PI, A)
    hosts(line("pi", A))

    assert Standing.KNOWN is known.record("pi", A).standing
    assert line("pi", A) == file.read_text()


def test_nothing_is_recorded_nowhere():
    assert Standing.KNOWN is KnownHosts([Path(os.devnull)]).record("pi", A).standing
    assert Standing.KNOWN is KnownHosts([]).record("pi", A).standing


def test_many_threads_record_whole_lines(tmp_path):
    file = tmp_path / "known_hosts"

    def record(number):
        KnownHosts([file]).record(f"pi{number}", A)

    threads = [threading.Thread(target=record, args=(n % 20,)) for n in range(60)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    found = [entry.patterns for entry in parse(file.read_text())]
    assert sorted(f"pi{n}" for n in range(20)) == sorted(found)


def test_who_records_waits_for_another_process_and_sees_what_it_wrote(tmp_path):
    file = tmp_path / "known_hosts"
    recording = threading.Thread(target=lambda: KnownHosts([file]).record("pi", A))
    with file.open("ab") as held:
        fcntl.flock(held, fcntl.LOCK_EX)  # a lock of its own to each open file, as to each process
        recording.start()
        recording.join(0.2)
        is_waiting = recording.is_alive()
        held.write(line("pi", A).encode())
    recording.join(20.0)

    assert is_waiting
    assert file.read_text() == line("pi", A)


def test_hashed_name_tells_nobody_which_machine_it_is_but_is_found(tmp_path):
    file = tmp_path / "known_hosts"

    KnownHosts([file]).record("[pi]:2222", A, is_hashed=True)

    # The digest may hold any two letters by chance, but no bracket.
    assert re.fullmatch(r"\|1\|[A-Za-z0-9+/=]+\|[A-Za-z0-9+/=]+", file.read_text().split()[0])
    assert Standing.KNOWN is standing(file, ("[pi]:2222",), A)
    assert Standing.UNKNOWN is standing(file, ("[pi]:2223",), A)


def test_fingerprint_is_what_ssh_keygen_shows():
    # Of a key made for this test.
    key = "AAAAC3NzaC1lZDI1NTE5AAAAIDkRPoRhTi/iX5m6cUztEd8YD3oy/ccbsGNnPIqt5Jsh"

    assert (
        HostKey(kind="ssh-ed25519", blob=base64.b64decode(key)).fingerprint
    ) == "SHA256:ZnoUOEt/985zGdsghOfs9DecUNeDdVB4o1XP6doIZUg"


@pytest.mark.process
def test_name_hashed_by_ssh_keygen_is_found(hosts):
    needs_sshd()
    file = hosts(line("pi", A), line("[pi]:2222", B))
    subprocess.run(["ssh-keygen", "-H", "-f", str(file)], check=True, capture_output=True)

    assert "|1|" in file.read_text()
    assert Standing.KNOWN is standing(file, PI, A)
    assert Standing.KNOWN is standing(file, ("[pi]:2222",), B)
    assert Standing.CHANGED is standing(file, PI, B)
