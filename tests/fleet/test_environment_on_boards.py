"""Environments and trees on virtual boards: another architecture, power cuts, full and broken disks."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time

import pytest
from harness.nights import by_night
from harness.wheel_cache import begin_cache
from tower import BoardSpec
from tower.roots import why_unavailable

from cosmos_cli.fleet.connection import ConnectOptions
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Helper
from cosmos_cli.fleet.layout import Layout
from cosmos_cli.fleet.liveness import SilenceWatch
from cosmos_cli.fleet.open_connection import connect
from cosmos_cli.fleet.ssh import keys, settings
from cosmos_cli.fleet.target import Target
from cosmos_cli.provision import STORE_PARTS
from cosmos_cli.provision.environment import (
    RuntimeCheck,
    ask_installed,
    check_request,
    install_environment,
    installed_request,
    modules_of,
)
from cosmos_cli.provision.platform import greeted_platform
from cosmos_cli.provision.trees import runtime_tree, send_tree
from cosmos_cli.provision.udp_echo import Echo
from cosmos_cli.provision.wheelhouse import prepare

pytestmark = pytest.mark.root

LAYOUT = Layout("/home/pi/cosmos")
CONNECT_TIMEOUT_S = 30.0
START_TIMEOUT_S = 60.0
EVERY_FILE = """
import base64, csv, glob, hashlib, os
bad, count = [], 0
for record in glob.glob("/home/pi/cosmos/wheels/*/*.dist-info/RECORD"):
    wheel = os.path.dirname(os.path.dirname(record))
    for name, digest, _ in csv.reader(open(record)):
        for top in [wheel, *glob.glob("/home/pi/cosmos/environments/*/lib/*/site-packages")]:
            path = os.path.join(top, name)
            if not digest or name.partition("/")[0].endswith(".data") or "/RECORD" in name:
                continue
            count += 1
            try:
                found = hashlib.sha256(open(path, "rb").read()).digest()
            except OSError as error:
                bad.append(str(error))
                continue
            if base64.urlsafe_b64encode(found).rstrip(b"=").decode() != digest.partition("=")[2]:
                bad.append(path)
