"""Flight software on its board: what it is given, what leaves it, and who is blamed."""

import inspect
import re
import types

import numpy as np
import pytest
from constellation_fakes import WALKER, FakeContext, parameters, tell, tick

from madns_runtime.errors import BlamedError, MachineError
from madns_runtime.plugin import isolation
from madns_runtime.plugin.api import Tick
from madns_runtime.plugin.context import describe_exception
from madns_runtime.plugin.time_limit import PluginStopped
from madns_runtime.protocol.messages import Service
from madns_runtime.simulations.constellation.agent import ConstellationAgent
from madns_runtime.simulations.constellation.messages import (
    Command,
    CommandResult,
    Delivery,
    Initial,
    Message,
    Segment,
    TransmissionRefusal,
)
from madns_runtime.simulations.constellation.vehicle import flight_tick
from madns_runtime.simulations.constellation.vehicle.truth_buffer import TruthBuffer

HZ = 10.0
RESULT = {
    "status": "executed",
    "at_s": 3.0,
    "revision": 1,
    "delta_v_m_s": 0.1,
    "propellant_kg": 4.0,
}


class BoardContext(FakeContext):
    """Remembers how messages were sent, and has chance."""

    def __init__(self, params, **rest):
        agents = ("agent-01", "agent-02")
        super().__init__("agent-01", agents, params, tick_hz=HZ, **rest)
        self.random = np.random.default_rng([7, 1])
        self.services = []

    def send(self, to, message, service=None, *, deadline_s=None):
        super().send(to, message, service, deadline_s=deadline_s)
        self.services.append((service, deadline_s))


def segment(until_s=60):
    """Straight and uniform motion: knots of 1 s."""
    times_s = np.arange(0.0, until_s + 1.0)
    velocity = np.array([10.0, 7400.0, 0.0])
    position = np.array([7.0e6, 0.0, 0.0]) + times_s[:, None] * velocity
    states = np.hstack([position, np.tile(velocity, (len(times_s), 1))])
    return Segment(revision=0, t0_s=0.0, knot_s=1.0, states=states)


class Ship:
    """One agent with flight software from a text."""

    def __init__(self, folder, text="class G:\n    def step(self, t_s, readings): pass", **rest):
        (folder / "guidance.py").write_text(text)
        joined_s = rest.pop("joined_s", -1.0)
        flight = {"software": "guidance.py:G", **rest.pop("flight", {})}
        params = parameters(rest.pop("satellites", WALKER), flight=flight, **rest)
        self.context = BoardContext(params, base_directory=folder, clock_s=joined_s)
        initial = Initial(
            satellite="SAT-1", frame="TEME", epoch_utc="2026-01-01T00:00:00Z", segment=segment()
        )
        self.initial = initial.to_message()
        self.agent = ConstellationAgent()
        self.agent.setup(self.context, self.initial)

    def run(self, until_s, from_s=0.0):
        for index in range(round(from_s * HZ), round(until_s * HZ)):
            self.context.clock_s = index / HZ
            tick(self.agent, Tick(index, index / HZ, 1.0 / HZ, 0.0, 0))
        return self

    def tell(self, message):
        tell(self.agent, message.to_message() if isinstance(message, Message) else message)
        return self

    @property
    def flight(self):
        """The flight software's own summary."""
        return self.agent.finish()["flight"]

    def sent(self, kind):
        return [m for _, _, m in self.context.sent if m["kind"] == kind]


def test_it_is_given_truth_where_the_scenario_says_so(tmp_path):
    text = """
class G:
    seen = []
    def step(self, t_s, readings):
        self.seen.append([t_s, *readings["truth"].values])
    def finish(self):
        return {"seen": self.seen}
"""
    ship = Ship(tmp_path, text, flight={"input": "truth"}).run(0.3)

    seen = np.array(ship.flight["seen"])
    assert seen[:, 0] == pytest.approx([0.0, 0.1, 0.2])
    assert seen[2, 1:] == pytest.approx([7.0e6 + 2.0, 1480.0, 0, 10.0, 7400.0, 0.0])


def test_it_is_given_either_truth_or_measurements(tmp_path):
    text = """
class G:
    def step(self, t_s, readings):
        self.names = sorted(readings)
    def finish(self):
        return {"names": self.names}
"""
    vehicles = [{"sensors": {"clock": {"rate_hz": HZ}}}]

    measured = Ship(tmp_path, text, vehicles=vehicles).run(0.1)
    told = Ship(tmp_path, text, flight={"input": "truth"}, vehicles=vehicles).run(0.1)

    assert measured.flight == {"names": ["clock"]}
    assert told.flight == {"names": ["truth"]}
    assert len(told.context.records["clock_sensor"]) == 1


