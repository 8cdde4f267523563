"""Partial files in folders that others may write in: never through a link, never into another's file."""

import os
import shutil
import stat
import tempfile
from pathlib import Path

import pytest

from madns_runtime.partial_file import (
    SUFFIX,
    check_replaceable,
    create_partial,
    partial_file,
    write_whole,
)


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


def test_file_gets_its_name_when_it_is_whole(tmp_path):
    path = tmp_path / "a.json"
    with partial_file(path) as stream:
        stream.write(b"all")
        assert not path.exists()

    assert path.read_bytes() == b"all"
    assert os.listdir(tmp_path) == ["a.json"]


def test_file_that_fails_leaves_what_was(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"before")

    def fail():
        with partial_file(path) as stream:
            stream.write(b"half")
            raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        fail()
    assert path.read_bytes() == b"before"
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("takes_over", [False, True])
def test_link_under_the_foreseen_name_is_not_followed(tmp_path, takes_over):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    path = tmp_path / "shared" / "a"
    path.parent.mkdir()
    (path.parent / f".a{SUFFIX}").symlink_to(victim)

    with partial_file(path, takes_over=takes_over) as stream:
        stream.write(b"mine")

    assert victim.read_bytes() == b"precious"
    assert path.read_bytes() == b"mine"


def test_link_under_the_name_itself_is_replaced_and_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    (tmp_path / "a").symlink_to(victim)

    write_whole(tmp_path / "a", b"mine")

    assert victim.read_bytes() == b"precious"
    assert not (tmp_path / "a").is_symlink()


def test_devices_pipes_and_streams_are_no_place_for_a_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "null").symlink_to("/dev/null")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    (tmp_path / "file").touch()

    named = ["/dev/null", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"]
    for path in (*map(Path, named), tmp_path / "pipe", tmp_path / "null"):
        with pytest.raises(OSError, match="a device, a pipe or a stream, and no file"):
            check_replaceable(path)
    for name in ("file", "link", "new", "no/such/file"):
        check_replaceable(tmp_path / name)


def test_word_for_stdout_is_no_place_for_a_file(tmp_path):
    with pytest.raises(OSError, match="nothing goes to stdout; name a file"):
        check_replaceable(Path("-"))
    check_replaceable(tmp_path / "-")


@pytest.mark.parametrize("name", ["", ".", "..", "/"])
def test_folder_is_no_place_for_a_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)

    with pytest.raises(IsADirectoryError, match="it is a folder; name a file"):
        check_replaceable(Path(name))


def test_link_that_is_laid_again_and_again_is_evaded(tmp_path, monkeypatch):
    """Between removing what is in the way and making the file, somebody lays the link anew."""
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    foreseen = tmp_path / f".a{SUFFIX}"
    monkeypatch.setattr(type(foreseen), "unlink", lambda *_: None)
    foreseen.symlink_to(victim)

    partial, descriptor = create_partial(tmp_path / "a", takes_over=True)
    os.write(descriptor, b"mine")
    os.close(descriptor)

    assert partial != foreseen
    assert victim.read_bytes() == b"precious"


@pytest.fixture
def shared():
    """A folder such as /tmp: everybody may write there, and remove only what is one's own."""
    folder = Path(tempfile.mkdtemp(prefix="cosmos-shared-"))
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


def as_nobody(work):
    """Do *work* in a process of another user, and return its exit status."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            os.setgroups([])
            os.setresgid(65534, 65534, 65534)
            os.setresuid(65534, 65534, 65534)
            work()
            status = 0
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.process
def test_rest_of_another_user_in_a_sticky_folder_is_left_alone(shared):
    if os.geteuid() != 0:
        pytest.skip("only root can act for another user")
    rest = shared / f".a{SUFFIX}"
    rest.write_bytes(b"root's")

    def write():
        with partial_file(shared / "a", takes_over=True) as stream:
            stream.write(b"mine")

    assert as_nobody(write) == 0
    assert (shared / "a").read_bytes() == b"mine"
    assert rest.read_bytes() == b"root's"


def test_mode_is_the_one_that_is_asked_for_else_that_of_what_it_replaces(tmp_path):
    before = os.umask(0o077)
    try:
        write_whole(tmp_path / "a", b"", mode=0o644)
        write_whole(tmp_path / "a", b"again")
        write_whole(tmp_path / "b", b"")
    finally:
        os.umask(before)

    assert (mode(tmp_path / "a"), mode(tmp_path / "b")) == (0o644, 0o600)
