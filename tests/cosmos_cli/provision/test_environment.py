"""Virtual environments on a machine: whole or not there, built from wheels with nothing but Python."""

import contextlib
import dataclasses
import errno
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from made_wheels import House, make_runtime_wheels, make_wheel, only_index
from onboard_machine import OwnMachine, snapshot

import madns_runtime
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.onboard.environment import environment as build
from cosmos_cli.onboard.request_loop import VerbRequest
from cosmos_cli.provision import environment as module
from cosmos_cli.provision.environment import (
    RuntimeCheck,
    ask_installed,
    check_distribution,
    check_request,
    install_environment,
    installed_request,
    modules_of,
)
from cosmos_cli.provision.lock import Distributed
from cosmos_cli.provision.platform import greeted_platform
from cosmos_cli.provision.sent_wheels import sent_wheel
from cosmos_cli.provision.trees import runtime_tree, send_tree
from cosmos_cli.provision.wheelhouse import prepare
from cosmos_cli.provision.wheels import requirements_of

pytestmark = pytest.mark.process

REAL_PACKAGES = ("msgpack", "numpy", "orjson", "psutil")


@pytest.fixture
def machine(tmp_path):
    return OwnMachine(tmp_path / "root")


@pytest.fixture
def house(tmp_path, machine):
    with machine.board() as board:
        return House(tmp_path / "house", board.greeting)


@pytest.fixture
def navlib(tmp_path):
    """A wheel with all that a wheel may bring."""
    return make_wheel(
        tmp_path / "made",
        "nav-lib",
        "1.2",
        files={
            "nav_lib/data/table.bin": os.urandom(5000),
            "nav_lib-1.2.data/scripts/nav-tool": b"#!python\nimport nav_lib\nprint(nav_lib.version)\n",
            "nav_lib-1.2.data/data/share/nav/readme": b"hello",
            "nav_lib-1.2.data/headers/nav.h": b"//",
            "nav_lib-1.2.data/purelib/nav_extra.py": b"x = 1\n",
        },
        entry_points="[console_scripts]\nnav = nav_lib.main:Tool.run [extra]\n[other]\na = b:c\n",
    )


def install(machine, environment, **how):
    with machine.board(**how) as board:
        return install_environment(board, machine.layout, environment)


def python(machine, environment, program):
    """Run a program in an environment, with nothing else on its path."""
    done = subprocess.run(
        [machine.layout.python(environment.key), "-c", program],
        capture_output=True,
        text=True,
        env={},
        cwd="/",
        check=True,
    )
    return done.stdout.strip()


def started(board, layout, check):
    return board.call("check_runtime", check_request(layout, check), timeout_s=240.0).value


def is_whole(machine, environment, *, is_strict=False):
    with machine.board() as board:
        request = installed_request(
            machine.layout, trees=[], environments=[environment.key], is_strict=is_strict
        )
        return ask_installed(board, request).environments[environment.key]


def sent(environment):
    """Return the first wheel of an environment as machines are sent it."""
    wheel = environment.lock[0]
    return sent_wheel(environment.wheel(wheel), wheel, environment.platform)


def top_of(machine, environment):
    return Path(machine.layout.environment(environment.key))


def test_start_bears_a_finder_that_asks_for_a_path(machine, house, tmp_path):
    """As the one does that setuptools puts before all others."""
    finder = (
        b"class Finder:\n    def find_spec(self, name, path, target=None):\n        return None\n"
    )
    hack = {
        "first.pth": b"import first",
        "first.py": finder + b"import sys\nsys.meta_path.insert(0, Finder())\n",
    }
    environment = house.environment(make_wheel(tmp_path, "msgpack", "1.0", files=hack))
    install(machine, environment)
    runtime = runtime_tree()

    with machine.board() as board:
        send_tree(board, machine.layout, runtime)
        check = RuntimeCheck(
            key=environment.key, trees=[runtime.hash], depth="start", modules=["msgpack"]
        )
        told = started(board, machine.layout, check)

    assert told["runtime"] == madns_runtime.__version__


def test_wheel_that_brings_another_distribution_within_it_is_installed(machine, house, tmp_path):
    inner = b"Metadata-Version: 2.1\nName: inner\nVersion: 3\nRequires-Dist: not-wanted\n"
    vendored = {"setup_lib/_vendor/inner-3.dist-info/METADATA": inner}  # as setuptools does
    wheel = make_wheel(tmp_path, "setup-lib", "1.0", files=vendored)

    assert install(machine, house.environment(wheel))
    assert requirements_of(wheel) == []