def test_measurements_that_it_is_not_given_are_not_counted_as_dropped(tmp_path, monkeypatch):
    monkeypatch.setattr(flight_tick, "READINGS_MAX", 3)
    sensors = {"gnss": {"rate_hz": HZ}}
    ship = Ship(tmp_path, flight={"input": "truth"}, vehicles=[{"sensors": sensors}])

    ship.run(0.8)

    summary = ship.agent.finish()
    assert summary["sensors"]["gnss"]["samples"] == 8
    assert "readings_dropped" not in summary


def test_it_is_given_no_truth_otherwise(tmp_path):
    text = "class G:\n    def step(self, t_s, readings):\n        assert 'truth' not in readings"

    Ship(tmp_path, text).run(1.0)


def test_no_public_name_that_it_is_given_leads_to_truth(tmp_path):
    text = """
class G:
    def setup(self, context):
        G.given = context
    def step(self, t_s, readings):
        pass
    def finish(self):
        return {}
"""
    ship = Ship(tmp_path, text, crosslinks={}, flight={"settings": {"a": [1.0]}}).run(1.0)
    given = ship.agent._cockpit._software.given

    def leaks():
        holders = (TruthBuffer, Segment, Initial, FakeContext, ConstellationAgent)
        return [thing for thing in public_things(given) if isinstance(thing, holders)]

    assert leaks() == []
    given.leak = {"deep": [ship.context]}
    assert ship.context in leaks()  # what there is, is found


def public_things(root):
    """Return all that public names, items and bound methods lead to; code, text, numbers and numpy's left out."""
    ends = (type, types.ModuleType, types.FunctionType, types.BuiltinMethodType, str, float, int)
    found, waiting = {}, [root]
    while waiting:
        thing = waiting.pop()
        if id(thing) in found or isinstance(thing, ends) or "numpy" in type(thing).__module__:
            continue
        found[id(thing)] = thing
        waiting += [getattr(thing, name) for name in dir(thing) if not name.startswith("_")]
        if isinstance(thing, dict):
            waiting += thing.values()
        elif isinstance(thing, list | tuple | set | frozenset):
            waiting += thing
        elif inspect.ismethod(thing):
            waiting.append(thing.__self__)
    return list(found.values())


def test_settings_are_each_vehicles_own(tmp_path):
    text = """
class G:
    def setup(self, context):
        context.settings["seen"] = [*context.settings["seen"], context.name]
        self.seen = context.settings["seen"]
        context.settings["a"].append(1.0)
    def finish(self):
        return {"seen": self.seen}
"""
    flight = {"settings": {"seen": ["x"], "a": [0.0]}}

    first = Ship(tmp_path, text, flight=flight)
    again = ConstellationAgent()
    again.setup(BoardContext(first.context.parameters, base_directory=tmp_path), first.initial)

    assert again.finish()["flight"] == first.flight == {"seen": ["x", "agent-01"]}
    assert first.context.parameters.flight.settings == {"seen": ["x"], "a": [0.0]}


def test_a_command_leaves_at_once_with_its_time_as_deadline(tmp_path):
    text = """
class G:
    def setup(self, context):
        self.context = context
    def step(self, t_s, readings):
        if t_s == 1.0:
            self.number = self.context.delta_v((0.0, 0.1, 0.0), at_s=t_s + 3.0)
    def finish(self):
        return {"number": self.number}
"""
    ship = Ship(tmp_path, text).run(2.0)

    command = Command.from_message(ship.sent("command")[0])
    assert ship.context.services == [(Service.SYNC, 4.0)]
    assert command == Command(
        number=0,
        kind="delta_v",
        commanded_s=1.0,
        at_s=4.0,
        frame="rtn",
        vector=(0.0, 0.1, 0.0),
    )
    assert ship.flight == {"number": 0}
    assert ship.context.records["commands"] == [(10, 0, "delta_v", 4.0, "rtn", 0.0, 0.1, 0.0, 0.0)]


