"""Executors: the same truth from a process pool and from Dask, and an end to every wait for a cluster."""

from __future__ import annotations

import functools
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from datetime import UTC, datetime

import numpy as np
import psutil
import pytest
from harness.late_module import LateModule, needs_library
from harness.waiting import wait_until

from madns_runtime.config import ExecutorSettings
from madns_runtime.errors import ConfigurationError, MachineError, MissingExtraError
from madns_runtime.plugin.executor import JobRunner, make_executor
from madns_runtime.plugin.jobs import JobFailed, describe_broken, describe_failed_job, run_job
from madns_runtime.reactor.reactor import Reactor
from madns_runtime.simulations.constellation.orbit.constants import EGM_96
from madns_runtime.simulations.constellation.parameters import ScipyPropagator
from madns_runtime.simulations.constellation.truth.propagation import (
    PropagationParameters,
    StretchRequest,
    merge,
    propagate_part,
    split,
)

distributed = LateModule("distributed")
dask_executor = LateModule("madns_runtime.plugin.dask_executor")

pytestmark = [pytest.mark.process, needs_library("distributed", "dask")]
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def cluster():
    """Someone else's cluster: a scheduler and two workers on this machine."""
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        dashboard_address="127.0.0.1:0",
        host="127.0.0.1",
    ) as cluster:
        yield cluster


def connected(cluster):
    return make_executor(ExecutorSettings(kind="dask", address=cluster.scheduler_address))


def request_of(count):
    angles = np.linspace(0.0, 6.0, count)
    radius_m = 7e6 + 1e5 * np.cos(3.0 * angles)
    speed = np.sqrt(EGM_96.mu_m3_s2 / radius_m)
    zero = np.zeros(count)
    states = np.stack(
        (
            radius_m * np.cos(angles),
            radius_m * np.sin(angles),
            zero,
            -0.5 * speed * np.sin(angles),
            0.5 * speed * np.cos(angles),
            math.sqrt(0.75) * speed,
        ),
        axis=1,
    )
    given = PropagationParameters(
        settings=ScipyPropagator(kind="scipy"),
        gravity=EGM_96,
        epoch_utc=datetime(2026, 1, 1, tzinfo=UTC),
    )
    return StretchRequest(first_knot=0, knots=6, knot_s=1.0, states=states), given


def through_the_loop(executor, parts):
    """Return the values of jobs as the host gets them: by callbacks of its loop, in order of submission."""
    reactor, found = Reactor(), {}

    def done(job, future):
        found[job] = future.result()
        if len(found) == len(parts):
            reactor.stop()

    runner = JobRunner(reactor, executor, done)
    for part in parts:
        runner.submit(propagate_part, *part)
    reactor.call_at(reactor.now_s() + PATIENCE_S, reactor.stop)
    reactor.run()
    runner.close()
    return [found[job] for job in sorted(found)]


def test_truth_is_the_same_whoever_computes_it(cluster):
    request, given = request_of(1200)
    expected = propagate_part(request, given)
    for executor in (
        connected(cluster),
        make_executor(ExecutorSettings(kind="process", workers=2)),
        make_executor(ExecutorSettings(kind="thread", workers=1)),
    ):
        parts = split(request, given, 2)
        truth = merge(through_the_loop(executor, parts))

        assert len(parts) == 2
        assert np.array_equal(truth.states, expected.states)
        assert np.array_equal(truth.invariants, expected.invariants)


@pytest.mark.parametrize("kind", ["process", "thread", "dask"])
def test_a_job_gets_what_it_was_given_whatever_its_submitter_changes_afterwards(kind):
    executor = make_executor(ExecutorSettings(kind=kind, workers=1))
    reactor, found = Reactor(), {}

    def done(job, future):
        found[job] = future.result()
        if len(found) == 5:
            reactor.stop()

    runner, load_w = JobRunner(reactor, executor, done), np.full(3, 1000.0)
    for _ in range(4):  # more than a pool encodes ahead of its workers
        runner.submit(time.sleep, 0.2)
    given = runner.submit(functools.partial(np.sum, load_w), None)
    load_w += 1.0
    reactor.call_at(reactor.now_s() + PATIENCE_S, reactor.stop)
    reactor.run()
    runner.close()

    assert found[given] == 3000.0


def test_a_job_that_cannot_be_copied_is_shared_with_threads():
    executor = make_executor(ExecutorSettings(kind="thread", workers=1))
    reactor, lock, found = Reactor(), threading.Lock(), []

    def done(job, future):
        found.append(future.result())
        reactor.stop()

    runner = JobRunner(reactor, executor, done)
    runner.submit(lambda given: given is lock, lock)
    reactor.call_at(reactor.now_s() + PATIENCE_S, reactor.stop)
    reactor.run()
    runner.close()

    assert found == [True]


