"""Environments are resolved and fetched on the operator's machine, from any index, once."""

import errno
import json
import os
import subprocess
import sys
import tempfile
import threading
import time

import pytest
from made_wheels import make_runtime_wheels, make_source, make_wheel, only_index

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.provision import resolver, wheelhouse
from cosmos_cli.provision.lock import Distributed
from cosmos_cli.provision.platform import Platform
from cosmos_cli.provision.resolver import index_lines, pip_environment, uv_environment
from cosmos_cli.provision.wheelhouse import (
    EnvironmentNeed,
    environment_key,
    prepare,
    sees_system_packages,
)
from cosmos_cli.provision.wheels import remove_unused, requirements_of

pytestmark = pytest.mark.process

PI = Platform(python=(3, 11), machine="aarch64", libc_version=(2, 36))
LAPTOP = Platform(python=(3, 13), machine="x86_64", libc_version=(2, 41))
OLD_PI = Platform(python=(3, 11), machine="armv7l", libc_version=(2, 36))


@pytest.fixture
def index(tmp_path, monkeypatch):
    """A folder of wheels that is the only index."""
    folder = tmp_path / "index"
    make_runtime_wheels(folder, "311", "313")
    only_index(monkeypatch, tmp_path, folder)
    monkeypatch.setattr(wheelhouse, "_failures", {})
    return folder


@pytest.fixture
def no_process(monkeypatch):
    """Start counting here: nothing may be started any more."""

    def forbid():
        def refuse(*arguments, **_):
            raise AssertionError(f"a process was started: {arguments}")

        monkeypatch.setattr(subprocess, "run", refuse)

    return forbid


def filenames(environment):
    return {wheel.filename for wheel in environment.lock}


@pytest.mark.parametrize("platform", [PI, LAPTOP])
def test_wheels_for_a_foreign_machine_are_here_and_verified(index, platform):
    environment = prepare(platform, [])

    assert {"annotated-types", "msgpack", "numpy", "orjson", "psutil"} == {
        wheel.name for wheel in environment.lock
    }
    for wheel in environment.lock:
        assert environment.wheel(wheel).read_bytes() == (index / wheel.filename).read_bytes()
        assert environment.wheel(wheel).stat().st_size == wheel.size_bytes
        assert platform.machine in wheel.filename or "none-any" in wheel.filename
    assert environment.size_bytes() > sum(wheel.size_bytes for wheel in environment.lock)
    numpy = next(wheel for wheel in environment.lock if wheel.name == "numpy")
    spared = environment.size_bytes() - environment.size_bytes({f"numpy-{numpy.version}.dist-info"})
    assert spared == numpy.size_bytes + numpy.installed_bytes > 0


def test_second_call_starts_no_process_and_needs_no_index(index, no_process):
    make_wheel(index, "pyproj")
    first = prepare(PI, ["pyproj>=3"])
    for wheel in index.iterdir():
        wheel.unlink()
    no_process()

    assert first == prepare(PI, ["pyproj>=3"])
    assert first == prepare(PI, [" pyproj>=3", "pyproj>=3"])


def test_same_content_has_the_same_key_wherever_it_was_resolved(index, tmp_path, monkeypatch):
    first = prepare(PI, [])
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "another"))

    assert first.key == prepare(PI, []).key


def test_requirements_of_scenario_and_machine_are_part_of_it(index):
    make_wheel(index, "navlib", requires=["geolib>=2"])
    make_wheel(index, "geolib", "2.1")
    make_wheel(index, "geolib", "1.9")

    environment = prepare(PI, ["navlib"])

    assert {"navlib-99.0-py3-none-any.whl", "geolib-2.1-py3-none-any.whl"} <= filenames(environment)
    assert environment.key != prepare(PI, []).key


def test_host_machine_gets_what_the_truth_needs(index):
    for name in ("scipy", "sgp4"):
        make_wheel(index, name)

    assert {"scipy-99.0-py3-none-any.whl", "sgp4-99.0-py3-none-any.whl"} <= filenames(
        prepare(PI, [], is_host=True)
    )
    assert "scipy-99.0-py3-none-any.whl" not in filenames(prepare(PI, []))