def test_an_agent_that_rejoins_gives_no_number_twice(tmp_path):
    text = body(
        "for _ in range(16): self.context.delta_v((0, 1, 0), at_s=60.0)",
        "for _ in range(64): self.context.broadcast(t_s)",
    )
    first = Ship(tmp_path, text, crosslinks={}).run(2.0)
    again = Ship(tmp_path, text, crosslinks={}, joined_s=1.91).run(4.0, 2.0)

    commands = [message["number"] for ship in (first, again) for message in ship.sent("command")]
    messages = [one.number for ship in (first, again) for _, one in ship.context.transmitted]
    for numbers in (commands, messages):
        assert numbers[0] == 0
        assert len(set(numbers)) == len(numbers) > 40


def test_a_result_is_told_right_before_the_next_tick_with_the_tank_gauge(tmp_path):
    text = """
class G:
    calls = []
    def command_result(self, result):
        self.calls.append(result.status)
    def step(self, t_s, readings):
        self.calls.append([t_s, list(readings["mass"].values) if "mass" in readings else None])
    def finish(self):
        return {"calls": self.calls}
"""
    thruster = {"isp_s": 220.0, "propellant_kg": 5.0}
    ship = Ship(tmp_path, text, vehicles=[{"mass_kg": 50.0, "thruster": thruster}]).run(0.1)
    ship.tell(CommandResult(number=0, **RESULT | {"status": "accepted"})).run(0.2, 0.1)
    ship.tell(CommandResult(number=0, **RESULT)).run(0.4, 0.2)

    assert ship.flight["calls"] == [
        [0.0, None],
        "accepted",
        [0.1, None],
        "executed",
        [0.2, [49.0, 4.0]],
        [0.3, None],
    ]
    assert ship.context.records["command_results"] == [
        (1, 0, "accepted", 3.0, 1, 0.1, 4.0, ""),
        (2, 0, "executed", 3.0, 1, 0.1, 4.0, ""),
    ]


LISTENER = """
class G:
    heard = []
    def receive(self, message):
        self.heard.append([message.sender, message.payload])
    def step(self, t_s, readings):
        if self.heard:
            self.heard[-1].append(t_s)
    def finish(self):
        return {"heard": self.heard}
"""


def delivery(arrives_s, sender="agent-02", sent_s=0.0, payload=None):
    return Delivery(sender=sender, sent_s=sent_s, arrives_s=arrives_s, payload=payload)


def test_a_message_is_held_until_the_first_tick_at_or_after_its_arrival(tmp_path):
    ship = Ship(tmp_path, LISTENER, crosslinks={}).run(0.1)
    ship.tell(delivery(0.31, payload="later")).tell(delivery(0.2, payload="on a tick"))
    ship.run(1.0, 0.1)

    heard = ship.flight["heard"]
    assert [row[:3] for row in heard] == [
        ["agent-02", "on a tick", 0.2],
        ["agent-02", "later", 0.4],
    ]
    assert ship.agent.finish()["messages_late"] == 0


def test_messages_of_one_moment_are_heard_in_the_order_of_their_senders(tmp_path):
    ship = Ship(tmp_path, LISTENER, crosslinks={})
    for sender in ("c", "a", "b"):
        ship.tell(delivery(0.5, sender=sender))

    ship.run(1.0)

    assert [row[0] for row in ship.flight["heard"]] == ["a", "b", "c"]


def test_a_message_that_missed_its_tick_is_heard_in_the_next_and_counted(tmp_path):
    ship = Ship(tmp_path, LISTENER, crosslinks={}).run(1.0)
    ship.tell(delivery(0.85)).tell(delivery(0.95)).run(2.0, 1.0)

    assert ship.agent.finish()["messages_late"] == 1
    assert ship.agent.finish()["messages_received"] == 2
    assert [row[0] for row in ship.context.records["messages"]] == [10, 10]


def test_messages_leave_numbered_and_stamped_with_their_tick(tmp_path):
    text = """
class G:
    def setup(self, context):
        self.context = context
    def step(self, t_s, readings):
        self.context.send("agent-02", {"t": t_s})
        self.context.broadcast("all")
"""
    ship = Ship(tmp_path, text, crosslinks={}).run(0.2)

    sent = [transmission for _, transmission in ship.context.transmitted]
    assert [(m.to, m.sent_s, m.number, m.payload) for m in sent] == [
        ("agent-02", 0.0, 0, {"t": 0.0}),
        ("*", 0.0, 1, "all"),
        ("agent-02", 0.1, 2, {"t": 0.1}),
        ("*", 0.1, 3, "all"),
    ]
    assert ship.context.sent == []


