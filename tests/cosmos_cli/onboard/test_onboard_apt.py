"""System packages through apt: its words understood, and the verb against an apt that is only played."""

from __future__ import annotations

import stat
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target
from cosmos_cli.onboard.apt_words import changes_between, kept_back, planned_changes, trouble_of

PATIENCE_S = 120.0
PARTS = ("files", "links", "dpkg", "facts", "scratch", "system", "apt_words", "apt")

SAID = {
    "unknown": "Reading package lists...\nE: Unable to locate package nonexistent-foo",
    "no_way": (
        "E: Failed to fetch http://deb.example/dists/bookworm/InRelease"
        "  Could not resolve 'deb.example'\nE: Some index files failed to download."
    ),
    "locked": (
        "E: Could not get lock /var/lib/dpkg/lock-frontend. It is held by process 812 (unattended-upgr)\n"
        "E: Unable to acquire the dpkg frontend lock (/var/lib/dpkg/lock-frontend)"
    ),
    "interrupted": (
        "E: dpkg was interrupted, you must manually run 'dpkg --configure -a' to correct the problem."
    ),
    "disk_full": "E: You don't have enough free space in /var/cache/apt/archives/.",
    "read_only": "E: Could not open lock file /var/lib/dpkg/lock - open (30: Read-only file system)",
    "clock": (
        "E: Release file for http://deb.example/InRelease is not valid yet (invalid for another 3d 2h)."
    ),
    "unsigned": "GPG error: http://deb.example InRelease: signatures: NO_PUBKEY 0E98404D386FA1D9",
    "stale": "E: Failed to fetch http://deb.example/pool/a.deb  404  Not Found [IP: 10.0.0.1 80]",
    "broken": (
        "You might want to run 'apt --fix-broken install' to correct these.\n"
        "The following packages have unmet dependencies:\n foo : Depends: bar (>= 2)\n"
        "E: Unmet dependencies. Try 'apt --fix-broken install' with no packages."
    ),
    "unmet": (
        "The following packages have unmet dependencies:\n"
        " dash : Depends: dpkg (>= 1.19.1) but it is not going to be installed\n"
        " gzip : Depends: dpkg (>= 1.15.4) but it is not going to be installed or\n"
        "                 install-info but it is not installable\n"
        "E: Error, pkgProblemResolver::Resolve generated breaks, this may be caused by held packages."
    ),
    "essential": "E: Essential packages were removed and -y was used without --allow-remove-essential.",
    "sources": "E: Malformed entry 1 in list file /etc/apt/sources.list (Suite)",
    "not_root": "E: Could not open lock file /var/lib/dpkg/lock - open (13: Permission denied)",
    "other": "Segmentation fault",
}
KINDS = {
    "locked": "busy",
    "disk_full": "disk_full",
    "read_only": "read_only",
    "not_root": "no_sudo",
}


@pytest.mark.parametrize("word", SAID)
def test_what_apt_says_is_understood(word: str) -> None:
    trouble = trouble_of(SAID[word])

    assert trouble.word == word
    assert trouble.kind == KINDS.get(word, "step")
    assert trouble.text
    assert trouble.advice or word == "other"


def test_trouble_names_whom_it_is_about() -> None:
    assert "nonexistent-foo" in trouble_of(SAID["unknown"]).text
    assert "deb.example" in trouble_of(SAID["no_way"]).text
    assert "(unattended-upgr, pid 812)" in trouble_of(SAID["locked"]).text
    assert "/var/cache/apt/archives/" in trouble_of(SAID["disk_full"]).text
    assert "Segmentation fault" in trouble_of(SAID["other"]).text


def test_version_that_no_source_has_is_named_with_its_package() -> None:
    trouble = trouble_of("E: Version '9' for 'hello' was not found")

    assert trouble.word == "unknown"
    assert "have no hello=9" in trouble.text