def test_wheels_are_installed_as_the_specification_says(machine, house, navlib):
    environment = house.environment(navlib)

    assert install(machine, environment)

    top = top_of(machine, environment)
    assert (
        python(machine, environment, "import nav_lib, nav_extra; print(nav_lib.version)") == "1.2"
    )
    told = python(machine, environment, "import sys; print(sys.prefix)")
    assert told == str(top)
    version = "import importlib.metadata as m; print(m.version('nav-lib'), m.files('nav-lib')[0])"
    assert python(machine, environment, version).startswith("1.2 ")
    tool = subprocess.run([top / "bin/nav-tool"], capture_output=True, text=True, check=True)
    assert tool.stdout == "1.2\n"
    starter = (top / "bin/nav").read_text()
    assert f"#!{top}/bin/python\n" in starter and "from nav_lib.main import Tool\n" in starter
    assert (top / "share/nav/readme").read_text() == "hello"
    assert list(top.glob("include/site/*/nav_lib/nav.h"))


def test_record_lists_what_is_there(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)

    program = (
        "import importlib.metadata as m\n"
        "print([str(f) for f in m.files('nav-lib') if not f.locate().exists()])\n"
        "print(m.distribution('nav-lib').read_text('INSTALLER').strip())"
    )

    assert python(machine, environment, program) == "[]\ncosmos"


def test_second_time_nothing_is_sent_and_nothing_touched(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)
    before = snapshot(machine.root)
    machine.calls.clear()

    assert not install(machine, environment)

    assert [verb for verb, _, _ in machine.calls] == ["environment"]
    assert before == snapshot(machine.root)


def test_wheel_that_another_environment_brought_is_not_sent_again(machine, house, navlib, tmp_path):
    install(machine, house.environment(navlib))
    machine.calls.clear()
    other = make_wheel(tmp_path / "made", "other")

    install(machine, house.environment(navlib, other))

    sent = {given["filename"] for verb, given, _ in machine.calls if verb == "wheel"}
    assert sent == {other.name}


def test_connection_cut_at_every_frame_is_repaired_by_the_next_call(
    machine, house, tmp_path, monkeypatch
):
    monkeypatch.setattr(module, "PIECE_BYTES", 4000)
    cuts = 0
    for steps in range(100):
        wheel = make_wheel(tmp_path / f"m{steps}", "bulk", files={"bulk/x": os.urandom(9000)})
        environment = house.environment(wheel)
        try:
            install(machine, environment, cut_after=steps)
            break
        except MachineFailure as failure:
            assert failure.kind is FailureKind.LOST
        cuts += 1
        install(machine, environment)
        assert is_whole(machine, environment)
        assert python(machine, environment, "import bulk; print(bulk.version)") == "99.0"

    assert cuts >= 10  # two questions and three pieces, and the answer to each