def test_estimates_are_recorded_apart_with_the_units_of_their_names(tmp_path):
    text = """
class G:
    def setup(self, context):
        self.context = context
    def step(self, t_s, readings):
        self.context.estimate({"slot_error_deg": t_s, "a_m": 7e6})
"""
    ship = Ship(tmp_path, text).run(0.2)

    fields = ship.context.streams["estimates"]
    assert [(f.name, f.unit) for f in fields] == [
        ("tick", ""),
        ("slot_error_deg", "deg"),
        ("a_m", "m"),
    ]
    assert ship.context.records["estimates"] == [(0, 0.0, 7e6), (1, 0.1, 7e6)]


def test_estimate_of_nothing_is_null_and_no_number_that_is_none(tmp_path):
    ship = Ship(tmp_path, body("self.context.estimate({'a_m': None, 'b_m': t_s})")).run(0.1)

    assert ship.context.records["estimates"] == [(0, None, 0.0)]


@pytest.mark.parametrize("what", ["(float('nan'), 0, 0)", "(0, 0, -float('inf'))"])
def test_torque_of_no_finite_number_is_refused(tmp_path, what):
    call = f"self.context.torque({what}, at_s=1.0, duration_s=1.0)"
    attitude = {"inertia_kg_m2": [10.0, 12.0, 14.0]}
    ship = Ship(tmp_path, body(call), vehicles=[{"attitude": attitude}])

    with pytest.raises(BlamedError, match="torque: expected a finite number for component"):
        ship.run(0.1)


