"""A half as both time modes call it: what it may return, how its faults are told, when it is woken."""

from __future__ import annotations

import asyncio
import dataclasses
import enum
import math
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np
import pytest

from madns_runtime.errors import MachineError, PluginError
from madns_runtime.medium.carrier import Carrier
from madns_runtime.medium.links import LinkMedium
from madns_runtime.medium.outcomes import LinkOutcome
from madns_runtime.plugin import validation
from madns_runtime.plugin.api import AgentSimulation, HostSimulation
from madns_runtime.plugin.half import Half, HalfFailed, HostHalf, RoleProgram
from madns_runtime.plugin.jobs import JobFailed
from madns_runtime.protocol.codec import DEPTH_MAX, ITEMS_MAX, decode_message, encode_message
from madns_runtime.protocol.messages import (
    Delivery,
    SimulationComplete,
    Transmission,
    TransmissionRefusal,
)


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


class Launcher(AgentSimulation):
    """Has something to let go of once it was set up, be it by half."""

    def setup(self, context: Any, initial: Any) -> None:
        self.programs = ["running"]
        raise ValueError("no link")

    def abandon(self) -> None:
        self.programs.pop()


@pytest.fixture
def logged() -> list[str]:
    return []


def made(kind: type, logged: list[str], half: type = Half, medium: Any = None) -> Any:
    def log(level: str, text: str) -> None:
        logged.append(text)

    if half is Half:
        return Half(kind, log)
    program = RoleProgram(make=kind, parameters=None, medium=medium)
    carrier = Carrier(("a", "b"), lambda to, message: True, lambda: 1.0)
    return HostHalf(program, log, carrier=carrier)


def nested(count: int) -> list[Any]:
    """Return so many lists in each other."""
    return [nested(count - 1)] if count > 1 else []


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


def test_a_method_or_medium_that_takes_other_arguments_is_told_where_it_is_written(logged):
    class Mute:
        def carry(self, transmission):
            raise AssertionError

    class Strange(HostSimulation):
        def __init__(self, speed):
            raise AssertionError

    half = made(Base, logged, HostHalf)
    half.carrier.medium = Mute()
    lines = [each.__code__.co_firstlineno for each in (Base.timer, Mute.carry)]
    for line, call in zip(
        lines,
        (
            lambda: half.call("timer", 0.0, "more"),
            lambda: half.take("car-1", Transmission("car-2", 0, 0.0, None)),
        ),
        strict=True,
    ):
        with pytest.raises(HalfFailed, match=rf"TypeError: .*\(test_half\.py:{line}\)$"):
            call()
    with pytest.raises(HalfFailed, match=r"__init__ raised TypeError: .*\(test_half\.py:\d+\)$"):
        made(Strange, logged)


def test_a_full_disk_is_no_fault_of_the_plug_in(logged):
    with pytest.raises(HalfFailed, match=r"^/x: No space left on device$"):
        made(Rover, logged).call("setup", MachineError("/x: No space left on device"), {})

    assert logged == []


def test_what_a_call_returns_against_its_contract_is_refused(logged):
    with pytest.raises(HalfFailed, match=r"^Rover\.finish returned a summary without a JSON form"):
        made(Rover, logged).call("finish")


@pytest.mark.parametrize(
    "summary",
    [{"x": list(range(ITEMS_MAX + 1))}, {"x": [[]] * 3, "y": {"z": nested(DEPTH_MAX)}}],
    ids=["long", "deep"],
)
def test_an_agents_summary_that_no_message_carries_is_refused_by_name(logged, summary):
    class Long(AgentSimulation):
        def finish(self) -> Any:
            return summary

    class LongHost(Base):
        def finish(self) -> Any:
            return summary

    with pytest.raises(HalfFailed, match=r"^Long\.finish returned a summary .* record long data$"):
        made(Long, logged).call("finish")
    assert made(LongHost, logged, HostHalf).call("finish") == summary, "it travels in no message"


def test_the_longest_and_deepest_summary_that_an_agent_may_return_fits_its_last_word(logged):
    summary = {"x": list(range(ITEMS_MAX)), "y": nested(DEPTH_MAX - 3)}

    class Long(AgentSimulation):
        def finish(self) -> Any:
            return summary

    got = made(Long, logged).call("finish")

    message = SimulationComplete({"simulation": got})
    assert decode_message(encode_message(message)) == message