def failure_of(function, *arguments):
    """Return what the host tells of a job that fails in a pool of processes."""
    executor = make_executor(ExecutorSettings(kind="process", workers=1))
    reactor, found = Reactor(), []

    def done(job, future):
        found.append(describe_failed_job(future.exception(), f"job {job}"))
        reactor.stop()

    runner = JobRunner(reactor, executor, done)
    runner.submit(function, *arguments)
    reactor.call_at(reactor.now_s() + PATIENCE_S, reactor.stop)
    reactor.run()
    runner.close()
    return found[0]


def test_a_job_that_cannot_be_sent_to_a_process_is_told_with_its_own_line():
    told = failure_of(lambda: 1)

    assert re.fullmatch(
        r"job 1: test_a_job\w+\.<locals>\.<lambda> \(test_executors\.py:\d+\) cannot be sent to a worker"
        r" \(Can't pickle .*\); give submit a function at the top of a module and plain arguments",
        told,
    )
    assert "lock" in failure_of(id, threading.Lock())


def test_a_value_that_cannot_be_sent_back_from_a_process_is_told_as_such():
    assert re.fullmatch(
        r"job 1: what it returned cannot be sent back \(cannot pickle '_thread\.lock' object\); return plain values.*",
        failure_of(threading.Lock),
    )
    assert failure_of(math.fmod, 1.0, 0.0).startswith("job 1: fmod raised ValueError")


def left_since(before):
    """Return the processes that were begun and live; multiprocessing's tracker of resources ends with this one."""
    found = []
    for child in set(psutil.Process().children(recursive=True)) - before:
        try:
            command = " ".join(child.cmdline())
        except psutil.NoSuchProcess:  # it ends at this moment
            continue
        if "resource_tracker" not in command:
            found.append(command)
    return found


def test_a_cluster_of_our_own_starts_works_and_leaves_nothing_behind():
    before = set(psutil.Process().children(recursive=True))
    executor = make_executor(ExecutorSettings(kind="dask", workers=1))
    request, given = request_of(501)
    workers = executor.submit(len, executor.client.nthreads()).result(PATIENCE_S)
    stretches = through_the_loop(executor, split(request, given, 2))

    assert workers == 1
    assert np.array_equal(merge(stretches).states, propagate_part(request, given).states)
    wait_until(
        lambda: left_since(before) == [], lambda: f"no end of {left_since(before)}", patience_s=30.0
    )


def test_a_job_that_raises_says_what_and_where(cluster):
    executor = connected(cluster)
    with pytest.raises(JobFailed, match="fmod raised ValueError"):
        executor.submit(run_job, math.fmod, 1.0, 0.0).result(PATIENCE_S)
    executor.shutdown(wait=False, cancel_futures=True)


def test_what_cannot_travel_fails_its_job_instead_of_never_coming_back(cluster):
    executor = connected(cluster)
    with pytest.raises(JobFailed, match=r"^what it returned cannot be sent back \(.*lock"):
        executor.submit(threading.Lock).result(PATIENCE_S)
    with pytest.raises(JobFailed, match=r"^id cannot be sent to a worker \(.*lock"):
        executor.submit(run_job, id, threading.Lock()).result(PATIENCE_S)
    executor.shutdown()


def test_arguments_reach_the_job_as_they_are(cluster):
    executor = connected(cluster)
    argument = {"a": [1, (2, "x")], "b": ("sum", [1, 2]), "c": np.arange(3.0)}
    found = executor.submit(dict, argument).result(PATIENCE_S)
    executor.shutdown()

    assert found.pop("c").tolist() == argument.pop("c").tolist()
    assert found == argument


def test_a_cluster_that_somebody_else_started_stays(cluster):
    connected(cluster).shutdown(wait=False, cancel_futures=True)
    executor = connected(cluster)

    assert executor.submit(math.sqrt, 4.0).result(PATIENCE_S) == 2.0
    executor.shutdown()
    with pytest.raises(RuntimeError):
        executor.submit(math.sqrt, 4.0)


def test_an_address_without_a_scheduler_is_told_in_time(monkeypatch):
    monkeypatch.setattr(dask_executor.load(), "CONNECT_S", 0.5)
    settings = ExecutorSettings(kind="dask", address="tcp://127.0.0.1:9")
    with pytest.raises(ConfigurationError, match=r"scheduler at tcp://127.0.0.1:9, none answered"):
        make_executor(settings)

    with pytest.raises(ConfigurationError, match="expected a Dask scheduler at nonsense://x"):
        make_executor(ExecutorSettings(kind="dask", address="nonsense://x"))


