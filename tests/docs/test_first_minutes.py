"""The first five minutes of somebody new: what `make` says and installs, on this computer and on a fresh one."""

import os
import re
import shlex
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from fresh_debian import FreshDebian

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")
PREREQUISITES = ROOT / ".ci" / "prerequisites"
SYSTEMS = {
    "debian": (
        "ID=debian\nVERSION_CODENAME=bookworm\n",
        "apt-get install -y git make python3-venv",
    ),
    "raspbian": ("ID=raspbian\nID_LIKE=debian\n", "apt-get install -y git make python3-venv"),
    "ubuntu 24.04": ("ID=ubuntu\nID_LIKE=debian\nVERSION_CODENAME=noble\n", "python3-venv"),
    "ubuntu 22.04": ("ID=ubuntu\nID_LIKE=debian\nVERSION_CODENAME=jammy\n", "python3.11-venv"),
    "fedora": ("ID=fedora\nVERSION_ID=42\n", "dnf install -y git make python3"),
    "rocky": ('ID="rocky"\nID_LIKE="rhel centos fedora"\n', "dnf install"),
    "something else": ("ID=haiku\n", "package manager"),
}
README_PACKAGES = re.findall(r"^    (sudo (?:apt|dnf)[^#\n]*?) *#", README, flags=re.M)


def fake_python(folder, name, script):
    """Write a program that stands for an interpreter; return the folder that holds it."""
    folder.mkdir(exist_ok=True)
    program = folder / name
    program.write_text(f"#!/bin/sh\n{script}\n", "utf-8")
    program.chmod(0o755)
    return folder


def ask(folder, python="python3", release=None):
    """Run the check where *folder* alone holds interpreters."""
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    for tool in ("sh", "sed", "id"):
        if not (programs / tool).exists():
            (programs / tool).symlink_to(shutil.which(tool))
    return subprocess.run(
        ["/bin/sh", PREREQUISITES, python],
        env={"PATH": str(programs), "COSMOS_OS_RELEASE": str(release or folder / "none")},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("system", SYSTEMS)
def test_missing_venv_is_told_with_the_one_line_to_type(tmp_path, system):
    text, expected = SYSTEMS[system]
    release = tmp_path / "os-release"
    release.write_text(text, "utf-8")
    # As Debian without python3-venv: the version will do, ensurepip is not there.
    fake_python(tmp_path / "bin", "python3", 'case "$2" in *version_info*) exit 0 ;; esac; exit 1')

    done = ask(tmp_path, release=release)

    assert done.returncode == 2
    assert "without ensurepip" in done.stderr
    assert expected in done.stderr


def test_old_python_beside_a_newer_one_is_told_with_the_newer_ones_name(tmp_path):
    fake_python(tmp_path / "bin", "python3", 'echo "Python 3.9.2"; exit 1')
    fake_python(tmp_path / "bin", "python3.12", "exit 0")

    done = ask(tmp_path)

    assert done.returncode == 2
    assert "Python 3.9.2, too old" in done.stderr
    assert "make PYTHON=python3.12 demo" in done.stderr


def test_computer_with_all_that_is_needed_is_told_nothing(tmp_path):
    fake_python(tmp_path / "bin", "python3", "exit 0")

    done = ask(tmp_path)

    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_demo_asks_before_it_makes_anything():
    """Also without make's own help: the check is the first thing of what `demo` needs."""
    # Below another make, one tells of the folders that it enters.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
    done = subprocess.run(
        ["make", "-n", "demo", "VENV=there-is-none"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    lines = done.stdout.splitlines()

    assert ".ci/prerequisites" in lines[0]
    assert "[dev]" not in done.stdout


def told_by(tested):
    """Return what a failed suite told: its commonest errors first, of which the last lines may name none."""
    errors = Counter(line[:300] for line in tested.stdout.splitlines() if line.startswith("E  "))
    commonest = "\n".join(f"{count} x {line}" for line, count in errors.most_common(20))
    return f"{commonest}\n\n{tested.stdout[-6000:]}{tested.stderr[-1000:]}"


@pytest.mark.nightly
@pytest.mark.root
@pytest.mark.timeout(4200)
def test_both_commands_of_the_readme_work_on_a_minimal_debian(tmp_path):
    if os.geteuid() != 0 or shutil.which("mmdebstrap") is None:
        pytest.skip("needs root and mmdebstrap")
    [debian] = [line for line in README_PACKAGES if "apt" in line]
    packages = shlex.split(debian.split("install", 1)[1])
    without_venv = [name for name in packages if not name.endswith("-venv")]
    fresh = FreshDebian(tmp_path, [*without_venv, "python3", "ca-certificates"])

    told = fresh.run("make demo")
    assert told.returncode == 2, told.stdout + told.stderr
    line = next(text.strip() for text in told.stderr.splitlines() if "apt-get install" in text)
    assert not (fresh.root / "home/student/cosmos/.venv").exists()
    typed = fresh.run_as_root(line.replace("sudo ", ""))
    assert typed.returncode == 0, typed.stderr

    demo = fresh.run("make demo")
    # A shared machine may miss ticks; what is shown is that everything is there and runs to its verdict.
    assert re.search(
        r"^(PASSED|CHECK BROKEN: (deadline|time)\.)", demo.stdout + demo.stderr, flags=re.M
    ), demo.stdout + demo.stderr
    assert "Traceback" not in demo.stderr
    assert (fresh.root / "home/student/cosmos/runs/0001-iridium10/report.html").is_file()

    # What all tests say is CI's to ask: here, whether anything that they need is missing.
    tested = fresh.run("make test CHOSEN=--first-of-each-file")
    assert tested.returncode == 0, told_by(tested)