def test_cut_transfer_of_a_wheel_is_resumed(machine, house, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PIECE_BYTES", 4000)
    wheel = make_wheel(tmp_path / "made", "bulk", files={"bulk/x": os.urandom(20_000)})
    environment = house.environment(wheel)
    with pytest.raises(MachineFailure):
        install(machine, environment, cut_after=8)
    machine.calls.clear()

    install(machine, environment)

    sent_bytes = sum(size for verb, _, size in machine.calls if verb == "wheel")
    assert 0 < sent_bytes < wheel.stat().st_size - 4000


def test_wheel_is_sent_anew_where_what_came_before_is_not_its_beginning(machine, house, tmp_path):
    """As a power cut may leave it: a length without the bytes."""
    wheel = make_wheel(tmp_path / "made", "bulk", files={"bulk/x": os.urandom(20_000)})
    environment = house.environment(wheel)
    (locked,) = environment.lock
    sent = sent_wheel(environment.wheel(locked), locked, environment.platform).locked
    partial = Path(machine.layout.wheels, f".{sent.sha256}.part")
    partial.parent.mkdir(parents=True)
    partial.write_bytes(bytes(sent.size_bytes // 2))

    assert install(machine, environment)

    offsets = [given["offset"] for verb, given, _ in machine.calls if verb == "wheel"]
    assert offsets == [sent.size_bytes // 2, 0]
    assert is_whole(machine, environment)


def test_helper_killed_at_any_moment_leaves_nothing_half(machine, house, tmp_path):
    files = {f"bulk/m{index}.py": os.urandom(2000) for index in range(150)}
    killed = 0
    for delay_ms in (0, 10, 20, 35, 60, 100):
        wheel = make_wheel(tmp_path / f"m{delay_ms}", "bulk", f"{delay_ms}.0", files=files)
        environment = house.environment(wheel)
        with contextlib.suppress(MachineFailure), machine.board() as board:
            killer = threading.Timer(delay_ms / 1000, machine.kill, [board])
            killer.start()
            try:
                install_environment(board, machine.layout, environment)
            finally:
                killer.join()
        killed += not is_whole(machine, environment)
        install(machine, environment)
        assert is_whole(machine, environment)
        assert python(machine, environment, "import bulk; print(bulk.version)") == f"{delay_ms}.0"

    assert killed


@pytest.mark.parametrize("harm", ["byte", "mode", "gone", "added", "mark", "python", "half-built"])
def test_damage_is_noticed_and_the_environment_built_anew(machine, house, navlib, harm):
    environment = house.environment(navlib)
    install(machine, environment)
    assert is_whole(machine, environment)
    top = top_of(machine, environment)
    file = next(top.rglob("nav_lib/__init__.py"))
    match harm:
        case "byte":
            file.write_text(file.read_text().replace("1.2", "1.3"))
        case "mode":
            file.chmod(0o600)
        case "gone":
            file.unlink()
        case "added":
            (top / "lib/other.pth").write_text("import nothing\n")
        case "mark" | "half-built":
            (top / ".complete").unlink()
        case "python":
            (top / "bin/python").unlink()
            (top / "bin/python").symlink_to("/usr/bin/python2.7")

    assert not is_whole(machine, environment, is_strict=True)
    assert is_whole(machine, environment) == (harm == "added")
    assert install(machine, environment)
    assert is_whole(machine, environment, is_strict=True)
    assert python(machine, environment, "import nav_lib; print(nav_lib.version)") == "1.2"


@contextlib.contextmanager
def living_run(machine, environment):
    """A process of an environment that waits for a line: it has begun, so that the kernel tells what it runs."""
    command = [machine.layout.python(environment.key), "-c", "input('begun')"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdout.read(len("begun")) == b"begun"
        yield process


def test_what_a_package_adds_for_itself_holds_up_no_run(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)
    python(machine, environment, "import nav_lib")
    # Its headers stand in a folder of that name, too.
    site = next(top_of(machine, environment).rglob("nav_lib/__init__.py")).parent
    (site / "__pycache__/numba.nbi").write_bytes(b"x")
    with_compiled = is_whole(machine, environment, is_strict=True)
    (site / "cache.bin").write_bytes(b"x")
    with living_run(machine, environment) as process:
        under_a_run = is_whole(machine, environment, is_strict=True)
        process.communicate(b"\n", timeout=120)

    assert with_compiled
    assert under_a_run
    assert is_whole(machine, environment)


def test_modules_come_compiled_and_a_change_of_what_is_compiled_is_found(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)
    compiled = next(
        top_of(machine, environment).rglob(f"__init__.{sys.implementation.cache_tag}.pyc")
    )
    told = python(machine, environment, "import nav_lib; print(nav_lib.__cached__)")
    has_come = compiled.read_bytes()
    compiled.write_bytes(has_come[:-1] + b"?")

    assert told == str(compiled)
    assert has_come[4] == 1  # taken without a look at the source: PEP 552
    assert not is_whole(machine, environment)


def test_damaged_environment_of_a_living_run_is_left_alone(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)
    with living_run(machine, environment) as process:
        file = next(top_of(machine, environment).rglob("nav_lib/__init__.py"))
        file.write_text("")
        before = snapshot(top_of(machine, environment))
        with pytest.raises(MachineFailure, match="a run uses it") as caught:
            install(machine, environment)
        process.communicate(b"\n", timeout=120)

    assert caught.value.kind is FailureKind.BUSY
    assert "cosmos down" in caught.value.advice
    assert before == snapshot(top_of(machine, environment))
    assert install(machine, environment)


def test_wheel_changed_on_the_machine_is_sent_again(machine, house, navlib, tmp_path):
    install(machine, house.environment(navlib))
    kept = next(Path(machine.layout.wheels).rglob("nav_lib/__init__.py"))
    kept.write_text("version = 0\n")
    other = house.environment(navlib, make_wheel(tmp_path / "made", "other"))

    assert install(machine, other)
    assert python(machine, other, "import nav_lib; print(nav_lib.version)") == "1.2"


def test_wheel_that_rots_in_the_operators_cache_is_thrown_away(machine, house, navlib):
    environment = house.environment(navlib)
    path = environment.wheel(environment.lock[0])
    path.write_bytes(path.read_bytes()[:-1] + b"!")

    with pytest.raises(MachineFailure, match="is not what was downloaded; it was removed"):
        install(machine, environment)
    assert not path.exists()
    assert not any(verb == "wheel" for verb, _, _ in machine.calls)


def test_wheel_that_another_command_cleared_away_is_told_as_gone(machine, house, navlib):
    environment = house.environment(navlib)
    environment.wheel(environment.lock[0]).unlink()

    with pytest.raises(MachineFailure, match="is gone: another command") as failed:
        install(machine, environment)
    assert failed.value.advice == "repeat: it is downloaded again"


def test_wheel_that_changed_on_its_way_is_refused(machine, house, navlib, monkeypatch):
    environment = house.environment(navlib)
    monkeypatch.setattr(module, "see_verified", lambda *_: None)
    path = sent(environment).path
    path.write_bytes(path.read_bytes()[:-1] + b"!")

    with pytest.raises(MachineFailure, match="not what was announced"):
        install(machine, environment)
    assert not top_of(machine, environment).exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"record": {"bad/__init__.py": "sha256=AAAA"}}, "is not what RECORD says"),
        ({"record": {"bad/__init__.py": ""}}, "has no hash in RECORD"),
        ({"record": {"bad/__init__.py": "md5=AAAA"}}, "has no hash in RECORD"),
        ({"files": {"../../evil.py": b"x"}}, "leads out of its folder"),
        ({"files": {"/tmp/evil.py": b"x"}}, "leads out of its folder"),
        ({"files": {".complete": b"x"}}, "leads out of its folder"),
        ({"files": {"bad-1.0.data/nowhere/x": b"x"}}, "belongs into no known folder"),
        ({"files": {"bad-1.0.data/x": b"x"}}, "belongs into no known folder"),
        ({"files": {"other-1.0.dist-info/METADATA": b"x"}}, "expected one folder"),
        ({"wheel_version": "2.0"}, "expected Wheel-Version 1"),
        ({"entry_points": "[console_scripts]\nx = os;rm:run\n"}, "no entry point"),
        ({"entry_points": "[console_scripts]\n../x = os:run\n"}, "no entry point"),
    ],
)
def test_wheel_that_breaks_the_specification_is_refused(machine, house, tmp_path, changes, said):
    environment = house.environment(make_wheel(tmp_path / "made", "bad", "1.0", **changes))

    with pytest.raises(MachineFailure, match=said) as caught:
        install(machine, environment)

    assert caught.value.kind is FailureKind.DATA
    assert "bad-1.0" in caught.value.text
    assert not is_whole(machine, environment)


def test_other_python_than_the_environment_is_for_is_refused(machine, house, navlib):
    platform = dataclasses.replace(house.platform, python=(3, 99))
    environment = house.environment(navlib, platform=platform)

    with pytest.raises(MachineFailure, match="expected Python"):
        install(machine, environment)


def test_systems_packages_are_seen_only_when_wanted(machine, house, navlib):
    own, open_ = house.environment(navlib), house.environment(navlib, sees_system=True)
    install(machine, own)
    install(machine, open_)

    for environment, word in ((own, "false"), (open_, "true")):
        settings = (top_of(machine, environment) / "pyvenv.cfg").read_text()
        assert f"include-system-site-packages = {word}\n" in settings


@pytest.fixture
def distribution(tmp_path, monkeypatch):
    """What the machine's distribution has: numpy 1.19, and no msgpack."""
    folder = tmp_path / "system"
    info = folder / "numpy-1.19.5.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: numpy\nVersion: 1.19.5\n")
    monkeypatch.setenv("PYTHONPATH", str(folder))