@pytest.mark.parametrize(
    "words", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\x10" + bytes(7) + b"a" * 24]
)
def test_what_answers_and_is_no_scheduler_is_told_as_such(words):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=lambda: server.accept()[0].sendall(words), daemon=True).start()

        with pytest.raises(ConfigurationError, match=f"{address}, and what answers there is none"):
            make_executor(ExecutorSettings(kind="dask", address=address))


class Talkative:
    """A scheduler's plug-in: what goes to all clients comes to a new one with the scheduler's greeting, some times."""

    name, times_left = "talkative", 3

    def add_client(self, scheduler, client):
        self.times_left -= 1
        if self.times_left >= 0:
            news = {"op": "cancelled-keys", "keys": ["x"], "reason": "none", "msg": ""}
            scheduler.loop.asyncio_loop.call_soon(scheduler.report, news)


def test_a_greeting_that_comes_with_news_for_all_clients_is_asked_for_again(cluster):
    talkative = Talkative()
    cluster.scheduler.plugins["talkative"] = talkative
    try:
        executor = connected(cluster)
        assert executor.submit(math.sqrt, 4.0).result(PATIENCE_S) == 2.0
        executor.shutdown()
    finally:
        del cluster.scheduler.plugins["talkative"]

    assert talkative.times_left < 0


def test_a_scheduler_without_workers_is_told_in_time(monkeypatch):
    # The scheduler is there, however long a busy machine takes to connect to it.
    client = functools.partial(distributed.Client, set_as_default=False)
    monkeypatch.setattr(dask_executor.load(), "_client", lambda where, _: client(where))
    monkeypatch.setattr(dask_executor.load(), "CONNECT_S", 0.5)
    with (
        distributed.LocalCluster(
            n_workers=0, dashboard_address="127.0.0.1:0", host="127.0.0.1"
        ) as empty,
        pytest.raises(ConfigurationError, match=r"expected 1 worker\(s\) .* dask worker"),
    ):
        connected(empty)


@pytest.mark.nightly
def test_workers_with_another_version_are_refused(cluster, monkeypatch):
    monkeypatch.setattr(dask_executor.madns_runtime, "__version__", "9.9")
    with pytest.raises(ConfigurationError, match=r"expected cosmos-madns 9\.9 .*, got 0\."):
        connected(cluster)


CLUSTER = """\
import sys
from distributed import LocalCluster
local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0", "protocol": "tcp"}
with LocalCluster(n_workers=1, processes=False, threads_per_worker=1, **local) as cluster:
    print(cluster.scheduler_address, flush=True)
    sys.stdin.read()
"""