def test_what_does_not_fit_together_is_told_and_nothing_is_mended_that_is_whole() -> None:
    unmet, broken = trouble_of(SAID["unmet"]), trouble_of(SAID["broken"])

    assert "(dash : Depends: dpkg (>= 1.19.1) but it is not going to be installed; and more)" in (
        unmet.text
    )
    assert "fix-broken" not in unmet.advice
    assert "(foo : Depends: bar (>= 2))" in broken.text
    assert "--fix-broken install" in broken.advice


def test_unknown_package_may_be_a_python_package() -> None:
    assert "`requirements` of the scenario" in trouble_of(SAID["unknown"]).advice


def test_planned_changes_are_read_from_a_simulation() -> None:
    output = (
        "Inst hello (2.10-3 Debian:12.15/oldstable [amd64])\n"
        "Inst bar [1.0] (1.1 Debian:12 [amd64])\n"
        "Remv foo [0.9]\n"
        "Conf hello (2.10-3 Debian:12.15/oldstable [amd64])\n"
    )

    assert planned_changes(output) == [
        {"name": "bar", "old": "1.0", "new": "1.1"},
        {"name": "foo", "old": "0.9", "new": None},
        {"name": "hello", "old": None, "new": "2.10-3"},
    ]


def test_changes_are_what_differs_before_and_after() -> None:
    before = {"same": "1", "gone": "1", "newer": "1"}

    assert changes_between(before, {"same": "1", "newer": "2", "added": "1"}) == [
        {"name": "added", "old": None, "new": "1"},
        {"name": "gone", "old": "1", "new": None},
        {"name": "newer", "old": "1", "new": "2"},
    ]


def test_packages_that_are_kept_back_are_named() -> None:
    output = "The following packages have been kept back:\n  linux-image foo\n  bar\n0 upgraded\n"

    assert kept_back(output) == ["linux-image", "foo", "bar"]


DPKG_QUERY = r"""#!/bin/sh
# dpkg-query -W -f=... NAMES: a folder of files, name -> version, stands for the packages
shift 2
cd "$PACKAGES" || exit 9
status=0
for name in ${@:-*}; do
    if [ -f "$name" ]; then echo "$name all installed $(cat "$name")"; else status=1; fi
done
exit $status
"""
APT_GET = r"""#!/bin/sh
case " $* " in *" --simulate "*) what=simulated ;; *) what=apt-get ;; esac
case "$*" in *--config-file=*) where=" beside" ;; *) where= ;; esac
set -- $(echo " $*" | sed 's/ -[^ ]*//g')
echo "$what $*$where" >> "$PACKAGES/../asked"
action=$1; shift
if [ -f "$PACKAGES/../say-$action" ]; then
    cat "$PACKAGES/../say-$action"; rm "$PACKAGES/../say-$action"; exit 100
fi
while [ -f "$PACKAGES/../held-up" ]; do sleep 0.05; done
if [ $what = simulated ]; then for name; do echo "Inst $name (1.0 x)"; done; exit 0; fi
case $action in
    install) for name; do echo 1.0 > "$PACKAGES/$name"; done ;;
    remove) for name; do rm "$PACKAGES/$name"; done ;;
    upgrade) for file in "$PACKAGES"/*; do echo 2.0 > "$file"; done ;;
esac
"""
DPKG = r"""#!/bin/sh
echo "dpkg $*" >> "$PACKAGES/../asked"
if [ -f "$PACKAGES/../say-dpkg" ]; then
    cat "$PACKAGES/../say-dpkg"; rm "$PACKAGES/../say-dpkg"; exit 2
fi
"""

Packages = Callable[..., dict[str, Any]]