print(count, bad[:5])
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One cache of wheels for all of these tests."""
    patch = pytest.MonkeyPatch()
    patch.setenv("COSMOS_CACHE", str(begin_cache(tmp_path_factory.mktemp("cache"))))
    yield
    patch.undo()


@pytest.fixture
def operate(cache, monkeypatch):
    """Return a function that lets this process reach the boards of a tower."""

    def begin(tower):
        for name, value in tower.operator_environment().items():
            monkeypatch.setenv(name, value)
        keys._load_key.cache_clear()  # towers of other tests had their files at the same place
        settings._read.cache_clear()
        return tower

    return begin


@pytest.fixture
def tower(tower8, operate):
    return operate(tower8)


@pytest.fixture
def foreign(make_tower, operate):
    """Return a function that makes a tower with one board of another architecture."""

    def make(arch):
        reason = why_unavailable(arch)
        if reason:
            pytest.skip(reason)
        return operate(make_tower(count=0, boards=[BoardSpec(name="foreign", arch=arch)]))

    return make


@contextlib.contextmanager
def on(name):
    """Work on a board as a command does."""
    target = Target(name=name, address=name, root=LAYOUT.root)
    connection = connect(target, ConnectOptions(timeout_s=CONNECT_TIMEOUT_S))
    try:
        watch = SilenceWatch(connection)
        with Helper.start(connection, STORE_PARTS, timeout_s=START_TIMEOUT_S, watch=watch) as board:
            yield connection, board
    finally:
        connection.close()


def bring(name, *, before_call=lambda verb, count: None):
    """Do what `cosmos up` does of it; *before_call* hears of each question before it is asked."""
    runtime = runtime_tree()
    with on(name) as (_, board):
        environment = prepare(greeted_platform(board.greeting), [])
        call, counts = board.call, {}

        def told(verb, arguments=None, **how):
            counts[verb] = counts.get(verb, 0) + 1
            before_call(verb, counts[verb])
            return call(verb, arguments, **how)

        board.call = told
        is_changed = install_environment(board, LAYOUT, environment)
        is_changed |= send_tree(board, LAYOUT, runtime)
    return environment, runtime, is_changed


def whole(name, environment, runtime):
    """Return what the board says of both, and how much of it is not what it should be, byte for byte."""
    with on(name) as (connection, board):
        request = installed_request(LAYOUT, trees=[runtime.hash], environments=[environment.key])
        found = ask_installed(board, request)
        said = connection.run("python3 -", stdin=EVERY_FILE.encode(), timeout_s=60)
    return found.environments[environment.key], found.trees[runtime.hash], said.stdout.decode()


def checked(name, environment, runtime):
    """See that the runtime starts there, with all that an agent imports, and that UDP comes and goes."""
    with on(name) as (connection, board), Echo() as echo:
        check = RuntimeCheck(
            key=environment.key,
            trees=[runtime.hash],
            depth="full",
            modules=modules_of(environment),
            simulation="constellation",
            udp=echo.question(connection.own_address),
        )
        return board.call("check_runtime", check_request(LAYOUT, check), timeout_s=240.0).value


def test_board_without_internet_gets_all_that_it_runs(tower):
    environment, runtime, is_changed = bring("pi01")

    assert is_changed
    assert checked("pi01", environment, runtime)["round_trip_ms"] > 0
    assert whole("pi01", environment, runtime)[:2] == (True, True)
    assert not bring("pi01")[2]
    assert tower.run("pi01", "test -w cosmos/trees && ls cosmos/wheels | wc -l").stdout == "5\n"


CUTS = [
    ("wheel", 1, 0.0),
    ("wheel", 18, 0.05),
    ("wheel", 18, 0.3),
    ("environment", 2, 0.05),
    ("environment", 2, 0.15),
    ("tree", 2, 0.05),
]
"""When the power is cut: so long after this question of its kind. Numpy comes in some 17 pieces."""


@pytest.mark.parametrize(("verb", "number", "delay_s"), by_night(CUTS, day=CUTS[2::3]))
def test_power_cut_at_any_point_leaves_nothing_half_and_is_repaired(tower, verb, number, delay_s):
    boots = tower.state()["boards"]["pi02"]["boots"]
    cutters = []

    def cut(asked, count):
        if (asked, count) == (verb, number):
            cutters.append(threading.Timer(delay_s, tower.fault, ["pi02", "crash"]))
            cutters[0].start()

    with contextlib.suppress(MachineFailure):
        bring("pi02", before_call=cut)
    for cutter in cutters:
        cutter.join()
    assert cutters, "the cut never came"
    tower.wait_until_on("pi02", boots + 1)

    environment, runtime, _ = bring("pi02")

    is_environment, is_tree, every_file = whole("pi02", environment, runtime)
    assert (is_environment, is_tree) == (True, True)
    count, bad = every_file.split(" ", 1)
    assert int(count) > 500 and json.loads(bad.replace("'", '"')) == []
    checked("pi02", environment, runtime)


def test_what_was_said_to_be_there_survives_a_power_cut(tower):
    environment, runtime, _ = bring("pi03")
    boots = tower.state()["boards"]["pi03"]["boots"]
    tower.fault("pi03", "crash")
    tower.wait_until_on("pi03", boots + 1)

    is_environment, is_tree, every_file = whole("pi03", environment, runtime)

    assert (is_environment, is_tree) == (True, True)
    assert every_file.endswith(" []\n")


@pytest.mark.nightly
def test_full_disk_is_told_and_leaves_room_again(tower):
    tower.fault("pi04", "fill", 30_000)

    with pytest.raises(MachineFailure) as caught:
        bring("pi04")

    assert caught.value.kind is FailureKind.DISK_FULL
    assert tower.run("pi04", "ls cosmos/environments 2>/dev/null", check=False).stdout == ""
    free_kib = int(tower.run("pi04", "df --output=avail /home/pi | tail -1").stdout)
    assert free_kib > 25_000
    tower.fault("pi04", "unfill")
    environment, runtime, _ = bring("pi04")
    assert whole("pi04", environment, runtime)[:2] == (True, True)


def test_read_only_disk_is_told(tower):
    tower.fault("pi05", "ro")

    with pytest.raises(MachineFailure) as caught:
        bring("pi05")

    assert caught.value.kind is FailureKind.READ_ONLY


@pytest.mark.nightly
def test_cut_link_is_told_and_the_next_call_goes_on(tower):
    def cut(verb, count):
        if (verb, count) == ("wheel", 6):
            tower.fault("pi06", "cut")

    with pytest.raises(MachineFailure) as caught:
        bring("pi06", before_call=cut)
    assert caught.value.kind is FailureKind.LOST

    asked = []
    environment, runtime, _ = bring("pi06", before_call=lambda verb, count: asked.append(verb))
    pieces = sum(wheel.size_bytes for wheel in environment.lock) / 1024**2
    assert asked.count("wheel") < pieces
    assert whole("pi06", environment, runtime)[:2] == (True, True)


def test_closed_udp_is_told_with_the_address(tower):
    environment, runtime, _ = bring("pi07")
    with on("pi07") as (connection, board), Echo() as echo:
        question = echo.question(connection.own_address)
        check = RuntimeCheck(
            key=environment.key, trees=[runtime.hash], depth="start", udp={**question, "port": 9}
        )
        started_s = time.monotonic()
        with pytest.raises(MachineFailure) as caught:
            board.call("check_runtime", check_request(LAYOUT, check), timeout_s=240.0)

    assert caught.value.text == f"no UDP from here to {tower.address}:9"
    assert "is a firewall closing it?" in caught.value.advice
    assert time.monotonic() - started_s < 120  # of 240


@pytest.mark.nightly
def test_32_bit_board_is_served_with_what_its_distribution_brings(foreign):
    """A 64-bit one is, from first to last, in test_foreign_run.py."""
    foreign("armhf")

    environment, runtime, _ = bring("foreign")

    assert environment.platform.machine == "armv7l"
    assert environment.distribution_packages == (
        "python3-msgpack",
        "python3-numpy",
        "python3-psutil",
    )
    assert checked("foreign", environment, runtime)["runtime"]
    assert environment.platform.machine != os.uname().machine
    assert not bring("foreign")[2]


@pytest.mark.nightly
def test_32_bit_board_without_its_distributions_packages_says_what_to_install(foreign):
    tower = foreign("armhf")
    tower.run("foreign", "sudo rm -r /usr/lib/python3/dist-packages/msgpack*")

    with pytest.raises(MachineFailure) as caught:
        bring("foreign")

    assert caught.value.kind is FailureKind.UNSUPPORTED
    assert "python3-msgpack is not installed (needed: msgpack>=" in caught.value.text
    assert "apt-get install python3-msgpack" in caught.value.advice