def test_jobs_of_a_lost_scheduler_fail_instead_of_never_coming_back():
    with subprocess.Popen(
        [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as cluster:
        address = cluster.stdout.readline().strip()
        executor = make_executor(ExecutorSettings(kind="dask", address=address))
        # Until Dask gives a lost scheduler up; to connect takes a busy machine longer.
        executor.client._timeout = 1.0
        job = executor.submit(time.sleep, PATIENCE_S)
        cluster.kill()

        with pytest.raises((MachineError, OSError)):
            job.result(PATIENCE_S)
        for _ in range(2):  # while Dask looks for its scheduler, and after it has given up
            with pytest.raises(MachineError, match=r"scheduler at tcp://127.* is gone"):
                executor.submit(math.sqrt, 4.0).result(PATIENCE_S)
        executor.shutdown(wait=False, cancel_futures=True)


def test_jobs_from_a_file_beside_the_scenario_are_refused_before_they_travel(cluster):
    def of_a_file():
        pass

    of_a_file.__module__ = "madns_plugin_rover_1"
    executor = connected(cluster)
    with pytest.raises(ConfigurationError, match=r"of_a_file from a file beside the scenario"):
        executor.submit(run_job, of_a_file)
    executor.shutdown()


@pytest.mark.nightly
def test_workers_of_our_own_cluster_die_with_a_killed_host(tmp_path):
    script = tmp_path / "host.py"
    script.write_text(
        "from madns_runtime.config import ExecutorSettings\n"
        "from madns_runtime.plugin.executor import make_executor\n"
        "import os, time\n"
        "if __name__ == '__main__':\n"
        "    executor = make_executor(ExecutorSettings(kind='dask', workers=1))\n"
        "    print(executor.submit(os.getpid).result(), flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as host:
        worker = psutil.Process(int(host.stdout.readline()))
        host.send_signal(signal.SIGKILL)

        worker.wait(PATIENCE_S)


FACTORIES = """\
from concurrent.futures import ThreadPoolExecutor
def good(): return ThreadPoolExecutor(1)
def bad():
    raise ValueError("no cluster here")
def none(): return None
def needs(a): return a
thing = 3
"""


@pytest.fixture
def factories(tmp_path, monkeypatch):
    (tmp_path / "factories.py").write_text(FACTORIES)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("factories", None)


def test_an_executor_of_ones_own_is_used(factories):
    executor = make_executor(ExecutorSettings(kind="factories:good"))

    assert executor.submit(math.sqrt, 4.0).result(PATIENCE_S) == 2.0
    executor.shutdown()


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("factories:bad", r"factories.py:4: bad\(\): ValueError: no cluster here"),
        ("factories:none", "factories:none returned NoneType, which is no"),
        ("factories:needs", r"factories.py:6: needs\(\): TypeError: needs\(\) missing 1"),
        ("factories:thing", "factories:thing: expected a function, got int"),
        ("factories:god", "has no 'god', did you mean good?"),
        ("nowhere:x", "nowhere:x: No module named 'nowhere'"),
    ],
)
def test_what_is_wrong_with_an_executor_of_ones_own_is_named(factories, kind, expected):
    with pytest.raises(ConfigurationError, match=f"executor.kind: .*{expected}"):
        make_executor(ExecutorSettings(kind=kind))


def test_a_job_for_workers_that_have_died_is_no_fault_of_who_submits_it():
    executor = make_executor(ExecutorSettings(kind="process", workers=1))
    runner = JobRunner(Reactor(), executor, lambda job, future: None)
    with pytest.raises(BrokenExecutor):
        executor.submit(os.kill, next(iter(executor._processes)), signal.SIGKILL).result(PATIENCE_S)

    with pytest.raises(MachineError, match="a worker of the executor has died"):
        runner.submit(math.sqrt, 4.0)


class Unloadable:
    """Packed and not unpacked, as an exception whose class takes other arguments than it hands on."""

    def __reduce__(self):
        return int, ("no number",)


def test_a_value_that_cannot_be_unpacked_is_told_as_such_and_no_worker_as_dead():
    executor = make_executor(ExecutorSettings(kind="process", workers=1))
    try:
        with pytest.raises(BrokenExecutor) as broken:
            executor.submit(Unloadable).result(PATIENCE_S)
    finally:
        JobRunner(Reactor(), executor, lambda job, future: None).close()

    told = describe_broken(broken.value)
    assert told.startswith("what it returned cannot be unpacked: ValueError: invalid literal")
    assert told.endswith("'no number'")
    assert "has died" in describe_broken(BrokenExecutor("terminated abruptly"))


def fork_and_answer():
    worker = os.getpid()
    return os.getpid() if os.fork() else -worker


def test_a_process_that_a_job_forks_and_that_comes_back_answers_nothing_and_ends():
    executor = make_executor(ExecutorSettings(kind="process", workers=1))
    worker = next(iter(executor._processes))
    try:
        answers = [executor.submit(run_job, fork_and_answer).result(PATIENCE_S) for _ in range(20)]
        wait_until(
            lambda: all(
                child.status() == psutil.STATUS_ZOMBIE
                for child in psutil.Process(worker).children()
            )
        )
    finally:
        JobRunner(Reactor(), executor, lambda job, future: None).close()

    assert answers == [worker] * 20


def test_jobs_that_come_too_late_are_counted():
    runner = JobRunner(Reactor(), ThreadPoolExecutor(1), lambda job, future: None)
    said = []
    runner.tell_dropped(lambda *words: said.append(words))
    for _ in range(3):
        runner.submit(math.sqrt, 4.0)

    runner.tell_dropped(lambda *words: said.append(words))
    runner.close()

    assert said == [("warning", "3 of the executor's jobs not done when simulated time was over")]


class Cancelling(ThreadPoolExecutor):
    """Somebody's executor that gives a job up, as one does that has lost its workers."""

    def submit(self, function, /, *arguments, **keywords):
        future = Future()
        future.cancel()
        return future


def test_a_job_that_an_executor_cancels_is_handed_to_whoever_awaits_it():
    reactor = Reactor()
    handed = []

    def done(job, future):
        handed.append((job, future.cancelled()))
        reactor.stop()

    runner = JobRunner(reactor, Cancelling(1), done)
    reactor.call_at(reactor.now_s() + PATIENCE_S, reactor.stop)

    runner.submit(math.sqrt, 4.0)
    reactor.run()

    assert handed == [(1, True)]
    assert runner.pending_count == 0


class Stubborn(ThreadPoolExecutor):
    """Somebody's executor that cannot be closed in the usual way."""

    def shutdown(self, wait=True):  # no cancel_futures
        super().shutdown(wait)


def test_an_executor_that_cannot_be_closed_costs_no_result(capsys):
    executor = Stubborn(1)
    JobRunner(Reactor(), executor, lambda job, future: None).close()

    assert "TypeError" in capsys.readouterr().err
    executor.shutdown()


def test_without_dask_one_line_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "madns_runtime.plugin.dask_executor", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'cosmos-madns\[dask\]'"):
        make_executor(ExecutorSettings(kind="dask"))