def test_distribution_that_lacks_or_is_too_old_is_told_by_name(
    machine, house, navlib, distribution
):
    environment = house.environment(
        navlib,
        sees_system=True,
        distributed=(
            Distributed(name="numpy", package="python3-numpy", specifier=">=1.24"),
            Distributed(name="nosuchthing", package="python3-nosuchthing", specifier=">=1.0"),
        ),
    )

    with pytest.raises(MachineFailure) as caught:
        install(machine, environment)

    assert "python3-numpy brings numpy 1.19.5, needed: numpy>=1.24" in caught.value.text
    assert "python3-nosuchthing is not installed (needed: nosuchthing>=1.0)" in caught.value.text
    assert "apt-get install python3-nosuchthing" in caught.value.advice
    assert not top_of(machine, environment).exists()


def test_distribution_that_is_new_enough_is_taken(machine, house, navlib, distribution):
    numpy = Distributed(name="numpy", package="python3-numpy", specifier=">=1.19,<2")
    environment = house.environment(navlib, sees_system=True, distributed=(numpy,))

    with machine.board() as board:
        check_distribution(board, environment)
    assert install(machine, environment)


def test_environments_share_the_files_of_their_wheels(machine, house, navlib, tmp_path):
    first = house.environment(navlib)
    second = house.environment(navlib, make_wheel(tmp_path / "made", "other"))
    install(machine, first)
    install(machine, second)

    inodes = {path.stat().st_ino for path in Path(machine.root).rglob("table.bin")}
    assert len(inodes) == 1


