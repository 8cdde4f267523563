"""What works on a machine changes files whole or not at all, and sees its commands through."""

import errno
import io
import os
import stat
from pathlib import Path

import pytest
from fake_system import connection_to
from harness import full_disk
from harness.waiting import is_alive, wait_until

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.models.provision_steps import FILE_BYTES_MAX
from cosmos_cli.onboard import facts, files, request_loop, system, wheels
from cosmos_cli.onboard.files import replace_file
from cosmos_cli.onboard.request_loop import HelperRefusal, VerbRequest, refusal_of
from cosmos_cli.provision import HELPER_PARTS

PATIENCE_S = 30.0


def test_lock_is_given_up_within_a_minute_unless_something_else_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(request_loop.PatientInput, "patience_s", None)

    request_loop.lock(VerbRequest(arguments={"path": str(tmp_path / "lock")}, body=b""))

    assert request_loop.PatientInput.patience_s == 60.0


@pytest.mark.parametrize("kind", ["link", "dangling", "pipe", "folder"])
def test_lock_empties_no_file_that_a_link_leads_to_and_waits_for_no_pipe(tmp_path, kind):
    path, victim = tmp_path / "lock", tmp_path / "victim"
    victim.write_text("precious")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to(victim if kind == "link" else tmp_path / "nowhere")

    with pytest.raises(HelperRefusal, match="lock: expected a file") as caught:
        request_loop.lock(VerbRequest(arguments={"path": str(path)}, body=b""))

    assert caught.value.advice == "delete it there"
    assert victim.read_text() == "precious"
    assert not (tmp_path / "nowhere").exists()


def test_piece_of_a_wheel_is_not_appended_to_what_a_link_leads_to(tmp_path):
    victim = tmp_path / "victim"
    victim.touch()
    sha256 = "0" * 64
    Path(wheels.partial_path(str(tmp_path), sha256)).symlink_to(victim)
    asked = {"folder": str(tmp_path), "sha256": sha256, "offset": 0, "size": 9, "filename": "x.whl"}

    with pytest.raises(OSError, match="symbolic links"):
        wheels.wheel(VerbRequest(arguments=asked, body=b"abc"))

    assert victim.read_bytes() == b""


@pytest.mark.timeout(30)
def test_file_longer_than_any_that_is_written_differs_without_being_read(tmp_path):
    assert files.CONTENT_BYTES_MAX == FILE_BYTES_MAX
    path = tmp_path / "sparse"
    path.touch()
    os.truncate(path, 9 * 10**12)

    asked = {"files": {str(path): "hash"}}
    told = facts.look(VerbRequest(arguments=asked))["files"][str(path)]

    assert told["size_bytes"] == 9 * 10**12
    assert "sha256" not in told
    edit = {"path": str(path), "line": "x", "is_present": True}
    with pytest.raises(HelperRefusal, match="expected at most 67108864 B to edit"):
        files.edit_line(VerbRequest(arguments=edit, body=b""))
    assert replace_file(str(path), b"x", {}) is True
    assert path.read_bytes() == b"x"


@pytest.mark.process
def test_what_worked_as_root_and_was_killed_is_lost_and_not_the_operator(tmp_path, monkeypatch):
    """A broken pipe to it must not look as if nobody listened any more."""
    sudo = tmp_path / "sudo"
    sudo.write_text('#!/bin/sh\nshift\nexec "$@"\n')
    sudo.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    greets_and_dies = 'echo \'{"ok": true, "body": 0}\''
    rooted = request_loop.Rooted(["/bin/sh", "-c", greets_and_dies], b"package")
    out = io.BytesIO()

    for _ in range(2):
        with pytest.raises(HelperRefusal, match="ended without an answer") as caught:
            rooted.relay({"verb": "facts"}, b"", out)
        rooted._process.wait()

    assert caught.value.kind == "lost"
    rooted.close()