def test_initial_data_are_those_of_the_call_whatever_the_half_does_with_them_afterwards(logged):
    class Reusing(Base):
        data: dict[str, Any] = {"place": [0.0], "names": []}

        def initial_data(self, agent: str) -> Any:
            self.data["place"][0] += 1.0
            self.data["names"].append(agent)
            return self.data

    half = made(Reusing, logged, HostHalf)

    of_a, of_b = (half.call("initial_data", agent) for agent in "ab")

    assert of_a == {"place": [1.0], "names": ["a"]}
    assert of_b == {"place": [2.0], "names": ["a", "b"]}


def test_a_half_lets_go_of_what_outlives_it_once_its_setup_was_called(logged):
    class Holding(Rover):
        def abandon(self) -> None:
            raise ValueError("holds on")

    half = made(Holding, logged)
    half.abandon()
    assert logged == []

    with pytest.raises(HalfFailed):
        half.call("setup", ValueError("told to"), {})
    half.abandon()
    assert [text.strip().splitlines()[-1] for text in logged] == [
        "ValueError: told to",
        "ValueError: holds on",
    ]


def test_a_half_that_cannot_be_made_is_named(logged, capsys):
    with pytest.raises(HalfFailed, match=r"^Broken\.__init__ raised ValueError: no board \(test_h"):
        made(Broken, logged)

    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wanted", "own", "next_s"),
    [
        (None, None, None),
        (5.0, None, 5.0),
        (None, 3.0, 3.0),
        (5.0, 3.0, 3.0),
        (2, 3.0, 2.0),
        (5.0, 0.5, 0.5),
    ],
)
def test_the_timer_is_due_at_the_earliest_time_that_was_asked_for(logged, wanted, own, next_s):
    half = made(Base, logged, HostHalf)
    half.simulation.half, half.simulation.wanted, half.simulation.own = half, wanted, own
    half.wake(1.0)
    half.call_timer(1.0)

    assert half.next_s == next_s


@pytest.mark.parametrize("wanted", [1.0, 0.5, -3])
def test_a_timer_that_asks_for_no_later_time_is_refused(logged, wanted):
    half = made(Base, logged, HostHalf)
    half.simulation.wanted = wanted
    half.wake(1.0)

    with pytest.raises(
        HalfFailed, match=r"^Base\.timer returned .*, called for t = 1 s: expected a l"
    ):
        half.call_timer(1.25)


class Clocked(HostSimulation):
    """Notes what its timer is given."""

    def timer(self, t_s: float) -> float:
        self.given = t_s
        return t_s + 1.0


def test_the_timer_is_given_the_time_it_asked_for_and_how_late_that_is(logged):
    half = made(Clocked, logged, HostHalf)
    half.begin_timer(-0.5)
    half.call_timer(-0.25)

    assert (half.simulation.given, half.lateness_s, half.next_s) == (-0.5, 0.25, 0.5)

    half.call_timer(0.5)

    assert (half.simulation.given, half.lateness_s) == (0.5, 0.0)


def test_the_times_of_the_timer_never_go_back(logged):
    half = made(Clocked, logged, HostHalf)
    half.begin_timer(4.0)
    half.call_timer(4.0)
    half.wake(2.0)
    half.call_timer(4.5)

    assert (half.simulation.given, half.lateness_s) == (4.0, 0.5)


def test_a_half_that_wakes_itself_for_ever_at_one_time_is_ended(logged, monkeypatch):
    monkeypatch.setattr("madns_runtime.plugin.half.REPEATS_MAX", 5)
    half = made(Base, logged, HostHalf)
    half.simulation.half, half.simulation.own = half, 1.0
    half.wake(1.0)

    with pytest.raises(HalfFailed, match=r"^Base\.timer asked 5 times in a row for t = 1 s"):
        for _ in range(7):
            half.call_timer(1.0)


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


def test_a_job_that_somebodys_executor_cancels_is_told(logged):
    future: Future[Any] = Future()
    future.cancel()

    with pytest.raises(HalfFailed, match=r"^Base: job 4: the executor has cancelled it$"):
        made(Base, logged, HostHalf).take_job(4, future)


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