def body(*lines):
    return "\n".join(
        [
            "class G:",
            "    def setup(self, context):",
            "        self.context = context",
            "    def step(self, t_s, readings):",
            *[f"        {line}" for line in lines],
        ]
    )


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("self.context.delta_v((1, 2), at_s=1.0)", "expected three numbers in m/s, got (1, 2)"),
        ("self.context.delta_v((1, 2, float('nan')), at_s=1.0)", "expected a finite number"),
        ("self.context.delta_v((1, 2, 3), at_s=None)", "expected a finite number for at_s"),
        ("self.context.delta_v((1, 2, 3), at_s=1e999)", "expected a finite number for at_s"),
        ("self.context.delta_v((1, 2, 10**400), at_s=1.0)", "expected a finite number for comp"),
        (
            "self.context.ballistic(float('nan'), at_s=1.0)",
            "expected a finite number for ballistic",
        ),
        ("self.context.estimate({'a': 10**400})", "numbers for a,"),
        ("self.context.delta_v((1, 2, 3), at_s=1.0, frame='RTN')", "inertial, rtn, body"),
        ("self.context.delta_v((1, 2, 3), at_s=1.0, frame='body')", "vehicles.attitude"),
        ("self.context.torque((1, 2, 3), at_s=1.0, duration_s=1.0)", "vehicles.attitude"),
        ("self.context.ballistic(0.5, at_s=1.0)", "0.01 to 0.02 m^2/kg, got 0.5"),
        ("[self.context.delta_v((1, 2, 3), at_s=9.0) for _ in range(17)]", "at most 16 commands"),
        ("[self.context.broadcast(1) for _ in range(65)]", "at most 64 messages"),
        ("self.context.broadcast(object())", "send: "),
        ("self.context.send(3, 1)", "expected a receiver's name, got 3"),
        ("self.context.send('x' * 20_000, 'agent-02')", "a name of at most 16384 bytes, got 20"),
        ("self.context.send('agent-' + chr(0xD800), 1)", "send: "),
        ("self.context.estimate({})", "a mapping of 1 to 64 names"),
        ("self.context.estimate({'a': 1}); self.context.estimate({'b': 1})", "numbers for a,"),
        ("self.context.estimate({'a': 'x'})", "numbers for a,"),
        ("self.context.estimate({1: 2.0})", "names such as slot_error_deg, got 1"),
        ("self.context.estimate({'tick': 2.0})", "estimate: tick is taken, as each record bears"),
        ("self.context.estimate({chr(0xD800): 2.0})", "names such as slot_error_deg, got "),
        ("import numpy; self.context.delta_v(numpy.array(1.0), at_s=1.0)", "three numbers in m/s"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_its_line(tmp_path, line, words):
    ship = Ship(
        tmp_path,
        body("pass", line),
        crosslinks={},
        vehicles=[{"ballistic_m2_kg_range": [0.01, 0.02]}],
    )

    with pytest.raises(BlamedError, match=re.escape(words)) as caught:
        ship.run(0.1)

    assert str(caught.value).startswith("G.step raised PluginError: ")
    assert str(caught.value).endswith("(guidance.py:6)")


TOLD = """
class G:
    told, numbers = [], []
    def setup(self, context):
        self.context = context
    def step(self, t_s, readings):
        if t_s < 0.2:
            self.numbers.append({call})
    def message_refused(self, refusal):
        self.told.append([refusal.number, refusal.to, refusal.sent_s, refusal.reason])
    def finish(self):
        return {{"told": self.told, "numbers": self.numbers}}
"""


@pytest.mark.parametrize(
    ("call", "to", "reason", "radio"),
    [
        ("self.context.send('agent-02', 1)", "agent-02", "no_radio", {}),
        ("self.context.broadcast(1)", "*", "no_radio", {}),
        ("self.context.send('ground', 1)", "ground", "no_radio", {"crosslinks": {}}),
        ("self.context.send('ground:x', 1)", "ground:x", "no_radio", {"crosslinks": {}}),
        ("self.context.broadcast('x' * 20_000)", "*", "too_long", {"crosslinks": {}}),
    ],
)
def test_a_message_that_cannot_leave_is_refused_counted_and_told_in_the_next_tick(
    tmp_path, call, to, reason, radio
):
    ship = Ship(tmp_path, TOLD.format(call=call), **radio).run(1.0)

    assert ship.flight == {
        "told": [[0, to, 0.0, reason], [1, to, 0.1, reason]],
        "numbers": [0, 1],
    }
    summary = ship.agent.finish()
    assert (summary["messages_sent"], summary["sends_refused"]) == (0, {reason: 2})
    assert ship.context.transmitted == []
    assert ship.context.records["refusals"] == [(1, 0, to, 0.0, reason), (2, 1, to, 0.1, reason)]
    ((level, words),) = ship.context.logs
    assert level == "warning"
    assert reason.replace("_", " ") in words


def test_what_the_host_refuses_is_told_like_what_the_board_does(tmp_path):
    call = "self.context.send('agent-02', 1)"
    ship = Ship(tmp_path, TOLD.format(call=call), crosslinks={}).run(0.1)
    ship.tell(TransmissionRefusal(number=0, to="agent-02", sent_s=0.0, reason="out_of_range")).run(
        0.5, 0.1
    )

    assert ship.flight["told"] == [[0, "agent-02", 0.0, "out_of_range"]]
    assert ship.agent.finish()["sends_refused"] == {"out_of_range": 1}
    assert ship.agent.finish()["messages_sent"] == 2
    assert ship.context.logs == []


def test_a_refusal_may_be_answered_by_sending_again(tmp_path):
    text = body("if t_s == 0.0: self.context.broadcast(1)")
    text += "\n    def message_refused(self, refusal): self.context.broadcast(1)\n"
    ship = Ship(tmp_path, text).run(1.0)

    assert ship.agent.finish()["sends_refused"] == {"no_radio": 10}


def test_without_refusals_there_is_no_stream_of_them(tmp_path):
    ship = Ship(tmp_path, body("self.context.broadcast(1)"), crosslinks={}).run(0.2)

    assert "refusals" not in ship.context.streams
    assert ship.agent.finish()["sends_refused"] == {}


def test_an_error_names_class_method_file_and_line_once(tmp_path):
    ship = Ship(tmp_path, body("self.helper()") + "\n    def helper(self):\n        1 / 0\n")

    with pytest.raises(BlamedError) as caught:
        ship.run(0.1)

    told = describe_exception(caught.value, "ConstellationAgent.step")
    assert told == "G.step raised ZeroDivisionError: division by zero (guidance.py:7)"


@pytest.mark.parametrize(
    "kind", ["KeyboardInterrupt", "GeneratorExit", "SystemExit", "BaseException"]
)
def test_whatever_it_raises_is_blamed_on_its_own_line(tmp_path, kind, monkeypatch):
    # As in an agent's process.
    monkeypatch.setattr(isolation, "is_interruption", lambda error: False)
    ship = Ship(tmp_path, body(f"raise {kind}('enough')"))

    with pytest.raises(BlamedError, match=rf"^G.step raised {kind}: enough \(guidance.py:5\)$"):
        ship.run(0.1)


@pytest.mark.parametrize("error", [KeyboardInterrupt, PluginStopped])
def test_ctrl_c_and_the_end_of_its_time_are_no_errors_of_it(tmp_path, error):
    place = f"from {error.__module__} import {error.__name__} as stop"
    ship = Ship(tmp_path, body(f"{place}\n        raise stop"))

    with pytest.raises(error):
        ship.run(0.1)


def test_a_disk_that_is_full_is_not_blamed_on_it(tmp_path):
    ship = Ship(tmp_path, body("self.context.estimate({'a_m': 1.0})"))

    def refuse(name, fields):
        raise MachineError("estimates.jsonl: cannot record there: No space left on device")

    ship.context.open_stream = refuse

    with pytest.raises(MachineError, match=r"^estimates.jsonl: cannot record there"):
        ship.run(0.1)


def test_what_making_it_raises_is_blamed_on_its_own_line(tmp_path):
    text = (
        "class G:\n    def __init__(self):\n        1 / 0\n    def step(self, t_s, readings): pass"
    )

    with pytest.raises(BlamedError, match=r"^G.__init__ raised ZeroDiv.*\(guidance.py:3\)$"):
        Ship(tmp_path, text)


def test_commands_before_the_first_tick_are_refused(tmp_path):
    text = "class G:\n    def setup(self, context):\n        context.delta_v((1, 1, 1), at_s=1.0)"

    with pytest.raises(BlamedError, match="before the first tick"):
        Ship(tmp_path, text)


@pytest.mark.parametrize(
    "doing", ["delta_v((1, 1, 1), at_s=0.1)", "ballistic(0.01, at_s=9.0)", "send('*', 'bye')"]
)
def test_commands_and_messages_behind_the_last_tick_are_refused(tmp_path, doing):
    text = (
        "class G:\n"
        "    def setup(self, context): self.context = context\n"
        f"    def finish(self): self.context.{doing}"
    )
    ship = Ship(tmp_path, text)
    ship.run(0.1)

    with pytest.raises(BlamedError, match=r"no tick follows finish\(\).*\(guidance.py:3\)"):
        ship.agent.finish()

    assert not ship.context.records["commands"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("G = 3", "guidance.py:G"),
        ("def G(): pass", "expected a class, got function"),
        ("class G: pass", "at least one of the methods setup, step"),
        ("class G:\n    def __init__(self, x): pass\n    def step(self, t, r): pass", "arguments"),
        ("class G:\n    def step(self, t_s): pass", r"step\(\) must take \(self, t_s, readings\)"),
        (
            "class G:\n    async def step(self, t_s, readings): pass",
            r"step\(\) must be a plain def",
        ),
        ("class G:\n    def step(self, t_s, readings): yield", r"step\(\) must not yield"),
        (
            "class G:\n    async def receive(self, message): pass",
            r"receive\(\) must be a plain def",
        ),
        ("class H: pass", "no 'G'|has no"),
        ("import no_such_module_here", "no_such_module_here"),
    ],
)
def test_what_is_no_flight_software_is_named_at_set_up(tmp_path, text, words):
    with pytest.raises(BlamedError, match=f"parameters.flight: .*({words})"):
        Ship(tmp_path, text)