def test_wheel_that_left_the_cache_is_fetched_again(index):
    environment = prepare(PI, [])
    environment.wheel(environment.lock[0]).unlink()

    again = prepare(PI, [])

    assert environment == again
    assert again.wheel(again.lock[0]).exists()


def test_lost_wheels_are_fetched_as_they_were_locked_though_newer_ones_exist(index):
    make_wheel(index, "pyproj", "3.0")
    first = prepare(PI, ["pyproj"])
    make_wheel(index, "pyproj", "4.0")
    for wheel in first.lock:
        first.wheel(wheel).unlink()

    again = prepare(PI, ["pyproj"])

    assert again == first
    assert all(again.wheel(wheel).exists() for wheel in again.lock)


def age(environment_or_path, days):
    """Let a path look as if nobody had used it for so long."""
    then_s = time.clock_gettime(time.CLOCK_REALTIME) - days * 86_400
    os.utime(environment_or_path, (then_s, then_s))


@pytest.mark.nightly
def test_cache_forgets_what_was_not_used_for_long_when_something_new_comes(index, tmp_path):
    locks, wheels = tmp_path / "cache/locks", tmp_path / "cache/wheels"
    make_wheel(index, "pyproj")
    old = prepare(PI, ["pyproj"])
    used = prepare(LAPTOP, [])
    for path in (*locks.iterdir(), *wheels.iterdir()):
        age(path, 91)
    (wheels / ".new-cut-off").mkdir()
    age(wheels / ".new-cut-off", 2)
    (wheels / ".new-of-somebody").mkdir()
    assert environment_key(EnvironmentNeed.of(LAPTOP, [])) == used.key

    new = prepare(PI, [])

    needed = {wheel.sha256 for environment in (used, new) for wheel in environment.lock}
    assert {path.name for path in wheels.iterdir()} == {*needed, ".new-of-somebody"}
    assert len(list(locks.glob("*.json"))) == 2
    assert prepare(PI, ["pyproj"]).key == old.key


@pytest.mark.nightly
def test_wheels_that_a_new_environment_takes_from_the_cache_are_kept_while_it_is_made(
    index, tmp_path, monkeypatch
):
    wheels = tmp_path / "cache/wheels"
    make_wheel(index, "pyproj")
    prepare(PI, ["pyproj"])
    for path in (tmp_path / "cache/locks").glob("*"):
        path.unlink()
    for path in wheels.iterdir():
        age(path, 91)

    def clear_as_another_command(path):
        remove_unused(tmp_path / "cache", now_s=time.clock_gettime(time.CLOCK_REALTIME))
        return requirements_of(path)

    monkeypatch.setattr(wheelhouse, "requirements_of", clear_as_another_command)
    again = prepare(PI, ["pyproj"])

    assert all(again.wheel(wheel).is_file() for wheel in again.lock)


def test_cache_that_cannot_be_written_is_told_as_this_computers_fault(index, tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path / "taken"))
    (tmp_path / "taken").touch()

    with pytest.raises(
        MachineFailure, match="cache of this computer.*taken.*COSMOS_CACHE"
    ) as failed:
        prepare(PI, [])

    assert failed.value.kind is FailureKind.STEP


