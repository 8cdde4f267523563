"""Certificates of hosts count as they do for ssh: made by ssh-keygen, shown by a real sshd."""

import base64
import shutil
import subprocess
from datetime import UTC, datetime

import pytest
from ssh_harness import needs_sshd, target_of, write_configuration
from sshd import Sshd, make_key, public

from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.ssh.host_certificate import read_certificate
from cosmos_cli.fleet.ssh.known_hosts import HostKey

pytestmark = pytest.mark.process

ACCEPT = ConnectOptions(accept_new_host_keys=True)
NAME = "127.0.0.1"
EXPIRED = ("-V", "20200101:20210101")


@pytest.fixture(scope="module")
def authorities(tmp_path_factory):
    needs_sshd()
    folder = tmp_path_factory.mktemp("authorities")
    return {
        **{kind: make_key(folder / kind, kind) for kind in ("ed25519", "ecdsa", "rsa")},
        "other": make_key(folder / "other", "ed25519"),
    }


@pytest.fixture
def serve(tmp_path, authorities):
    """Start a server whose host key an authority has signed."""
    started = []

    def start(*words, authority="ed25519", kind="ed25519", extra=""):
        folder = tmp_path / f"sshd{len(started)}"
        certificate = f"HostCertificate {folder}/host_{kind}-cert.pub"
        server = Sshd(folder, kinds=(kind,), extra=f"{certificate}\n{extra}")
        sign(authorities[authority], server.host_keys[kind], "-h", *(words or ("-n", NAME)))
        started.append(server)
        return server.__enter__()

    yield start
    for server in started:
        server.__exit__()


def sign(authority, key, *words):
    command = ["ssh-keygen", "-q", "-s", str(authority), "-I", "pi", *words, f"{key}.pub"]
    subprocess.run(command, check=True)


def authority_line(authorities, name="*", authority="ed25519", marker="@cert-authority"):
    return f"{marker} {name} {public(authorities[authority])}"


def says_hello(server, options=ConnectOptions()):  # noqa: B008 - frozen
    connection = connect(target_of(server), options)
    try:
        return connection.run("echo hello", timeout_s=60.0).stdout == b"hello\n"
    finally:
        connection.close()


def refused(server, kind=FailureKind.HOST_KEY_UNKNOWN, options=ACCEPT):
    with pytest.raises(MachineFailure) as caught:
        connect(target_of(server), options)
    assert kind is caught.value.kind, caught.value
    assert caught.value.advice
    return caught.value.text


@pytest.mark.parametrize("kind", ["ed25519", "ecdsa", "rsa"])
def test_host_certificate_of_a_listed_authority_makes_a_machine_known(
    serve, authorities, known_hosts, kind
):
    server = serve(authority=kind, kind=kind)
    line = authority_line(authorities, server.name, kind)
    known_hosts.write_text(line)

    assert says_hello(server, ACCEPT)
    assert line == known_hosts.read_text()


def test_certificate_counts_though_another_key_was_known(serve, authorities, known_hosts):
    server = serve()
    changed = f"{server.name} {public(authorities['other'])}"
    known_hosts.write_text(authority_line(authorities) + changed)

    assert says_hello(server)


def test_certificate_without_principals_is_for_every_name(serve, authorities, known_hosts):
    server = serve("-V", "+1h")
    known_hosts.write_text(authority_line(authorities))

    assert says_hello(server)


def test_alias_is_the_name_that_a_certificate_is_for(serve, authorities, known_hosts, home):
    write_configuration(home / ".ssh" / "config", "HostKeyAlias Board")
    server = serve("-n", "board")
    known_hosts.write_text(authority_line(authorities, "board"))

    assert says_hello(server)


def test_authority_that_is_not_listed_vouches_for_nobody(serve, authorities, known_hosts):
    server = serve(authority="other")
    known_hosts.write_text(authority_line(authorities))

    assert "its host key is not known" in refused(server, options=ConnectOptions())


def test_authority_of_other_machines_vouches_for_none_else(serve, authorities, known_hosts):
    server = serve()
    known_hosts.write_text(authority_line(authorities, "10.*"))

    assert "its host key is not known" in refused(server, options=ConnectOptions())


def test_machine_without_a_certificate_is_unknown_to_an_authority(
    own_sshd, authorities, known_hosts
):
    known_hosts.write_text(authority_line(authorities))

    assert "its host key is not known" in refused(own_sshd, options=ConnectOptions())


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-n", "other"), "it is for other, not for 127.0.0.1"),
        (("-n", "127.0.0.*"), "it is for 127.0.0.*, not for 127.0.0.1"),
        (("-n", NAME, *EXPIRED), "it has expired on 20"),
        (("-n", NAME, "-V", "20990101:forever"), "it is not valid before 20"),
        (("-n", NAME, "-O", "critical:some@example.com=x"), "it has critical options"),
    ],
)
def test_certificate_that_does_not_count_is_refused_and_nothing_recorded(
    serve, authorities, known_hosts, words, told
):
    server = serve(*words)
    line = authority_line(authorities)
    known_hosts.write_text(line)

    text = refused(server)

    assert told in text
    assert f"{known_hosts}:1" in text
    assert line == known_hosts.read_text()