class PlayedApt:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "packages").mkdir()
        tools = folder / "tools"
        tools.mkdir()
        for name, text in {"dpkg-query": DPKG_QUERY, "apt-get": APT_GET, "dpkg": DPKG}.items():
            (tools / name).write_text(text)
            (tools / name).chmod(stat.S_IRWXU)

    def holds(self, **versions: str) -> None:
        for name, version in versions.items():
            (self.folder / "packages" / name).write_text(version)

    def says_once(self, action: str, word: str) -> None:
        (self.folder / f"say-{action}").write_text(SAID[word])

    def hold_up(self) -> None:
        (self.folder / "held-up").touch()

    def go_on(self) -> None:
        (self.folder / "held-up").unlink()

    def wait_for(self, name: str) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while not (self.folder / "packages" / name).exists():
            assert time.monotonic() < until_s, f"{name} was not installed"
            time.sleep(0.05)

    def asked(self) -> list[str]:
        path = self.folder / "asked"
        return path.read_text().splitlines() if path.exists() else []


@pytest.fixture
def apt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PlayedApt:
    played = PlayedApt(tmp_path)
    monkeypatch.setenv("PACKAGES", str(tmp_path / "packages"))
    monkeypatch.setenv("PATH", f"{tmp_path / 'tools'}:/usr/bin:/bin")
    return played


@pytest.fixture
def packages(apt: PlayedApt) -> Iterator[Packages]:
    target = Target(name="pi01", address="127.0.0.1", connection="local")
    with Helper.start(LocalConnection(target), PARTS) as board:

        def packages(action: str, *names: str, **more: Any) -> dict[str, Any]:
            arguments = {"action": action, "names": names, **more}
            told = [piece.value for piece in board.pieces("packages", arguments)]
            return dict(told[-1])

        yield packages


@pytest.mark.process
def test_install_tells_what_changed_and_nothing_the_second_time(
    apt: PlayedApt, packages: Packages
) -> None:
    apt.holds(bar="3.0")

    first = packages("install", "foo", "bar")
    asked = apt.asked()
    second = packages("install", "foo", "bar")

    assert first["changes"] == [{"name": "foo", "old": None, "new": "1.0"}]
    assert second == {"changes": [], "notes": []}
    assert asked == ["apt-get install foo"]
    assert apt.asked() == asked


@pytest.mark.process
def test_remove_takes_away_only_what_is_there(apt: PlayedApt, packages: Packages) -> None:
    apt.holds(foo="1.0")

    assert packages("remove", "foo", "bar")["changes"] == [
        {"name": "foo", "old": "1.0", "new": None}
    ]
    assert packages("remove", "foo", "bar")["changes"] == []
    assert apt.asked() == ["apt-get remove foo"]


@pytest.mark.process
def test_upgrade_renews_the_lists_first(apt: PlayedApt, packages: Packages) -> None:
    apt.holds(foo="1.0", bar="2.0")

    result = packages("upgrade")

    assert result["changes"] == [{"name": "foo", "old": "1.0", "new": "2.0"}]
    assert apt.asked() == ["apt-get update", "apt-get upgrade"]


@pytest.mark.process
def test_upgrade_of_what_is_not_there_is_refused(apt: PlayedApt, packages: Packages) -> None:
    with pytest.raises(MachineFailure, match="not installed there: foo"):
        packages("upgrade", "foo")

    assert apt.asked() == []


@pytest.mark.process
def test_interrupted_installation_is_finished_first(apt: PlayedApt, packages: Packages) -> None:
    apt.says_once("install", "interrupted")

    result = packages("install", "foo")

    assert [change["name"] for change in result["changes"]] == ["foo"]
    assert "finished an interrupted installation: dpkg --configure -a" in result["notes"]
    assert apt.asked()[1:] == ["dpkg --configure -a", "apt-get install foo"]


@pytest.mark.process
def test_lock_is_waited_for_where_an_installation_is_finished(
    apt: PlayedApt, packages: Packages
) -> None:
    """As where the machine updates itself after a power failure."""
    apt.says_once("install", "interrupted")
    (apt.folder / "say-dpkg").write_text(
        "dpkg: error: dpkg frontend lock was locked by another process with pid 869\n"
        "Note: removing the lock file is always wrong, can damage the locked area\n"
    )

    result = packages("install", "foo")

    assert [change["name"] for change in result["changes"]] == ["foo"]
    assert apt.asked().count("dpkg --configure -a") == 2


