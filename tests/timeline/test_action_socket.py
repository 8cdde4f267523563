"""The door for actions in a living run: what it answers comes whole, however much there is to tell."""

import dataclasses
import selectors
import socket
from collections.abc import Mapping
from typing import Annotated, Any

import orjson
import pytest
from annotated_types import Gt, Interval, Len, Lt, MultipleOf, Predicate

from madns_runtime.hardware.action_socket import (
    AGENTS_TOLD_MAX,
    IN_FORCE_BYTES_MAX,
    IN_FORCE_TOLD_MAX,
    SOCKET_NAME,
    ActionSocket,
)
from madns_runtime.timeline.action import ActionKind
from madns_runtime.timeline.kinds import kinds_by_word

AGENTS = [f"agent-{number:04}" for number in range(1000)]


class Loop:
    """Calls back for what is readable now."""

    def __init__(self):
        self._selector = selectors.DefaultSelector()

    def add_reader(self, fd, callback):
        self._selector.register(fd, selectors.EVENT_READ, callback)

    def remove_reader(self, fd):
        self._selector.unregister(fd)

    def turn(self):
        for key, _ in self._selector.select(timeout=0):
            key.data()


def answer_to(order, folder, in_force=(), begin=lambda _: "", declared=()):
    loop = Loop()
    door = ActionSocket(
        folder,
        loop,
        kinds=kinds_by_word(declared),
        agents=AGENTS,
        devices=("gps",),
        begin=begin,
        in_force=lambda: in_force,
    )
    with socket.socket(socket.AF_UNIX) as visitor:
        visitor.settimeout(60.0)
        visitor.connect(str(folder / SOCKET_NAME))
        visitor.sendall((order if isinstance(order, bytes) else orjson.dumps(order)) + b"\n")
        loop.turn()  # it is let in
        loop.turn()  # and heard
        heard = b""
        while data := visitor.recv(1 << 16):
            heard += data
    door.close()
    return orjson.loads(heard)


def test_the_list_of_what_is_in_force_comes_whole_in_a_run_of_a_thousand_agents(
    tmp_path,
):
    action = {"number": 1, "action": "lose_messages", "agents": AGENTS, "parameters": {}}

    answer = answer_to({"list": True}, tmp_path, [action] * 250)

    assert len(answer["in_force"]) == IN_FORCE_TOLD_MAX
    assert answer["in_force_count"] == 250
    assert answer["in_force"][0]["agents"] == AGENTS[:AGENTS_TOLD_MAX]
    assert answer["in_force"][0]["agents_count"] == len(AGENTS)


def test_of_actions_that_are_long_to_tell_so_many_are_told_as_fit(tmp_path):
    action = {"number": 1, "action": "rove", "agents": ["a"], "parameters": {"text": "x" * 9000}}

    answer = answer_to({"list": True}, tmp_path, [action] * 100)

    assert len(answer["in_force"]) == IN_FORCE_BYTES_MAX // 9100
    assert answer["in_force_count"] == 100


@pytest.mark.parametrize(
    ("order", "refusal"),
    [
        ({"action": "hng"}, "no action 'hng' in this run, did you mean hang?"),
        ({"action": "xyz"}, "no action 'xyz' in this run; there are annotate, "),
        (
            {"action": "step_clock", "parameters": {"by_ms": "5ms"}},
            "step_clock.by_ms: expected a number, got '5ms'",
        ),
        (
            {"action": "stress", "parameters": {"workers": "two"}},
            "stress.workers: expected a whole number, got 'two'",
        ),
    ],
)
def test_an_order_that_is_none_is_refused_in_the_words_of_a_scenarios_faults(
    tmp_path, order, refusal
):
    answer = answer_to({"target": "agent-0001", **order}, tmp_path)

    assert answer["refusal"].startswith(refusal)


FREEZE = {"device": "gps", "fault": "freeze"}


@pytest.mark.parametrize(
    ("changed", "refusal"),
    [
        ({"device": "gsp"}, "no agent knows a device 'gsp'; there are gps"),
        ({"fault": "bias"}, "bias needs a value: the number that is added to each element"),
        ({"value": 3.0}, "freeze takes no value, got 3"),
        ({}, ""),
    ],
)
def test_a_fault_of_a_device_that_no_agent_would_carry_out_is_refused(tmp_path, changed, refusal):
    ordered = []
    order = {"action": "device_fault", "target": "agent-0*", "parameters": FREEZE | changed}

    answer = answer_to(order, tmp_path, begin=lambda action: ordered.append(action) or "")

    assert answer == {"refusal": refusal}
    assert len(ordered) == (not refusal)


@pytest.mark.parametrize(
    ("others", "chosen"),
    [
        (["agent-0003", "agent-0001", "nobody"], ("agent-0001", "agent-0003")),
        (["agent-0003", 5], ()),
        ({"agent-0003": 1}, ()),
        ([], ()),
    ],
)
def test_agents_whom_a_target_finds_by_second_names_are_named_beside_it(tmp_path, others, chosen):
    ordered = []
    order = {"action": "slow", "target": "IRIDIUM*", "parameters": {"factor": 2}, "agents": others}

    answer = answer_to(order, tmp_path, begin=lambda action: ordered.append(action) or "")

    assert [each.agents for each in ordered] == ([chosen] if chosen else [])
    assert answer["refusal"].startswith("" if chosen else "no agent is named IRIDIUM*; there are")


