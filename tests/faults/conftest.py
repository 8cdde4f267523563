"""
A laboratory for each test; nothing may be left running in it.

A test here waits far more than it works, so those that use a laboratory run some at once: each in a
thread, in a folder of its own, started before pytest comes to it. They come after all other tests, whose
timing they would disturb. With workers (pytest-xdist) they are tests like others: at the end the processors
would wait for them.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from fault_harness import Laboratory

AT_ONCE = 3

FOLDER = Path(__file__).parent
Stories = dict[str, tuple[Laboratory, "Future[None]"]]


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Move the tests of this folder to the end, in whatever order they were shuffled to, if there are no workers."""
    if not hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path.parent == FOLDER)


@pytest.fixture(scope="session")
def stories(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Stories]:
    """Start the selected tests of this folder, and yield where and how each goes on, by its name."""
    items = [item for item in request.session.items if item.path.parent == FOLDER]
    # Whoever is given more time than others begins first.
    items.sort(key=lambda item: item.get_closest_marker("timeout") is None)
    if hasattr(request.config, "workerinput"):  # pytest-xdist: other workers run the rest
        items = []
    with ThreadPoolExecutor(AT_ONCE) as pool:
        started: Stories = {}
        for item in items:
            if isinstance(item, pytest.Function) and "laboratory" in item.fixturenames:
                laboratory = Laboratory(tmp_path_factory.mktemp("laboratory"))
                params = item.callspec.params if hasattr(item, "callspec") else {}
                future = pool.submit(run_in, laboratory, item.function, **params)
                started[item.nodeid] = laboratory, future
        yield started
        for laboratory, future in started.values():
            if not future.cancel() and not future.done():
                kill_all(laboratory)


@pytest.fixture
def laboratory(
    request: pytest.FixtureRequest, stories: Stories, tmp_path_factory: pytest.TempPathFactory
) -> Laboratory:
    """Return the test's laboratory."""
    if request.node.nodeid in stories:
        return stories[request.node.nodeid][0]
    return Laboratory(tmp_path_factory.mktemp("laboratory"))


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Take the outcome of a test that was started before; run any other with its laboratory guarded."""
    if "stories" not in pyfuncitem.funcargs:
        return None
    story = pyfuncitem.funcargs["stories"].get(pyfuncitem.nodeid)
    if story is not None:
        story[1].result()
        return True
    names = pyfuncitem._fixtureinfo.argnames
    arguments = {name: pyfuncitem.funcargs[name] for name in names}
    run_in(arguments.pop("laboratory"), pyfuncitem.obj, **arguments)
    return True


def run_in(laboratory: Laboratory, test: Callable[..., None], **arguments: object) -> None:
    """Run a test; whatever comes of it, nothing of it lives afterwards, and none may have to be killed."""
    assert laboratory.living() == []
    try:
        test(laboratory=laboratory, **arguments)
        # A test that kills a part of a run waits for the rest itself: here all must be over.
        assert laboratory.living() == []
    finally:
        kill_all(laboratory)


def kill_all(laboratory: Laboratory) -> None:
    """End by force whatever lives."""
    while alive := laboratory.living():
        for process in alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)
        time.sleep(0.05)
    for run in laboratory.started:
        run.process.wait()
