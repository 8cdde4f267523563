"""A half as both time modes call it: what it may return, how its faults are told, when it is woken."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from typing import Any

import pytest

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.executor import JobFailed
from madns_runtime.half import Half, HalfFailed, HostHalf
from madns_runtime.plugin.api import AgentSimulation, HostSimulation


class Rover(AgentSimulation):
    def setup(self, context: Any, initial: Any) -> None:
        raise context

    def finish(self) -> Any:
        return {"x": {1, 2}}


class Broken(AgentSimulation):
    def __init__(self) -> None:
        raise ValueError("no board")


class Base(HostSimulation):
    """Wants its timer as *wanted* says; wakes itself meanwhile as *own* says."""

    wanted: float | None = None
    own: float | None = None

    def timer(self, t_s: float) -> float | None:
        if self.own is not None:
            self.half.wake(self.own)
        return self.wanted

    def result(self, job: int, value: Any) -> None:
        self.got = (job, value)


@pytest.fixture
def logged() -> list[str]:
    return []


def made(kind: type, logged: list[str], half: type = Half) -> Any:
    return half(kind, lambda level, text: logged.append(text))


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("told to"), "Rover.setup raised ValueError: told to (test_half.py:"),
        (KeyboardInterrupt(), "Rover.setup raised KeyboardInterrupt (test_half.py:"),
        (asyncio.CancelledError(), "Rover.setup raised CancelledError (test_half.py:"),
        (SystemExit(2), "Rover.setup raised SystemExit: 2 (test_half.py:"),
    ],
)
def test_whatever_a_call_raises_is_told_with_its_line_and_logged(logged, error, told):
    with pytest.raises(HalfFailed) as raised:
        made(Rover, logged).call("setup", error, {})

    assert str(raised.value).startswith(told)
    assert len(logged) == 1
    assert logged[0].startswith("Traceback")


def test_a_full_disk_is_no_fault_of_the_plug_in(logged):
    with pytest.raises(HalfFailed, match=r"^/x: No space left on device$"):
        made(Rover, logged).call("setup", MachineError("/x: No space left on device"), {})

    assert logged == []


def test_what_a_call_returns_against_its_contract_is_refused(logged):
    with pytest.raises(HalfFailed, match=r"^Rover\.finish returned a summary without a JSON form"):
        made(Rover, logged).call("finish")


def test_a_half_that_cannot_be_made_is_named(logged, capsys):
    with pytest.raises(HalfFailed, match=r"^Broken\.__init__ raised ValueError: no board \(test_h"):
        made(Broken, logged)

    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wanted", "own", "next_s"),
    [(None, None, None), (5.0, None, 5.0), (None, 3.0, 3.0), (5.0, 3.0, 3.0), (2, 3.0, 2.0)],
)
def test_the_timer_is_due_at_the_earliest_time_that_was_asked_for(logged, wanted, own, next_s):
    half = made(Base, logged, HostHalf)
    half.simulation.half, half.simulation.wanted, half.simulation.own = half, wanted, own
    half.wake(1.0)
    half.call_timer(1.0)

    assert half.next_s == next_s


def test_waking_before_the_start_is_kept_until_then(logged):
    half = made(Base, logged, HostHalf)
    half.wake(7.0)
    half.wake(9.0)

    assert half.next_s == 7.0


@pytest.mark.parametrize("t_s", [float("nan"), float("inf"), "soon", None, True])
def test_waking_at_no_time_is_refused(logged, t_s):
    with pytest.raises(PluginError, match="expected a simulated time"):
        made(Base, logged, HostHalf).wake(t_s)


def future_of(value: Any = None, error: BaseException | None = None) -> Future[Any]:
    future: Future[Any] = Future()
    if error is None:
        future.set_result(value)
    else:
        future.set_exception(error)
    return future


def test_the_value_of_a_job_is_handed_in(logged):
    half = made(Base, logged, HostHalf)
    half.take_job(4, future_of("truth"))

    assert half.simulation.got == (4, "truth")


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (JobFailed("square raised ValueError (x.py:3)"), "Base: job 4: square raised ValueError"),
        (OSError("pool"), "Base: job 4 raised OSError: pool"),
    ],
)
def test_a_job_that_failed_is_told_and_logged(logged, error, told):
    with pytest.raises(HalfFailed) as raised:
        made(Base, logged, HostHalf).take_job(4, future_of(error=error))

    assert str(raised.value).startswith(told)
    assert len(logged) == 1