@pytest.mark.parametrize(
    "checks", [None, [{"name": "x", "limit": 1, "got": 0, "passed": True}]], ids=["none", "own"]
)
def test_numbers_of_a_summary_that_are_not_finite_break_a_check(checks):
    own = {} if checks is None else {"checks": checks}
    told = validation.summary({"a": math.nan, "b": [1.0, {"c": -math.inf}], "d": None, **own})

    assert (told["a"], told["b"]) == (None, [1.0, {"c": None}])
    assert told["checks"] == [
        *(checks or []),
        {"name": "summary.not_finite", "limit": 0, "got": 2, "passed": False},
    ]


@pytest.mark.parametrize(
    "value",
    [10**400, -(10**5000), math.nan, math.inf, True, "1"],
    ids=lambda value: type(value).__name__,
)
def test_time_that_no_clock_reaches_is_refused(value):
    with pytest.raises(PluginError, match="expected a simulated time in seconds"):
        validation.next_time(value)


@pytest.mark.parametrize("value", [np.float32(0.5), np.float64(0.5), np.int64(2), 0.5, 2])
def test_time_may_be_a_number_of_numpy_and_becomes_a_plain_one(value):
    assert type(validation.next_time(value)) is float
    assert validation.next_time(value) == value


class Dumb:
    def __repr__(self) -> str:
        raise ValueError("no words")


def test_value_that_cannot_be_looked_at_is_the_fault_of_the_method_that_returned_it(logged):
    half = made(type("Rover", (Base,), {"wanted": Dumb()}), logged, HostHalf)

    with pytest.raises(
        HalfFailed, match=r"Rover.timer returned a Dumb: .* raised ValueError: no words"
    ):
        half.call_timer(0.0)


@dataclasses.dataclass
class Drift:
    error_m: float


@pytest.mark.parametrize(
    "value", [Drift(math.nan), [Drift(math.inf)], enum.Enum("Level", {"NONE": math.nan}).NONE]
)
def test_numbers_that_are_not_finite_break_a_check_whatever_holds_them(value):
    told = validation.summary({"a": value})

    assert told["checks"] == [{"name": "summary.not_finite", "limit": 0, "got": 1, "passed": False}]


def test_summary_of_finite_numbers_stays_as_it_is():
    assert validation.summary({"a": 1.0, "b": None}) == {"a": 1.0, "b": None}


class Air:
    """A medium that answers what it was made with."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def carry(self, sender: str, transmission: Transmission) -> Any:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (ValueError("no air"), r"Base.medium.carry raised ValueError: no air \(test_half.py:"),
        (None, "Base.medium.carry returned None: expected a list of one or more LinkOutcome"),
        ([], "one or more LinkOutcome"),
        (["delivered"], "one or more LinkOutcome"),
        ([LinkOutcome(to="b", outcome="delivered")], "to arrive later than it was sent"),
        ([LinkOutcome(to="b", outcome="delivered", arrives_s=1.0)], "at 1 s"),
        ([LinkOutcome(to="b", outcome="lost", arrives_s=2.0)], "and no other to arrive"),
        ([LinkOutcome(to="b", outcome="delivered", arrives_s=math.nan)], "with arrives_s nan"),
    ],
)
def test_what_a_medium_may_not_answer_is_told(logged, answer, words):
    half = made(Base, logged, HostHalf, lambda host, context: Air(answer))
    half.set_up(None)

    with pytest.raises(HalfFailed, match=words):
        half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))


class Telling(Air):
    """A medium that is told what becomes of messages in the end."""

    def __init__(self, answer: Any, error: Exception | None = None) -> None:
        super().__init__(answer)
        self.told: list[Any] = []
        self.error = error

    def settled(self, sender: str, transmission: Transmission, outcomes: Any) -> None:
        self.told.append((sender, transmission.number, list(outcomes)))
        if self.error is not None:
            raise self.error


class Losing:
    """Faults that lose all."""

    def ways(self, sender: str, transmission: Transmission, outcomes: Any) -> list[LinkOutcome]:
        return [dataclasses.replace(each, outcome="lost", arrives_s=None) for each in outcomes]


def test_a_medium_is_told_what_faults_made_of_what_it_let_pass(logged):
    medium = Telling([LinkOutcome(to="b", outcome="delivered", arrives_s=1.0)])
    half = made(Base, logged, HostHalf, lambda host, context: medium)
    half.set_up(None)
    half.take("a", Transmission("b", 0, 0.5, None))
    half.carrier.faults = Losing()
    half.take("a", Transmission("b", 1, 0.6, None))

    assert [(number, [each.outcome for each in found]) for _, number, found in medium.told] == [
        (0, ["delivered"]),
        (1, ["lost"]),
    ]


def test_what_a_medium_raises_when_it_is_told_has_its_own_name(logged):
    medium = Telling([LinkOutcome(to="b", outcome="lost")], KeyError("b"))
    half = made(Base, logged, HostHalf, lambda host, context: medium)
    half.set_up(None)

    with pytest.raises(HalfFailed, match=r"Base.medium.settled raised KeyError: 'b'"):
        half.take("a", Transmission("b", 0, 0.5, None))


@pytest.mark.parametrize("medium", [3, "air", object()])
def test_what_is_no_medium_is_told(logged, medium):
    half = made(Base, logged, HostHalf, lambda host, context: medium)

    with pytest.raises(HalfFailed, match=r"Base.medium returned a \w+: expected a medium"):
        half.set_up(None)


def test_a_half_without_a_medium_refuses_messages_between_agents(logged):
    half = made(Base, logged, HostHalf, lambda host, context: None)
    half.set_up(None)

    half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))

    assert half.carrier.to_mapping()["refused_because"] == {"no_medium": 1}


def test_an_agent_that_cannot_hear_says_who_sent_and_what_it_lacks(logged):
    class Deaf:
        """Looks like an agent's half, without inheriting."""

    delivery = Delivery(sender="a", sent_s=0.0, arrives_s=0.1, payload=None)
    for kind in (Rover, Deaf):
        with pytest.raises(HalfFailed) as raised:
            made(kind, logged).call("hear", delivery)
        assert str(raised.value) == f"a sent a message, and {kind.__name__} has no hear(delivery)"
        refusal = TransmissionRefusal(number=0, to="b", sent_s=0.0, reason="out_of_range")
        assert made(kind, logged).call("refused", refusal) is None