def test_full_disk_under_the_cache_is_told_as_this_computers_fault(index, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(wheelhouse, "write_whole", refuse)

    with pytest.raises(MachineFailure, match="cache of this computer.*No space left"):
        prepare(PI, [])


@pytest.mark.parametrize(
    ("program", "said"),
    [
        (
            "uv",
            "error: Failed to initialize cache at `/c`\n"
            "  cause: failed to write to file `/c/CACHEDIR.TAG`: No space left on device (os error 28)",
        ),
        (
            "pip",
            "Traceback (most recent call last):\n  File a, in b\n"
            "OSError: [Errno 28] No space left on device: '/c/a.whl'\n",
        ),
    ],
)
def test_program_that_finds_the_disk_of_this_computer_full_is_told_so(
    index, monkeypatch, program, said
):
    run = resolver._run

    def run_on_a_full_disk(command, **how):
        is_full = ("download" in command) is (program == "pip")
        return subprocess.CompletedProcess(command, 2, "", said) if is_full else run(command, **how)

    monkeypatch.setattr(resolver, "_run", run_on_a_full_disk)
    with pytest.raises(MachineFailure) as caught:
        prepare(PI, [])

    assert caught.value.kind is FailureKind.DISK_FULL
    assert caught.value.text.startswith("no room on this computer")
    assert caught.value.text.endswith(said.splitlines()[-1].strip())
    assert "COSMOS_CACHE" in caught.value.advice


def test_key_needs_no_wheels(index, no_process):
    first = prepare(PI, [])
    for wheel in first.lock:
        first.wheel(wheel).unlink()
    no_process()

    assert environment_key(EnvironmentNeed.of(PI, [])) == first.key


def test_key_of_what_was_never_prepared_is_found_out(index):
    assert environment_key(EnvironmentNeed.of(PI, [])) == prepare(PI, []).key


def test_index_that_gives_something_else_than_it_announced_is_found_out(index, monkeypatch):
    download = resolver.download

    def swap(chosen, folder, platform):
        download(chosen, folder, platform)
        (folder / chosen[0].locked.filename).write_bytes(b"something else")

    monkeypatch.setattr(resolver, "download", swap)

    failure = refused(PI, [])

    assert failure.kind is FailureKind.DATA
    assert "not what it announced" in failure.text


def test_newer_release_changes_nothing_that_is_locked(index):
    make_wheel(index, "pyproj", "3.0")
    first = prepare(PI, ["pyproj"])
    make_wheel(index, "pyproj", "4.0")

    assert first.key == prepare(PI, ["pyproj"]).key


def test_many_threads_resolve_once(index, monkeypatch):
    calls = []
    resolve = resolver.resolve
    monkeypatch.setattr(resolver, "resolve", lambda *given: calls.append(1) or resolve(*given))
    found = []
    threads = [threading.Thread(target=lambda: found.append(prepare(PI, []))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)

    assert len(found) == 8 and len(set(found)) == 1
    assert calls == [1]


def test_many_processes_share_one_cache(index):
    program = (
        "from cosmos_cli.provision.platform import Platform\n"
        "from cosmos_cli.provision.wheelhouse import prepare\n"
        "p = Platform(python=(3, 11), machine='aarch64', libc_version=(2, 36))\n"
        "print(prepare(p, []).key)\n"
    )
    started = [
        subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) for _ in range(3)
    ]
    keys = {process.communicate(timeout=120)[0] for process in started}

    assert {f"{prepare(PI, []).key}\n".encode()} == keys


def refused(platform, requirements):
    with pytest.raises(MachineFailure) as caught:
        prepare(platform, requirements)
    return caught.value


def test_requirement_without_any_wheel_is_named_with_what_to_do(index):
    make_source(index, "RPi.GPIO", "0.7.1")

    failure = refused(PI, ["RPi.GPIO>=0.7"])

    assert FailureKind.UNSUPPORTED is failure.kind
    assert failure.text == "RPi.GPIO: no wheel for Python 3.11 on aarch64 (glibc 2.36)"
    assert "python3-rpi.gpio under cosmos_packages" in failure.advice


def test_requirement_with_wheels_for_other_machines_only_is_named(index):
    make_wheel(index, "camera", tag="cp311-cp311-manylinux_2_17_x86_64")

    failure = refused(PI, ["camera"])

    assert failure.text == "camera: no wheel for Python 3.11 on aarch64 (glibc 2.36)"


def test_ancient_version_is_not_taken_silently(index):
    make_wheel(index, "lgpio", "0.0.0.2")
    make_source(index, "lgpio", "0.2.2.0")

    failure = refused(PI, ["lgpio"])

    assert failure.text == "lgpio: 0.2.2.0 has no wheel for Python 3.11 on aarch64 (glibc 2.36)"
    assert "lgpio==0.0.0.2" in failure.advice
    assert "python3-lgpio" in failure.advice


@pytest.mark.parametrize("requirement", ["lgpio==0.0.0.2", "lgpio<0.2"])
def test_older_version_is_taken_when_it_is_asked_for(index, requirement):
    make_wheel(index, "lgpio", "0.0.0.2")
    make_source(index, "lgpio", "0.2.2.0")

    assert "lgpio-0.0.0.2-py3-none-any.whl" in filenames(prepare(PI, [requirement]))


def test_computer_without_room_for_a_temporary_file_is_told_as_such(index, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: ["/proc", "/sys"])

    failure = refused(PI, [])

    assert failure.kind is FailureKind.DISK_FULL
    assert "no room on this computer" in failure.text
    assert "TMPDIR" in failure.advice


def test_project_of_the_present_folder_decides_on_no_version(index, tmp_path, monkeypatch):
    """What is resolved is remembered for all folders, whatever a pyproject.toml for uv says in one."""
    make_wheel(index, "pyproj", "3.0")
    make_wheel(index, "pyproj", "4.0")
    project = tmp_path / "project"
    (project / "inner").mkdir(parents=True)
    (project / "pyproject.toml").write_text(
        '[project]\nname = "own"\nversion = "1"\n[tool.uv]\noverride-dependencies = ["pyproj<4"]\n'
    )
    monkeypatch.chdir(project / "inner")

    assert "pyproj-4.0-py3-none-any.whl" in filenames(prepare(PI, ["pyproj"]))


def test_unknown_package_and_conflict_are_told_in_the_resolvers_words(index):
    make_wheel(index, "pyproj", "3.0")

    assert "nosuchthing" in refused(PI, ["nosuchthing"]).text
    assert "pyproj>=4" in refused(PI, ["pyproj>=4"]).text


@pytest.mark.parametrize(
    "text", ["./wheels/own.whl", "own @ https://user:word@files.example/own.whl", ">=3"]
)
def test_what_is_no_requirement_is_refused_without_repeating_passwords(index, text):
    failure = refused(PI, [text])

    assert "expected a name and versions" in failure.text
    assert "word" not in str(failure)


def test_cold_cache_without_an_index_is_said_clearly(index, monkeypatch):
    for name in ("PIP_NO_INDEX", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_INDEX_URL", "http://me:secret@127.0.0.1:9/simple")
    monkeypatch.setenv("UV_HTTP_RETRIES", "0")

    failure = refused(PI, [])

    assert FailureKind.STEP is failure.kind
    assert "this computer cannot reach the package index" in failure.text
    assert "secret" not in str(failure)
    assert "internet" in failure.advice


def test_failure_is_remembered_for_the_other_machines_of_a_command(index, no_process):
    first = refused(PI, ["nosuchthing"])
    no_process()

    assert first is refused(PI, ["nosuchthing"])


@pytest.mark.nightly
def test_32_bit_arm_takes_from_its_distribution_what_has_no_wheel(index):
    make_wheel(index, "orjson", tag="cp311-cp311-manylinux_2_17_armv7l")
    make_wheel(index, "navlib", requires=["numpy>=1.20"])

    environment = prepare(OLD_PI, ["navlib"])

    assert environment.distribution_packages == (
        "python3-msgpack",
        "python3-numpy",
        "python3-psutil",
    )
    assert {"annotated-types", "navlib", "orjson"} == {wheel.name for wheel in environment.lock}
    assert environment.content.sees_system
    numpy = environment.content.distributed[1]
    assert isinstance(numpy, Distributed) and ">=1.20" in numpy.specifier


def test_32_bit_arm_names_what_no_distribution_brings_either(index):
    make_wheel(index, "orjson", tag="cp311-cp311-manylinux_2_17_armv7l")
    make_wheel(index, "fastnav", tag="cp311-cp311-manylinux_2_17_x86_64")

    failure = refused(OLD_PI, ["fastnav"])

    assert failure.text.startswith("fastnav: ")
    assert "armv7l" in failure.text


def test_environment_sees_the_systems_packages_when_the_inventory_names_some():
    assert sees_system_packages(["i2c-tools", "python3-rtimulib"])
    assert not sees_system_packages(["i2c-tools"])


def test_seeing_the_system_makes_another_environment(index):
    assert prepare(PI, []).key != prepare(PI, [], sees_system=True).key


def test_broken_memory_is_made_anew(index, tmp_path):
    first = prepare(PI, [])
    (lock,) = (tmp_path / "cache/locks").glob("*.json")
    lock.write_text(json.dumps({"wheels": 3}))

    assert first == prepare(PI, [])


def test_nothing_of_an_index_password_is_kept(index, tmp_path):
    make_wheel(index, "pyproj")
    prepare(PI, ["pyproj"])

    kept = "".join(path.read_text() for path in (tmp_path / "cache/locks").glob("*.json"))

    assert "file:" not in kept and str(index) not in kept


def test_no_password_of_what_uv_and_pip_say_is_repeated():
    said = "error: cannot fetch https://me:secret@one.example/simple/x\n"

    assert resolver.last_lines(said) == "error: cannot fetch https://***@one.example/simple/x"


def test_uv_is_told_the_indexes_that_pip_knows_but_in_no_environment(tmp_path):
    settings = {
        "index-url": "https://me:secret@one.example/simple",
        "extra-index-url": "\nhttps://two.example/simple\nfile:///three",
        "find-links": f"{tmp_path} {tmp_path}/gone https://wheels.example",
        "cert": "/etc/own.pem",
        "trusted-host": "one.example two.example",
    }

    assert index_lines(settings, {}) == [
        "--index-url https://me:secret@one.example/simple",
        "--extra-index-url https://two.example/simple",
        "--extra-index-url file:///three",
        f"--find-links {tmp_path}",
        "--find-links https://wheels.example",
    ]
    assert uv_environment(settings, {"HOME": "/home/me"}) == {
        "HOME": "/home/me",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "SSL_CERT_FILE": "/etc/own.pem",
        "UV_INSECURE_HOST": "one.example two.example",
    }


def test_what_is_said_to_uv_itself_wins():
    said = {
        "UV_INDEX_URL": "https://mine.example/simple",
        "UV_EXTRA_INDEX_URL": "https://more.example/simple",
        "SSL_CERT_FILE": "/mine.pem",
    }
    settings = {"index-url": "https://one.example", "extra-index-url": "https://two", "cert": "/c"}

    assert said == uv_environment(settings, said)
    assert index_lines(settings, said) == []


def test_pip_is_told_the_index_that_only_uv_knows():
    told = pip_environment({"UV_DEFAULT_INDEX": "https://mine.example/simple"})

    assert told["PIP_INDEX_URL"] == "https://mine.example/simple"
    assert (
        pip_environment({"UV_INDEX_URL": "x", "PIP_INDEX_URL": "https://own"})["PIP_INDEX_URL"]
        == "https://own"
    )


def test_pips_own_files_are_read(tmp_path, monkeypatch):
    file = tmp_path / "pip.conf"
    file.write_text("[global]\nindex-url = https://conf.example/simple\ntimeout = 3\n")
    for name in [name for name in os.environ if name.startswith("PIP_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("PIP_CONFIG_FILE", str(file))
    monkeypatch.setenv("PIP_CERT", "/etc/own.pem")

    settings = resolver.pip_settings()

    assert settings["index-url"] == "https://conf.example/simple"
    assert settings["cert"] == "/etc/own.pem"


@pytest.mark.nightly
@pytest.mark.parametrize("platform", [PI, LAPTOP])
def test_real_index_has_all_that_the_runtime_needs(platform, tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path))

    environment = prepare(platform, [])

    assert any(
        wheel.name == "numpy" and platform.machine in wheel.filename for wheel in environment.lock
    )
    assert environment.distribution_packages == ()


@pytest.mark.nightly
def test_real_index_has_no_wheel_of_some_hardware_packages(tmp_path, monkeypatch):
    monkeypatch.setenv("COSMOS_CACHE", str(tmp_path))
    for requirement in ("RPi.GPIO", "RTIMULib"):
        assert refused(PI, [requirement]).text.startswith(f"{requirement}: no wheel for")
    newer_pi = Platform(python=(3, 13), machine="aarch64", libc_version=(2, 41))
    assert "lgpio==" in refused(newer_pi, ["lgpio"]).advice