def test_disk_without_links_gets_copies(machine, house, navlib, monkeypatch):
    calls = []

    def refuse(source, target):
        calls.append(target)
        raise PermissionError(errno.EPERM, "no links here", target)

    monkeypatch.setattr(os, "link", refuse)
    environment = house.environment(navlib)
    install(machine, environment)
    given = next(given for verb, given, _ in machine.calls if verb == "environment")
    shutil.rmtree(top_of(machine, environment))

    build(VerbRequest(arguments=given, body=b""))

    assert calls
    assert is_whole(machine, environment)


def test_disk_without_links_takes_a_file_that_two_wheels_bring(
    machine, house, tmp_path, monkeypatch
):
    def refuse(source, target):  # as Linux does, which looks at the name first
        number = errno.EEXIST if os.path.lexists(target) else errno.EXDEV
        raise OSError(number, os.strerror(number), target)

    environment = house.environment(
        make_wheel(tmp_path / "made", "first", files={"shared/note.txt": b"of the first"}),
        make_wheel(tmp_path / "made", "second", files={"shared/note.txt": b"of the second"}),
    )
    install(machine, environment)
    given = next(given for verb, given, _ in machine.calls if verb == "environment")
    shutil.rmtree(top_of(machine, environment))
    monkeypatch.setattr(os, "link", refuse)

    build(VerbRequest(arguments=given, body=b""))

    (note,) = top_of(machine, environment).rglob("note.txt")
    assert note.read_bytes() == b"of the second"
    assert is_whole(machine, environment)


def test_prune_spares_the_wanted_the_newest_and_the_used(machine, house, tmp_path):
    environments = []
    for index in range(6):
        wheel = make_wheel(tmp_path / "made", "each", f"{index}.0")
        environments.append(house.environment(wheel))
        install(machine, environments[-1])
        mark = top_of(machine, environments[-1]) / ".complete"
        os.utime(mark, (1000 + index, 1000 + index))
        compiled = Path(f"{machine.layout.compiled}{top_of(machine, environments[-1])}/lib/a.pyc")
        compiled.parent.mkdir(parents=True)
        compiled.touch()
    wanted, used = environments[0], environments[1]
    request = installed_request(machine.layout, trees=[], environments=[wanted.key])
    with living_run(machine, used) as process:
        with machine.board() as board:
            foretold = ask_installed(board, request).prunable
            removed = board.call("prune_installed", request).value
            left = ask_installed(board, request)
        process.communicate(b"\n", timeout=120)

    gone = {environments[2].key, environments[3].key}
    assert set(removed["environments"]) == set(foretold["environments"]) == gone
    assert not any(left.prunable.values())
    assert {path.name for path in Path(machine.layout.environments).iterdir()} == {
        environment.key for environment in environments
    } - gone
    compiled = Path(f"{machine.layout.compiled}{machine.layout.environments}")
    assert {path.name for path in compiled.iterdir()} == {e.key for e in environments} - gone
    kept = {path.name for path in Path(machine.layout.wheels).iterdir()}
    assert {sent(e).locked.sha256 for e in environments if e.key not in gone} == kept