def test_a_half_lets_go_of_what_outlives_it_if_its_setup_was_called_though_it_raised(
    logged: list[str],
) -> None:
    half = made(Launcher, logged)
    half.abandon()
    assert logged == [], "nothing was started, and nothing went wrong"
    with pytest.raises(HalfFailed, match="no link"):
        half.call("setup", None, None)
    logged.clear()

    half.abandon()
    assert (half.simulation.programs, logged) == ([], [])
    half.abandon()
    assert len(logged) == 1 and "IndexError" in logged[0]


class Mute:
    def __repr__(self) -> str:
        raise ValueError("no words")


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Mute(), "a Mute that cannot be shown: expected a list of one or more LinkOutcome"),
        ([LinkOutcome(to=Mute(), outcome="lost")], "expected a receiver's name"),
        ([LinkOutcome(to="b", outcome="\ud800")], "outcome '.ud800': expected 'delivered'"),
        ([LinkOutcome(to="b", outcome="a\nb")], "outcome 'a.nb': expected 'delivered'"),
    ],
)
def test_an_outcome_that_cannot_be_told_is_the_mediums_fault(logged, answer, words):
    half = made(Base, logged, HostHalf, lambda host, context: Air(answer))
    half.set_up(None)

    with pytest.raises(HalfFailed, match=rf"^Base.medium.carry returned .*{words}"):
        half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))


def test_what_hangs_within_a_call_is_known_by_its_own_name(logged):
    seen = []

    class Watched(Air):
        def carry(self, sender, transmission):
            seen.append(half.doing)
            return super().carry(sender, transmission)

    def medium(host, context):
        seen.append(half.doing)
        return Watched([LinkOutcome(to="b", outcome="lost")])

    half = made(Base, logged, HostHalf, medium)
    half.set_up(None)
    half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))

    assert seen == ["medium", "medium.carry"]


def test_what_a_reach_raises_is_told_with_its_own_line(logged):
    def reach(sender: str, receiver: str, t_s: float) -> str:
        raise ValueError("no map")

    air = LinkMedium(("a", "b"), np.random.default_rng(1), delay_s=1.0, reach=reach)
    half = made(Base, logged, HostHalf, lambda host, context: air)
    half.set_up(None)

    with pytest.raises(HalfFailed, match=r"raised ValueError: no map \(test_half.py:\d+\)$"):
        half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))