def test_what_is_cut_off_a_long_sentence_is_counted(tmp_path):
    ship = Ship(tmp_path, body("self.context.log('info', 'x' * 2005)")).run(0.1)

    assert ship.context.logs[0] == ("info", "x" * 2000 + "... (5 more characters)")


def test_a_vehicle_that_only_coasts_counts_what_nobody_hears(tmp_path):
    ship = Ship(tmp_path, flight={"agents": ["agent-02"]})
    ship.tell(delivery(0.1)).run(1.0)

    summary = ship.agent.finish()
    assert summary["messages_unheard"] == 1
    assert "flight" not in summary
    assert len(ship.context.records["state"]) == 10


def test_flight_software_runs_on_without_truth(tmp_path):
    text = (
        body("self.n = getattr(self, 'n', 0) + 1") + "\n    def finish(self): return {'n': self.n}"
    )
    ship = Ship(tmp_path, text, flight={"input": "truth"}).run(62.0)

    assert ship.flight == {"n": 620}
    assert ship.agent.finish()["underruns"] > 0


def test_chance_is_the_same_in_every_run(tmp_path):
    text = """
class G:
    def setup(self, context):
        self.drawn = context.random.normal()
    def finish(self):
        return {"drawn": self.drawn}
"""
    assert Ship(tmp_path, text).flight == Ship(tmp_path, text).flight