@dataclasses.dataclass(frozen=True)
class Valve:
    """Parameters of a plug-in that was not careful: no scenario's timeline names its action."""

    opening: float = 1.0
    more: Any = b"x"

    def __post_init__(self):
        if self.opening > 5.0:
            raise KeyError("wide")


@pytest.mark.parametrize(
    ("given", "refusal"),
    [
        ({}, "open_valve: its parameters cannot be told: Type is not JSON serializable: bytes"),
        ({"opening": 7.0}, "open_valve: Valve cannot be made: KeyError('wide')"),
    ],
)
def test_an_order_that_a_plugins_own_parameters_do_not_take_is_refused_and_the_run_goes_on(
    tmp_path, given, refusal
):
    kind = ActionKind(word="open_valve", summary="x", parameters=Valve, takes_agents=False)
    order = {"action": "open_valve", "target": "run", "parameters": given}

    answer = answer_to(order, tmp_path, declared=(kind,))
    other = answer_to({**order, "parameters": {"more": 1}}, tmp_path, declared=(kind,))

    assert answer == {"refusal": refusal}
    assert other["refusal"] == ""


def test_a_long_order_is_judged_as_any_other(tmp_path):
    ordered = []
    word = "Δ" * 4000  # as long as a telecommand may be

    answer = answer_to(
        {"action": "annotate", "target": "run", "parameters": {"text": word[:200]}, "spare": word},
        tmp_path,
        begin=lambda action: ordered.append(action) or "",
    )

    assert answer == {"refusal": ""}
    assert len(ordered) == 1


Positive = Annotated[float, Gt(0)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wheel:
    radius_m: Positive = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sail:
    angle_deg: Annotated[float, Lt(90)] = 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bounded:
    limit_m: Annotated[float | None, Gt(0)] = None
    share: Annotated[float, Interval(ge=0, le=1)] = 0.5
    points_m: Annotated[tuple[float, ...], Len(1, 2)] = (1.0,)
    pair: tuple[Positive, float] = (1.0, -1.0)
    parts_m: Mapping[str, Positive] | None = None
    either: Positive | str = "none"
    step_m: Annotated[float, MultipleOf(0.1)] = 0.3
    teeth: Annotated[int, MultipleOf(4)] = 8
    word: Annotated[str, Predicate(str.islower)] = "a"
    drive: Wheel | Sail = Wheel()


@pytest.mark.parametrize(
    ("given", "refusal"),
    [
        ({}, ""),
        ({"limit_m": -1}, "limit_m: expected more than 0, got -1.0"),
        ({"share": 2}, "share: expected at most 1, got 2.0"),
        ({"points_m": [1, 2, 3]}, "points_m: expected at most 2, got (1.0, 2.0, 3.0)"),
        ({"pair": [2, -2]}, ""),
        ({"pair": [-2, 2]}, "pair[0]: expected more than 0, got -2.0"),
        ({"parts_m": {"left": 0}}, "parts_m.left: expected more than 0, got 0.0"),
        ({"either": 0}, "either: expected more than 0, got 0.0"),
        ({"either": "all"}, ""),
        ({"step_m": -0.7}, ""),
        ({"step_m": 0.75}, "step_m: expected a multiple of 0.1, got 0.75"),
        ({"teeth": 6}, "teeth: expected a multiple of 4, got 6"),
        ({"word": "Up"}, "word: expected a value for which str.islower holds, got 'Up'"),
        ({"drive": {"angle_deg": 100}}, "drive.angle_deg: expected less than 90, got 100.0"),
    ],
)
def test_an_order_is_held_to_the_bounds_to_which_a_timeline_holds_it(tmp_path, given, refusal):
    kind = ActionKind(word="turn", summary="Turns.", parameters=Bounded, lasting="never")
    order = {"target": "agent-0001", "action": "turn", "parameters": given}

    answer = answer_to(order, tmp_path, declared=(kind,))

    assert answer["refusal"] == (f"turn.{refusal}" if refusal else "")


DEEP = b"[" * 1000 + b"]" * 1000


@pytest.mark.parametrize(
    "line",
    [
        b'{"action":"annotate","target":"run","parameters":{"text":"x"},"for_s":%s}' % DEEP,
        b'{"action":"annotate","target":"run","parameters":{"text":%s}}' % DEEP,
        b'{"action":%s,"target":"run"}' % DEEP,
    ],
)
def test_an_order_that_is_nested_deeper_than_python_goes_is_refused(tmp_path, line):
    assert answer_to(line, tmp_path)["refusal"]

    order = {"action": "annotate", "target": "run", "parameters": {"text": "x"}}
    assert answer_to(order, tmp_path) == {"refusal": ""}