def test_new_file_has_the_usual_mode_and_folders_above(tmp_path):
    path = tmp_path / "a/b/c.conf"

    assert replace_file(str(path), b"x\n", {}) is True

    assert path.read_bytes() == b"x\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_mode_stays_and_same_content_is_no_change(tmp_path):
    path = tmp_path / "a"
    path.write_text("x\n")
    path.chmod(0o640)
    before = path.stat()

    assert replace_file(str(path), b"x\n", {}) is False
    assert path.stat().st_ino == before.st_ino
    assert replace_file(str(path), b"y\n", {}) is True
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert replace_file(str(path), b"y\n", {"mode": 0o600}) is True
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.parametrize("function", ["fsync", "rename", "fchmod"])
def test_failure_at_any_point_leaves_the_old_file_alone(tmp_path, monkeypatch, function):
    path = tmp_path / "a"
    path.write_text("old")

    monkeypatch.setattr(files.os, function, full_disk.refuse)
    with pytest.raises(OSError, match="No space"):
        replace_file(str(path), b"new", {})

    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize(
    ("number", "kind", "cure"),
    [
        (errno.ENOSPC, "disk_full", "make room"),
        (errno.EROFS, "read_only", "check the card"),
        (errno.EACCES, "step", "who owns it"),
        (errno.EPERM, "step", "who owns it"),
        (errno.ENOTDIR, "step", "remove what is no folder"),
        (errno.EIO, "step", "replace it"),
    ],
)
def test_error_of_the_file_system_is_told_with_what_to_do(number, kind, cure):
    refusal = refusal_of(OSError(number, os.strerror(number), "/home/pi/cosmos/trees"))

    assert (refusal.kind, refusal.text) == (kind, f"/home/pi/cosmos/trees: {os.strerror(number)}")
    assert cure in refusal.advice


def test_nobody_sees_a_half_written_file(tmp_path, monkeypatch):
    path = tmp_path / "a"
    path.write_text("old")
    seen = []
    rename = os.rename

    def watch(source, target):
        seen.append((path.read_text(), Path(source).read_text()))
        rename(source, target)

    monkeypatch.setattr(files.os, "rename", watch)
    replace_file(str(path), b"new", {})

    assert seen == [("old", "new")]


@pytest.mark.parametrize("root", ["usb", "usb/cosmos"])
def test_folder_on_a_disk_that_is_not_mounted_is_told_as_such(tmp_path, root):
    (tmp_path / "usb").symlink_to("/nowhere/usb")

    with pytest.raises(
        HelperRefusal, match=r"/usb: a link that leads nowhere \(/nowhere/usb\)"
    ) as it:
        facts.facts(VerbRequest(arguments={"root": str(tmp_path / root)}))

    assert "mount what it leads to" in it.value.advice


def test_unknown_owner_and_special_files_are_refused(tmp_path):
    with pytest.raises(HelperRefusal, match="there is no user 'nobody-here'"):
        replace_file(str(tmp_path / "a"), b"", {"owner": "nobody-here"})
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(HelperRefusal, match="expected a file"):
        replace_file(str(tmp_path / "pipe"), b"", {})

    assert os.listdir(tmp_path) == ["pipe"]


@pytest.mark.process
def test_long_command_gives_signs_of_life(tmp_path, monkeypatch):
    with Helper.start(connection_to(tmp_path), HELPER_PARTS) as board:
        asked = {"run": f"sleep 2.5; touch {tmp_path}/a", "creates": f"{tmp_path}/a"}
        pieces = [p.value for p in board.pieces("command", {**asked, "timeout_s": PATIENCE_S})]

    assert pieces[-1] == {"ran": True, "notes": []}
    assert pieces[:-1]
    assert all(piece == {"is_running": True} for piece in pieces[:-1])


@pytest.mark.process
def test_condition_of_a_command_finds_the_programs_that_the_command_finds(tmp_path, monkeypatch):
    """Such as sysctl and i2cdetect, which are on nobody's path but root's."""
    monkeypatch.setenv("PATH", os.defpath)
    unless = "case :$PATH: in *:/usr/sbin:*) ;; *) exit 1;; esac"
    asked = {"files": {}, "conditions": {"it": {"unless": unless, "root": False}}}

    with Helper.start(connection_to(tmp_path), HELPER_PARTS) as board:
        assert board.call("look", asked).value["conditions"] == {"it": True}


