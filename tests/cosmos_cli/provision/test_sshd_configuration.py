"""Whether an SSH server uses PAM, as sshd itself reads its configuration."""

import os
import shutil
import subprocess

import pytest

from cosmos_cli.onboard.sshd import uses_pam

SSHD = shutil.which("sshd", path=os.environ.get("PATH", "") + ":/usr/sbin:/sbin")
FORMS = [
    ("UsePAM yes", True),
    ("usepam yes", True),
    ("USEPAM YES", True),
    ("UsePAM=yes", True),
    ("UsePAM = yes", True),
    ('UsePAM = "yes"', True),
    ('UsePAM "yes"', True),
    ('"UsePAM" yes', True),
    ("\t UsePAM\tyes  # so that limits are read", True),
    ("UsePAM no", False),
    ("#UsePAM yes", False),
    ("", False),
    ("UsePAM no\nUsePAM yes", False),
    ("UsePAM yes\nUsePAM no", True),
    ("Include {etc}/ssh/sshd_config.d/*.conf\nUsePAM no", True),
    ("include={etc}/ssh/sshd_config.d/*.conf\nUsePAM no", True),
    ('Include {etc}/ssh/none/*.conf "{etc}/ssh/sshd_config.d/b.conf"', True),
    ("UsePAM no\nInclude {etc}/ssh/sshd_config.d/*.conf", False),
    ("Include {etc}/ssh/nested.conf", True),
    ("Match User nobody\nX11Forwarding no\nMatch all\nUsePAM yes", True),
    ("Match User nobody\nX11Forwarding no", False),
]


@pytest.fixture
def etc(tmp_path):
    folder = tmp_path / "etc" / "ssh" / "sshd_config.d"
    folder.mkdir(parents=True)
    (folder / "a.conf").write_text("# nothing of note\nX11Forwarding no\n")
    (folder / "b.conf").write_text("usepam=YES\n")
    (folder / "b.none").write_text("UsePAM no\n")
    (folder.parent / "nested.conf").write_text(f"Include {folder}/*.conf\n")
    return tmp_path / "etc"


@pytest.mark.process
@pytest.mark.parametrize(("text", "expected"), FORMS)
def test_it_is_read_as_sshd_reads_it(etc, text, expected):
    file = etc / "ssh" / "sshd_config"
    file.write_text(text.format(etc=etc) + "\n")

    assert uses_pam(str(etc)) is expected
    if SSHD is not None:
        assert _by_sshd(file, etc) is expected


def test_relative_patterns_and_those_of_etc_are_found(etc):
    for pattern in ("sshd_config.d/*.conf", "/etc/ssh/sshd_config.d/*.conf"):
        (etc / "ssh" / "sshd_config").write_text(f"Include {pattern}\n")

        assert uses_pam(str(etc)) is True


def test_what_cannot_be_read_is_not_known(tmp_path):
    assert uses_pam(str(tmp_path)) is None


def test_files_that_include_each_other_come_to_an_end(etc):
    file = etc / "ssh" / "sshd_config"
    file.write_text(f"Include {file}\nUsePAM yes\n")

    assert uses_pam(str(etc)) is True


def _by_sshd(file, etc):
    assert SSHD is not None
    key = etc / "key"
    if not key.exists():
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", key], check=True)
    if os.geteuid() == 0:
        os.makedirs("/run/sshd", mode=0o755, exist_ok=True)
    said = subprocess.run(
        [SSHD, "-T", "-f", file, "-h", key], capture_output=True, text=True, check=True
    ).stdout
    return "usepam yes" in said.splitlines()