@pytest.mark.process
def test_unknown_package_renews_the_lists_once(apt: PlayedApt, packages: Packages) -> None:
    apt.says_once("install", "unknown")

    result = packages("install", "foo")

    assert [change["name"] for change in result["changes"]] == ["foo"]
    assert apt.asked() == ["apt-get install foo", "apt-get update", "apt-get install foo"]


@pytest.mark.process
@pytest.mark.parametrize("word", ["unknown", "stale", "no_way"])
def test_check_renews_lists_of_its_own_where_the_real_one_would_renew_the_system_s(
    apt: PlayedApt, packages: Packages, word: str
) -> None:
    apt.says_once("install", word)

    result = packages("install", "foo", is_check=True)

    assert result == {"changes": [{"name": "foo", "old": None, "new": "1.0"}], "notes": []}
    assert apt.asked() == [
        "simulated install foo",
        "apt-get update beside",
        "simulated install foo beside",
    ]
    assert not (apt.folder / "packages" / "foo").exists()


@pytest.mark.process
def test_check_of_an_upgrade_sees_what_only_the_newest_lists_tell(
    apt: PlayedApt, packages: Packages
) -> None:
    apt.holds(foo="1.0")

    packages("upgrade", "foo", is_check=True)

    assert apt.asked() == ["apt-get update beside", "simulated install foo beside"]


@pytest.mark.process
def test_lists_that_cannot_be_renewed_are_the_failure(apt: PlayedApt, packages: Packages) -> None:
    apt.says_once("update", "no_way")

    with pytest.raises(MachineFailure, match="no way from there to its package source deb.example"):
        packages("upgrade")

    assert apt.asked() == ["apt-get update"]


@pytest.mark.process
def test_lock_is_waited_for_a_bounded_time(apt: PlayedApt, packages: Packages) -> None:
    apt.holds(foo="1.0")
    apt.says_once("remove", "locked")

    assert packages("remove", "foo")["changes"] != []
    assert apt.asked() == ["apt-get remove foo"] * 2

    apt.holds(foo="1.0")
    apt.says_once("remove", "locked")

    with pytest.raises(MachineFailure) as failure:
        packages("remove", "foo", lock_s=-1.0)

    assert failure.value.kind is FailureKind.BUSY
    assert len(apt.asked()) == 3


@pytest.mark.process
def test_apt_goes_on_to_its_end_when_its_time_is_over(apt: PlayedApt, packages: Packages) -> None:
    apt.hold_up()

    with pytest.raises(MachineFailure, match="apt-get still works there") as failure:
        packages("install", "foo", timeout_s=0.5)

    assert failure.value.kind is FailureKind.TIMEOUT
    apt.go_on()
    apt.wait_for("foo")


@pytest.mark.process
def test_apt_goes_on_to_its_end_when_nobody_listens_any_more(apt: PlayedApt) -> None:
    apt.hold_up()
    target = Target(name="pi01", address="127.0.0.1", connection="local")
    board = Helper.start(LocalConnection(target), PARTS)
    pieces = board.pieces("packages", {"action": "install", "names": ["foo"]})

    assert "doing" in next(pieces).value
    board.close()
    apt.go_on()

    apt.wait_for("foo")


@pytest.mark.process
def test_machine_without_apt_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "python3").symlink_to(sys.executable)
    monkeypatch.setenv("PATH", str(tmp_path))
    # Else the system's own programs are put behind it, and apt is one.
    monkeypatch.setattr("cosmos_cli.fleet.helper.SYSTEM_PATH", "")
    target = Target(name="pi01", address="127.0.0.1", connection="local")

    with (
        Helper.start(LocalConnection(target), PARTS) as board,
        pytest.raises(MachineFailure) as failure,
    ):
        list(board.pieces("packages", {"action": "install", "names": ["foo"]}))

    assert failure.value.kind is FailureKind.UNSUPPORTED