def never(*way: Any) -> float:
    return -1.0


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        (
            {"delay_s": 1.0, "reach": never},
            r"reach\('a', 'b', 1\) of test_half\.py:LINE returned -1.0",
        ),
        ({"delay_s": never}, r"delay_s\('a', 'b', 1\) of test_half\.py:LINE returned -1.0"),
        ({"delay_s": partial(min, 0.0, key=str)}, r"delay_s\('a', 'b', 1\) returned 0.0"),
    ],
)
def test_what_a_function_of_a_medium_returns_wrongly_is_told_with_its_own_line(
    logged, answers, told
):
    air = LinkMedium(("a", "b"), np.random.default_rng(1), **answers)
    half = made(Base, logged, HostHalf, lambda host, context: air)
    half.set_up(None)
    told = told.replace("LINE", str(never.__code__.co_firstlineno))

    with pytest.raises(HalfFailed, match=rf"PluginError: {told}: expected [^:]*$"):
        half.take("a", Transmission(to="b", number=0, sent_s=1.0, payload=None))


def test_a_half_that_creeps_on_is_ended_as_one_that_stands(logged, monkeypatch):
    monkeypatch.setattr("madns_runtime.plugin.half.REPEATS_MAX", 5)

    class Creeping(HostSimulation):
        def timer(self, t_s: float) -> float:
            return t_s + 1e-9

    half = made(Creeping, logged, HostHalf)
    half.wake(1.0)

    with pytest.raises(HalfFailed, match=r"^Creeping\.timer asked 5 times in a row for t = 1 s"):
        for _ in range(7):
            half.call_timer(half.next_s)


def test_a_half_with_a_timer_of_many_hertz_goes_on(logged, monkeypatch):
    monkeypatch.setattr("madns_runtime.plugin.half.REPEATS_MAX", 5)

    class Quick(HostSimulation):
        def timer(self, t_s: float) -> float:
            return t_s + 1e-5

    half = made(Quick, logged, HostHalf)
    half.wake(1.0)
    for _ in range(50):
        half.call_timer(half.next_s)

    assert half.next_s == pytest.approx(1.0 + 50e-5)


@dataclasses.dataclass(frozen=True)
class Listed:
    tags: list[str]


def test_an_agent_that_changes_its_parameters_changes_nobody_elses():
    program = RoleProgram(make=Rover, parameters=Listed(tags=["a"]))
    program.parameters_of("agent-01").tags.append("b")

    assert program.parameters_of("agent-02") == Listed(tags=["a"])


@dataclasses.dataclass(frozen=True)
class Fixed:
    tags: tuple[str, ...]


@dataclasses.dataclass
class Loose:
    gain: float = 1.0


def test_an_agent_that_sets_a_parameter_of_a_class_that_is_not_frozen_sets_nobody_elses():
    program = RoleProgram(make=Rover, parameters=Loose())
    program.parameters_of("agent-01").gain = 2.0

    assert program.parameters_of("agent-02") == Loose(gain=1.0)


@dataclasses.dataclass(frozen=True)
class Mixed:
    orbits: tuple[Fixed, ...]
    settings: dict[str, Any]


def test_what_cannot_be_changed_of_an_agents_parameters_is_copied_for_nobody():
    parameters = Mixed(
        orbits=(Fixed(tags=("a",)),), settings={"fixed": Fixed(tags=("b",)), "list": []}
    )
    program = RoleProgram(make=Rover, parameters=parameters)
    first, second = program.parameters_of("agent-01"), program.parameters_of("agent-02")
    first.settings["list"].append(1)

    assert second == parameters == program.parameters
    assert first.orbits is second.orbits is parameters.orbits
    assert first.settings["fixed"] is parameters.settings["fixed"]


def test_parameters_that_hold_themselves_are_copied_all_the_same():
    parameters = Listed(tags=[])
    parameters.tags.append(parameters.tags)
    program = RoleProgram(make=Rover, parameters=parameters)

    assert program.parameters_of("agent-01").tags is not parameters.tags


def test_parameters_that_cannot_be_changed_are_one_object_for_all():
    program = RoleProgram(make=Rover, parameters=Fixed(tags=("a",)))

    assert program.parameters_of("agent-01") is program.parameters_of("agent-02")