def test_what_a_run_asked_for_is_among_the_newest(machine, house, tmp_path):
    environments = []
    for index in range(3):
        environments.append(house.environment(make_wheel(tmp_path / "made", "each", f"{index}.0")))
        install(machine, environments[-1])
        os.utime(top_of(machine, environments[-1]) / ".complete", (1000 + index, 1000 + index))
    first = environments[0].key
    with machine.board() as board:
        asked = installed_request(machine.layout, trees=[], environments=[first], touch=True)
        ask_installed(board, asked)
        nothing = installed_request(machine.layout, trees=[], environments=[])

        assert first not in board.call("prune_installed", nothing).value["environments"]


def test_full_disk_leaves_no_half_built_environment(machine, house, navlib, tmp_path, monkeypatch):
    """A limit on the size of files stands for the disk; the real thing is tried on virtual boards."""
    wheel = make_wheel(tmp_path / "made", "bulk", files={"bulk/x": bytes(3_000_000)})
    environment = house.environment(wheel)

    class Limited(OwnMachine):
        def open(self, command):
            return super().open(f"ulimit -f 1000; trap '' XFSZ; {command}")

    with pytest.raises(MachineFailure):
        install(Limited(machine.root), environment)
    assert not top_of(machine, environment).exists()
    assert install(machine, environment)


def test_runtime_runs_from_its_environment_and_tree_alone(machine, tmp_path, monkeypatch):
    """What an agent imports is imported from what was sent, and from nowhere else."""
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "cache"))
    runtime = runtime_tree()
    with machine.board() as board:
        environment = prepare(greeted_platform(board.greeting), [])
        install_environment(board, machine.layout, environment)
        send_tree(board, machine.layout, runtime)
        check = RuntimeCheck(
            key=environment.key,
            trees=[runtime.hash],
            depth="full",
            modules=modules_of(environment),
            simulation="constellation",
        )
        told = started(board, machine.layout, check)
        others = [
            started(board, machine.layout, dataclasses.replace(check, depth=depth))
            for depth in ("start", "look")
        ]
    program = (
        "import madns_runtime.agent, numpy, sys\n"
        "print(sorted({m.__file__.split('/lib/')[0] for m in sys.modules.values()\n"
        "    if getattr(m, '__file__', None) and ('numpy' in m.__name__ or 'madns' in m.__name__)}))\n"
        "print([p for p in sys.path if 'site-packages' in p or 'dist-packages' in p])\n"
    )
    done = subprocess.run(
        [machine.layout.python(environment.key), "-c", program],
        env={"PYTHONPATH": machine.layout.tree(runtime.hash)},
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )

    assert {told["runtime"]} == {each["runtime"] for each in others} == {madns_runtime.__version__}
    top = machine.layout.environment(environment.key)
    folder = f"lib/python{environment.platform.python_text}/site-packages"
    assert f"{[f'{top}/{folder}']}" == done.stdout.splitlines()[1]
    assert sys.prefix not in done.stdout
    assert set(REAL_PACKAGES) < set(modules_of(environment))


def test_runtime_that_does_not_start_is_told_with_its_last_words(machine, house, navlib):
    environment = house.environment(navlib)
    install(machine, environment)
    check = RuntimeCheck(key=environment.key, trees=["0" * 64], depth="start")

    with machine.board() as board, pytest.raises(MachineFailure) as caught:
        started(board, machine.layout, check)

    assert "the runtime does not start there" in caught.value.text
    assert "No module named 'madns_runtime'" in caught.value.text


@pytest.mark.parametrize("depth", ["look", "start"])
def test_missing_module_is_named_by_the_light_check(machine, house, navlib, depth):
    environment, runtime = house.environment(navlib), runtime_tree()
    install(machine, environment)
    check = RuntimeCheck(
        key=environment.key, trees=[runtime.hash], depth=depth, modules=("nav_lib", "numpy")
    )

    with machine.board() as board, pytest.raises(MachineFailure, match="no module named numpy$"):
        send_tree(board, machine.layout, runtime)
        started(board, machine.layout, check)


def test_prepared_environment_installs(machine, tmp_path, monkeypatch):
    with machine.board() as board:
        platform = greeted_platform(board.greeting)
    python_digits = "".join(map(str, platform.python))
    make_runtime_wheels(tmp_path / "index", python_digits, machines=[platform.machine])
    only_index(monkeypatch, tmp_path, tmp_path / "index")

    environment = prepare(platform, [])

    assert install(machine, environment)
    assert python(machine, environment, "import numpy; print(numpy.version)") == "99.0"
