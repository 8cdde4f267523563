"""What all tests share: a private register of processes, and no skip and no process that goes unnoticed."""

from __future__ import annotations

import multiprocessing.process
import os
import platform
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from harness.warm_commands import WarmCommands
from harness.wheel_cache import VARIABLE
from hypothesis import HealthCheck, settings

from cosmos_cli.ui import invocation

pytest_plugins = ["tower.fixtures"]  # of tests/tower; costs nothing where no test asks for a tower

# A shell's background jobs ignore Ctrl-C, and so would every command that a test interrupts.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What somebody has set for runs of their own, such as where these lie, is no test's.
for name in [name for name in os.environ if name.startswith("COSMOS_")]:
    if not name.startswith(("COSMOS_TOWER", "COSMOS_TEST_")):
        del os.environ[name]

# Some set this for themselves; each process of a run would compile all of COSMoS and its libraries anew,
# which is more than half of what the whole suite costs then.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Where `python3` is a version manager's script, each helper on a machine would wait for five shells before it starts.
INTERPRETER = Path(sys.executable).resolve()
if Path(shutil.which("python3") or sys.executable).resolve() != INTERPRETER:
    os.environ["PATH"] = f"{INTERPRETER.parent}{os.pathsep}{os.environ['PATH']}"

# numpy's threads, one per processor, wait busily for work that no test has for them: workers of the suite have none.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A busy machine takes longer than Hypothesis' 0.2 s for an example now and then, which is no fault of the code. A change
# is judged by the same examples as the one before; `.ci/nightly` looks for new ones, by --hypothesis-profile=search.
settings.register_profile("search", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("any_machine", settings.get_profile("search"), derandomize=True)
settings.load_profile("any_machine")

SLOWNESS = {"slow": 6, "root": 6, "browser": 3, "process": 1}
"""How long a test with a marker takes, very roughly, beside one that starts a process."""


def pytest_addoption(parser):
    """Let somebody ask whether a machine has what the suite needs, without all of it."""
    parser.addoption(
        "--first-of-each-file",
        action="store_true",
        help="only the first test of each file, and its first of each marker of what it starts",
    )


def pytest_collection_modifyitems(config, items):
    """
    Bring the files to the front that may take longest, then those whose tests start processes or compute for long.

    So that at the end, when workers run out of files, none of them is a long one. The order within a file stays.
    """
    if config.option.first_of_each_file:
        keep_first_of_each_file(config, items)
    limits_s, slowness = {}, {}
    for item in items:
        if is_left_out(config, item):
            continue
        marker = item.get_closest_marker("timeout")
        limits_s[item.path] = max(marker.args[0] if marker else 0, limits_s.get(item.path, 0))
        marked = [weight for name, weight in SLOWNESS.items() if item.get_closest_marker(name)]
        slowness[item.path] = slowness.get(item.path, 0) + max(marked, default=0)
    items.sort(key=lambda item: (-limits_s.get(item.path, 0), -slowness.get(item.path, 0)))


def keep_first_of_each_file(config, items):
    """Deselect every test before which one of its file had the same of the markers in `SLOWNESS`."""
    first, others = {}, []
    for item in items:
        markers = frozenset(name for name in SLOWNESS if item.get_closest_marker(name))
        if is_left_out(config, item) or first.setdefault((item.path, markers), item) is not item:
            others.append(item)
    config.hook.pytest_deselected(items=others)
    items[:] = first.values()


def is_left_out(config, item):
    """Whether a test is one of the night's, and this is the day."""
    return item.get_closest_marker("nightly") and "not nightly" in config.option.markexpr


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """Turn a skip into a failure where CI is set: CI's machine must be able to run every test."""
    outcome = yield
    report = outcome.get_result()
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped in CI: {report.longrepr}"


@pytest.fixture(autouse=True, scope="session")
def private_register(tmp_path_factory):
    """Keep the tests' processes out of the register of this machine's user."""
    platform.platform()  # starts `uname` the first time
    patch = pytest.MonkeyPatch()
    patch.setenv("COSMOS_STATE_DIR", str(tmp_path_factory.mktemp("state")))
    yield
    patch.undo()


@pytest.fixture(autouse=True, scope="session")
def shared_wheels(tmp_path_factory):
    """Name the folder of wheels that all tests of a worker share."""
    patch = pytest.MonkeyPatch()
    patch.setenv(VARIABLE, str(tmp_path_factory.getbasetemp() / "wheelhouse"))
    yield
    patch.undo()


@pytest.fixture(autouse=True)
def marker_of_processes(request, monkeypatch):
    """Blame a test that starts processes and lacks the marker: `make check` leaves out what has it."""
    if any(request.node.get_closest_marker(name) for name in ("process", "root", "browser")):
        yield
        return
    started = []

    def noted(start, what):
        def act(*arguments, **more):
            if not is_importing():
                started.append(what)
            return start(*arguments, **more)

        return act

    for owner, name in (
        (subprocess.Popen, "__init__"),
        (multiprocessing.process.BaseProcess, "start"),
        (os, "fork"),
        (WarmCommands, "start"),
    ):
        monkeypatch.setattr(owner, name, noted(getattr(owner, name), f"{owner.__name__}.{name}"))
    yield
    assert not started, f"it started a process ({started[0]}): give it the marker `process`"


def is_importing():
    """Whether a module is being imported: matplotlib, which Basilisk brings, looks for fonts the first time."""
    frame = sys._getframe()
    while frame and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@pytest.fixture(autouse=True)
def command_line_forgotten():
    """Forget the command line that a test carried out in this process: messages name the machines of the one under way."""
    yield
    invocation.forget()


@pytest.fixture(autouse=True)
def umask_kept():
    """Blame the test that leaves another umask behind, not those after it whose files others cannot read."""
    before = os.umask(0o022)
    os.umask(before)
    yield
    after = os.umask(before)
    assert f"{after:03o}" == f"{before:03o}"
