"""The sampler's and the stress workers' processes, for real: what they record, and that none outlives its parent."""

import os
import signal
import subprocess
import sys
import time

import pytest
from harness.waiting import is_alive, wait_until

from madns_runtime.config import Health, Recording
from madns_runtime.health.lifeline import Lifeline, fork_child
from madns_runtime.health.sampler import start_sampler
from madns_runtime.health.stress import factorise, start_stress, stop_stress
from madns_runtime.recording.reader import read_columns, read_stream

PARENT = """
import os, sys, time
from pathlib import Path
from madns_runtime.config import Health, Recording
from madns_runtime.health.sampler import start_sampler
from madns_runtime.health.stress import start_stress

sampler = start_sampler(
    Path(sys.argv[1]), run="r", machine="m", settings=Health(period_s=0.1),
    recording=Recording(flush_interval_s=0.05),
)
stress = start_stress(2)
sibling = os.fork()  # an agent, say: it must not hold the others' life
if not sibling:
    time.sleep(600)
print(sampler.pid, *(worker.pid for worker in stress), sibling, flush=True)
time.sleep(600)
"""


def start(directory):
    settings = Recording(flush_interval_s=0.05)
    return start_sampler(
        directory, run="r", machine="pi07", settings=Health(period_s=0.1), recording=settings
    )


@pytest.mark.parametrize("wait_s", [0.0, 60.0, 1e7, 1e12])
def test_the_end_is_felt_however_long_the_next_sample_is_away(wait_s):
    (life_fd, parent_fd), (signal_fd, signalling_fd) = os.pipe(), os.pipe()
    os.close(parent_fd)

    assert Lifeline(life_fd, signal_fd).has_ended(wait_s)

    for fd in (life_fd, signal_fd, signalling_fd):
        os.close(fd)


@pytest.mark.process
def test_sampler_records_health_until_it_is_stopped(tmp_path):
    sampler = start(tmp_path / "machines/pi07")
    path = tmp_path / "machines/pi07/health.jsonl"
    wait_until(lambda: path.exists() and read_stream(path).state.records >= 3)
    counts = sampler.wait(60)

    reading = read_stream(path)
    columns = read_columns(path)
    assert reading.schema["source"] == "pi07"
    assert (reading.state.is_cut, reading.state.records) == (False, counts["written"])
    assert counts["errors"] == []
    assert all(columns["ram_total_bytes"] == columns["ram_total_bytes"][0])
    assert all(0 <= percent <= 100 for percent in columns["cpu_percent"][1:])
    assert not is_alive(sampler.pid)


@pytest.mark.process
def test_short_run_has_a_sample_of_its_start_and_of_its_end(tmp_path):
    settings = Health(period_s=3600)
    sampler = start_sampler(
        tmp_path, run="r", machine="m", settings=settings, recording=Recording()
    )

    assert sampler.wait(60)["written"] == 2


@pytest.mark.process
def test_sampler_that_cannot_record_says_why(tmp_path):
    (tmp_path / "file").write_text("")
    sampler = start(tmp_path / "file/below")

    assert "cannot record there" in sampler.wait(60)["errors"][0]


@pytest.mark.process
def test_sampler_ends_in_good_order_when_it_is_asked_by_signal(tmp_path):
    sampler = start(tmp_path)
    path = tmp_path / "health.jsonl"
    wait_until(lambda: path.exists() and read_stream(path).state.records >= 1)
    os.kill(sampler.pid, signal.SIGTERM)
    wait_until(lambda: not read_stream(path).state.is_cut)

    assert sampler.wait(60)["errors"] == []


@pytest.mark.process
def test_child_that_does_not_end_is_killed_and_named():
    child = fork_child(lambda _: time.sleep(600))
    report = child.wait(0.2)

    assert report == {"errors": [f"process {child.pid} had to be killed: no end in 0.2 s"]}
    assert not is_alive(child.pid)
    assert child.wait(0.2) == report


@pytest.mark.process
def test_child_that_was_killed_is_told():
    child = fork_child(lambda lifeline: {"ended": lifeline.has_ended(600)})
    os.kill(child.pid, signal.SIGKILL)

    assert child.wait(60) == {"errors": [f"process {child.pid} died without a report"]}


@pytest.mark.process
def test_childs_exception_is_in_its_report():
    def fail(_):
        raise RuntimeError("the sensor fell off")

    assert fork_child(fail).wait(60) == {"errors": ["RuntimeError: the sensor fell off"]}


@pytest.mark.process
def test_stress_workers_count_what_they_factorised():
    stress = start_stress(2)
    report = stop_stress(stress, timeout_s=60)

    assert len(report.factored) == 2
    assert report.errors == ()
    assert not any(is_alive(worker.pid) for worker in stress)


def test_no_stress_is_no_process():
    assert stop_stress(start_stress(0), timeout_s=1).factored == ()


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_nothing_outlives_a_killed_parent(tmp_path, number):
    command = [sys.executable, "-c", PARENT, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        *pids, sibling = map(int, parent.stdout.readline().split())
        try:
            assert len(pids) == 3
            wait_until(lambda: (tmp_path / "health.jsonl").exists())
            wait_until(lambda: read_stream(tmp_path / "health.jsonl").state.records >= 1)
            parent.send_signal(number)
            wait_until(lambda: not any(is_alive(pid) for pid in pids))
            assert is_alive(sibling)
        finally:
            parent.kill()
            os.kill(sibling, signal.SIGKILL)

    # The sampler has closed its records, though nobody was there to ask for it.
    assert not read_stream(tmp_path / "health.jsonl").state.is_cut


@pytest.mark.parametrize(
    ("number", "factors"),
    [
        (1, []),
        (2, [2]),
        (12, [2, 2, 3]),
        (49, [7, 7]),
        (97, [97]),
        (600851475143, [71, 839, 1471, 6857]),
    ],
)
def test_factors_are_prime_and_complete(number, factors):
    assert factorise(number) == factors


def test_only_positive_numbers_have_factors():
    with pytest.raises(ValueError, match="got 0"):
        factorise(0)