@pytest.mark.process
def test_slow_condition_of_a_command_gives_signs_of_life(tmp_path):
    """Before the command and after it; it has a minute, and who waits gives up sooner without a sign."""
    unless = f"sleep 1.5; test -e {tmp_path}/a"
    asked = {"run": f"touch {tmp_path}/a", "unless": unless, "timeout_s": PATIENCE_S}

    pieces = [piece.value for piece in system.command(VerbRequest(arguments=asked))]

    assert pieces[-1] == {"ran": True, "notes": []}
    assert pieces[:-1].count({"is_running": True}) == len(pieces) - 1 >= 2
    assert [p.value for p in system.command(VerbRequest(arguments=asked))][-1] == {"ran": False}


@pytest.mark.process
def test_condition_that_never_ends_is_told_as_such(monkeypatch):
    monkeypatch.setattr(facts, "CONDITION_TIMEOUT_S", 0.2)
    asked = {"run": "true", "unless": "sleep 60", "timeout_s": PATIENCE_S}

    with pytest.raises(HelperRefusal, match=r"unless: sleep 60: not done in 0.2 s"):
        list(system.command(VerbRequest(arguments=asked)))


@pytest.mark.process
def test_unit_whose_files_systemd_has_not_read_is_told(tmp_path, monkeypatch):
    (tmp_path / "systemctl").write_text(
        '#!/bin/sh\n[ "$4" = a.service ] && echo NeedDaemonReload=yes || echo NeedDaemonReload=no\n'
    )
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")

    told = facts.facts(VerbRequest(arguments={"units": ["a.service", "b.service"]}))

    assert told["stale_units"] == ["a.service"]


SYSTEMCTL = r"""#!/bin/sh
echo "$*" >> "$0.asked"
case "$1" in is-enabled) echo "$ENABLED" ;; is-active) echo "$ACTIVE" ;; esac
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("enabled", "active", "did"),
    [
        ("enabled", "active", ["disable", "stop"]),
        ("enabled", "inactive", ["disable"]),
        ("disabled", "active", ["stop"]),
        ("not-found", "inactive", []),
        ("", "", []),
    ],
)
def test_service_that_may_have_come_is_stopped_where_it_runs(
    tmp_path, monkeypatch, enabled, active, did
):
    """One that no package has brought cannot be: systemctl would fail."""
    systemctl = tmp_path / "systemctl"
    systemctl.write_text(SYSTEMCTL)
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setenv("ENABLED", enabled)
    monkeypatch.setenv("ACTIVE", active)
    asked = {"name": "a", "do": ["disable", "stop"], "reload": True, "may_be_new": True}

    *_, last = system.service(VerbRequest(arguments={**asked, "timeout_s": PATIENCE_S}))

    lines = Path(f"{systemctl}.asked").read_text().splitlines()
    assert last.value == {"did": did}
    assert [line for line in lines if not line.startswith("is-")] == [
        "daemon-reload",
        *(f"{word} a" for word in did),
    ]


@pytest.mark.process
def test_command_that_takes_too_long_is_ended_with_its_children(tmp_path):
    asked = {"run": f"sleep 1000 & echo $! > {tmp_path}/pid; wait", "creates": f"{tmp_path}/a"}
    with Helper.start(connection_to(tmp_path), HELPER_PARTS) as board:
        with pytest.raises(MachineFailure, match="not done in 4 s") as failure:
            list(board.pieces("command", {**asked, "timeout_s": 4}))
        pid = int((tmp_path / "pid").read_text())

        assert failure.value.kind is FailureKind.TIMEOUT
        wait_until(lambda: not is_alive(pid))


@pytest.mark.process
def test_command_whose_operator_is_gone_is_seen_through(tmp_path):
    done = tmp_path / "done"
    asked = {
        "run": f"while ! test -e {tmp_path}/go; do sleep 0.05; done; echo x > {done}",
        "creates": str(done),
        "timeout_s": PATIENCE_S,
    }
    board = Helper.start(connection_to(tmp_path), HELPER_PARTS)
    pieces = board.pieces("command", asked)
    assert next(pieces).value == {"is_running": True}

    board._stream.close_writing()
    board._stream._stdout.close()  # the connection is cut: nobody reads any more
    (tmp_path / "go").touch()

    wait_until(done.exists)
    board.close()


@pytest.mark.process
def test_output_is_kept_to_its_end(monkeypatch):
    (*_, last) = system.running(["/bin/sh", "-c", "seq 20; exit 3"], timeout_s=PATIENCE_S)

    assert last.value["exit_status"] == 3
    assert last.value["output"].splitlines() == [str(n) for n in range(11, 21)]