def test_key_that_is_known_needs_no_certificate_that_counts(serve, authorities, known_hosts):
    server = serve("-n", NAME, *EXPIRED)
    known_hosts.write_text(authority_line(authorities) + server.known_hosts_line())

    assert says_hello(server)


def test_revoked_authority_is_refused_with_a_message_of_its_own(serve, authorities, known_hosts):
    server = serve()
    revoked = authority_line(authorities, marker="@revoked")
    known_hosts.write_text(authority_line(authorities) + server.known_hosts_line() + revoked)

    text = refused(server, FailureKind.HOST_KEY_CHANGED)

    assert f"its host certificate's authority is revoked ({known_hosts}:3)" in text


def test_revoked_key_is_refused_though_its_certificate_is_valid(serve, authorities, known_hosts):
    server = serve()
    revoked = f"@revoked * {server.known_hosts_line().split(' ', 1)[1]}"
    known_hosts.write_text(authority_line(authorities) + revoked)

    assert "its host key is revoked" in refused(server, FailureKind.HOST_KEY_CHANGED)


CASES = {
    "valid": (("-n", NAME), "{authority}"),
    "no principals": (("-V", "+1h"), "{authority}"),
    "other name": (("-n", "other"), "{authority}"),
    "pattern": (("-n", "127.0.0.*"), "{authority}"),
    "expired": (("-n", NAME, *EXPIRED), "{authority}"),
    "expired, key known": (("-n", NAME, *EXPIRED), "{authority}{key}"),
    "critical option": (("-n", NAME, "-O", "critical:x@example.com=x"), "{authority}"),
    "revoked": (("-n", NAME), "{authority}{revoked}"),
    "revoked, key known": (("-n", NAME), "{authority}{revoked}{key}"),
    "other key known": (("-n", NAME), "{authority}{other}"),
}


@pytest.mark.parametrize("case", CASES)
def test_same_as_ssh_itself_does(serve, authorities, known_hosts, case):
    if shutil.which("ssh") is None:
        pytest.skip("needs OpenSSH's ssh")
    words, lines = CASES[case]
    server = serve(*words)
    known_hosts.write_text(
        lines.format(
            authority=authority_line(authorities),
            revoked=authority_line(authorities, marker="@revoked"),
            key=server.known_hosts_line(),
            other=f"{server.name} {public(authorities['other'])}",
        )
    )
    options = {
        "UserKnownHostsFile": known_hosts,
        "GlobalKnownHostsFile": "none",
        "IdentityAgent": "none",
        "BatchMode": "yes",
    }
    command = ["ssh", "-F", "none", "-i", str(server.user_key), "-p", str(server.port)]
    command += [word for name, value in options.items() for word in ("-o", f"{name}={value}")]
    theirs = subprocess.run(
        [*command, server.address, "true"], stdin=subprocess.DEVNULL, capture_output=True
    ).returncode

    try:
        ours = says_hello(server)
    except MachineFailure:
        ours = False

    assert ours is (theirs == 0)


# What a server does not show by itself.


@pytest.fixture
def certificate(tmp_path, authorities):
    def make(*words, authority="ed25519"):
        key = make_key(tmp_path / "key", "ed25519")
        sign(authorities[authority], key, *words)
        text = (tmp_path / "key-cert.pub").read_text()
        return base64.b64decode(text.split()[1])

    return make


def fault(blob):
    return read_certificate(blob).fault("pi", datetime.now(UTC).timestamp())


def test_certificate_is_read(certificate, authorities):
    found = read_certificate(certificate("-h", "-n", "pi,10.0.0.7"))

    assert found.principals == ("pi", "10.0.0.7")
    kind, blob = public(authorities["ed25519"]).split()[:2]
    assert found.authority == HostKey(kind=kind, blob=base64.b64decode(blob))
    assert found.fault("pi", datetime.now(UTC).timestamp()) is None


def test_certificate_of_a_user_is_none_of_a_host(certificate):
    assert "certificate of a user" in fault(certificate("-n", "pi"))


def test_certificate_that_was_altered_is_not_signed(certificate):
    blob = certificate("-h", "-n", "px")

    assert "its signature" in fault(blob.replace(b"\x00\x00\x00\x02px", b"\x00\x00\x00\x02pi"))


@pytest.mark.parametrize(("algorithm", "counts"), [("ssh-rsa", False), ("rsa-sha2-256", True)])
def test_authority_that_signs_by_sha_1_vouches_for_nobody(certificate, algorithm, counts):
    """As with ssh, whose CASignatureAlgorithms hold no ssh-rsa."""
    found = fault(certificate("-t", algorithm, "-h", "-n", "pi", authority="rsa"))

    assert found == (None if counts else "it is signed by SHA-1 (ssh-rsa), which can be forged")


@pytest.mark.parametrize("cut", [1, 40, 100, -20])
def test_certificate_that_is_cut_is_none(certificate, cut):
    with pytest.raises(ValueError):
        fault(certificate("-h", "-n", "pi")[:cut])
