"""Expectations of a scenario: what is wrong with one is told with its place, what was expected, and what was meant."""

import re

import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.models.expectation import conditions_of_checks
from cosmos_cli.models.loading import check_scenario
from madns_runtime.conditions.condition import ValueBounds

HEAD = """\
name: broken
simulation: counter
agents: {count: 3, tick_hz: 20}
time: {duration_s: 60}
hardware:
  use: [{devices: [gps]}]
  devices:
    - {name: imu, kind: synthetic, agents: [agent-02], parameters: {channels: [{name: gyro, unit: rad/s}]}}
checks:
"""
FIRST_LINE = HEAD.count("\n") + 1
PACKET = "name: a, stream: round_trips, field: packet"
TICKS = "name: a, stream: ticks, field: lateness_us"
HEALTH = "name: a, stream: health, field: cpu_percent"
GYRO = "name: a, stream: imu.gyro, field: gyro"
FIX = "name: a, stream: gps.fix, field: fix"
START = "name: a, event: start"


def load(*checks, folder):
    text = HEAD + "".join(f"  - {{{check}}}\n" for check in checks)
    return check_scenario(text, folder / "scenario.yaml")


BROKEN = [
    ("stream: ticks, field: margin_us, above: 0", "{stream", "missing"),
    ("name: 7up, stream: ticks, field: margin_us, above: 0", "7up", "begins with a letter"),
    ("name: agents.lost, stream: ticks, field: missed, below: 1", "agents.lost", "framework's own"),
    ("name: a, stream: tics, field: margin_us, above: 0", "tics", "did you mean ticks?"),
    ("name: a, stream: rounds, field: packet, above: 0", "rounds", "no stream 'rounds'"),
    (f"{HEALTH}, below: 90, agents: [agent-01]", "agent-01", "recorded per machine: leave out"),
    (f"{HEALTH}, below: 90, from_s: 3", "3}", "health tell no time"),
    (f"{HEALTH}, below: 90, stop_when_broken: true", "true", "recorded by a machine and not by"),
    ("name: a, stream: health, field: ram_percnt, below: 90", "ram_percnt", "did you mean ram_percent?"),
    ("name: a, stream: log, field: levl, equals: error", "levl", "did you mean level?"),
    ("name: a, stream: imu, field: gyro, below: 1", "imu", "such as imu.gyro, imu.device_state"),
    ("name: a, stream: imu.giro, field: gyro, below: 1", "imu.giro", "did you mean imu.gyro?"),
    ("name: a, stream: mu.gyro, field: gyro, below: 1", "mu.gyro", "did you mean imu.gyro?"),
    ("name: a, stream: imu.gyro, field: gyro_x, below: 1", "gyro_x", "did you mean gyro?"),
    (f"{GYRO}, below: 1, unit: deg", "deg", "gyro is in rad/s, got 'deg'"),
    (f"{GYRO}, below: 1, agents: [agent-01]", "agent-01", "does not use what records imu.gyro: agent-02/imu"),
    (f"{GYRO}, below: 1, agents: [agent-2]", "agent-2", "did you mean agent-02?"),
    (f"{GYRO}, below: 1, stop_when_broken: true", "true", "recorded by a device and not by agents"),
    (f"{FIX}, below: 1, agents: [agent-01]", "agent-01", "of a device of an inventory"),
    (f"{FIX}, below: 1, while: {{stream: clock, field: t_s, below: 1}}", "clock", "the host's half"),
    (f"{TICKS}, below: 3, while: {{stream: gps.fix, field: fix, below: 1}}", "gps.fix", "the host's half"),
    (f"{TICKS}, below: 3, while: {{stream: health, field: cpu_percent, below: 1}}", "health", "no simulated time"),
    ("name: a, stream: ticks, field: margn_us, above: 0", "margn_us", "did you mean margin_us?"),
    ("name: a, stream: ticks, below: 1", "{name", "expected a field of stream ticks"),
    ("name: a, below: 1", "{name", "expected a stream, or an event"),
    (PACKET, "{name", "expected a limit: one of below, above, within, equals"),
    (f"{PACKET}, below: 1, above: 0", "0}", "got below as well: a range is within: [low, high]"),
    (f"{PACKET}, below: 1, equals: 0", "0}", "got below as well: leave one out"),
    (f"{PACKET}, below: fast", "fast", "expected a number"),
    (f"{PACKET}, below: .nan", ".nan", "finite"),
    (f"{PACKET}, within: [2, 1]", "[2", "the lesser bound first"),
    (f"{PACKET}, within: [2]", "within", ""),
    (f"{PACKET}, equals: three", "three", "holds no texts: expected a number"),
    (f"{PACKET}, equals: 9007199254740993", "9007", "from 2^53 on are compared as floats"),
    (f"{PACKET}, equals: true", "true", "holds numbers, got true"),
    (f"{PACKET}, below: 3, tolerance: 1", "1}", "goes with equals and a number"),
    (f"{PACKET}, equals: 3, tolerance: -1", "-1", "expected >= 0"),
    (f"{PACKET}, below: 3, unit: m", "m}", "packet has no unit, got 'm'"),
    (f"{TICKS}, below: 3, unit: km", "km", "is in us, got 'km': leave out unit, or write one"),
    (f"{TICKS}, below: 1e308, unit: h", "1e308", "1e+308 h is more than a number in us can tell"),
    (f"{TICKS}, within: [-1e308, 0], unit: h", "[-1e308", "-1e+308 h is more than a number in us can tell"),
    (f"{TICKS}, equals: 3, tolerance: 1e308, unit: h", "1e308", "1e+308 h is more than a number in us"),
    (f"{TICKS}, statistic: count, below: 3, when: {{above: 1e308}}, unit: h", "1e308", "1e+308 h is more than"),
    (f"{TICKS}, below: 3, while: {{stream: ticks, field: margin_us, above: 1e308, unit: h}}", "1e308", "1e+308 h is more than"),
    (f"{TICKS}, below: 3, unit: parsec", "parsec", "is in us, got 'parsec'"),
    (f"{TICKS}, below: 3, agents: [agent-7]", "agent-7", "no agent is named agent-7"),
    (f"{TICKS}, below: 3, agents: [agnt-02]", "agnt-02", "did you mean agent-02?"),
    (f"{TICKS}, below: 3, agents: [host]", "host", "recorded by agents, not by the host's half"),
    (f"{TICKS}, below: 3, from_s: 60", "60}", "expected less than time.duration_s (60), got 60"),
    (f"{TICKS}, below: 3, from_s: 9, to_s: 8", "8}", "expected >= from_s (9), got 8"),
    (f"{TICKS}, below: 3, from_s: -1", "-1", "expected >= 0"),
    (f"{PACKET}, below: 3, from_s: 1", "1}", "tell no time"),
    (f"{TICKS}, below: 3, statistic: median", "median", "expected each, last"),
    (f"{TICKS}, below: 3, statistic: settled", "settled", "settled needs when"),
    (f"{TICKS}, below: 3, statistic: mean, when: {{below: 3}}", "{below", "not with mean"),
    (f"{TICKS}, below: 3, statistic: mean, at_end: true", "true", "expected statistic last"),
    (f"{TICKS}, below: 3, statistic: first_time, when: {{}}", "{}", "expected a limit"),
    ("name: a, stream: ticks, statistic: count, below: 3, unit: s", "s}", "a count has none"),
    (f"{TICKS}, equals: true, statistic: count", "true", "a count is a number"),
    ("name: a, stream: events, field: event, below: 3", "3}", "holds texts: expected equals"),
    ("name: a, stream: events, field: event, equals: x, statistic: mean", "mean", "has no mean"),
    (f"{TICKS}, below: 3, must: occur", "occur", "is of an event"),
    (f"{TICKS}, below: 3, before_s: 3", "3}", "is of an event"),
    (f"{START}, below: 3", "3}", "is of a field's values"),
    (f"{START}, statistic: max", "max", "is of a field's values"),
    (f"{START}, field: t_s", "t_s", "holds no words"),
    (f"{START}, must: happen", "happen", "expected occur or not_occur"),
    (f"{START}, within_s: 3", "3}", "name it under after"),
    (f"{START}, after: b", "b}", "no check above is named 'b'"),
    (f"{START}, from_s: 5, before_s: 3", "3}", "expected >= from_s (5), got 3"),
    (f"{START}, stop_when_broken: true", "true", "goes with must: not_occur"),
    (f"{TICKS}, below: 3, statistic: p99, stop_when_broken: true", "true", "is known at the end"),
    (f"{TICKS}, above: 3, statistic: max, stop_when_broken: true", "true", "one record can break"),
    (f"{TICKS}, below: 3, while: {{stream: tick, field: x, below: 1}}", "tick,", "did you mean tick"),
    (f"{TICKS}, below: 3, while: {{stream: clock, field: x, below: 1}}", "x,", "has no field 'x'"),
    (f"{TICKS}, below: 3, while: {{stream: clock, field: t_s}}", "{stream", "expected a limit"),
    ("name: a, stream: log, statistic: count, below: 3, agents: [host], while: {stream: clock, field: t_s, below: 1}", "clock", "the host's half"),
    ("name: a, stream: log, statistic: count, below: 3, agents: [host, '*'], while: {stream: ticks, field: tick, below: 1}", "ticks", "the host's half"),
    (f"{TICKS}, below: 3, whil: 3", "whil", "did you mean while?"),
    ("name: a, event: emergancy, must: not_occur", "emergancy", "did you mean emergency?"),
    ("name: a, event: agent_rejoined, must: not_occur", "agent_rejoined", "host's half alone: write agents: [host]"),
    ("name: a, event: fault, agents: ['agent-*']", "fault", "an event of the host's half alone"),
    ("name: a, event: killed, must: not_occur, agents: [host]", "killed", "an event of agents alone: leave out"),
    ("name: a, stream: events, field: event, statistic: count, when: {equals: agent}, below: 1", "agent}", "the host's half"),
    (f"{TICKS}, below: 3, while: {{stream: events, field: event, equals: agent}}", "agent}", "of the host's half alone"),
    ("name: a, event: burn", "burn", "own words stand in its own streams: name one under stream"),
    ("name: a, stream: log, event: eror, field: level", "eror", "did you mean error?"),
    ("name: a, stream: imu.events, event: opend", "opend", "did you mean opened?"),
    ("name: a, stream: log, field: level, statistic: count, when: {equals: eror}, below: 1", "eror", "mean error?"),
    ("name: a, stream: events, field: event, equals: strt, at_end: true", "strt", "did you mean start?"),
    (f"{TICKS}, below: 3, while: {{stream: events, field: event, equals: strt}}", "strt", "did you mean start?"),
    ("name: summary.x, event: start", "summary.x", "framework's own"),
    ("name: a, stream: ticks, statistic: rate, above: 1, from_s: 3, to_s: 3", "3}", "of a stretch of time"),
    ("name: a, stream: ticks, statistic: count, below: 0", "0}", "a count is never less than 0: below 0 never holds"),
    ("name: a, stream: ticks, statistic: count, within: [1.2, 1.8]", "[1.2", "a count is a whole number: within 1.2 and 1.8 never holds"),
    ("name: a, stream: ticks, statistic: count, equals: 1.5", "1.5}", "a count is a whole number"),
    ("name: a, stream: ticks, statistic: rate, within: [-3, -1]", "[-3", "never less than 0"),
    (f"{TICKS}, statistic: first_time, when: {{above: 3}}, below: 5, from_s: 9", "5,", "from 9 s to 60 s"),
    (f"{TICKS}, statistic: settled, when: {{above: 3}}, above: 60", "60}", "from 0 s to 60 s: above 60 s never holds"),
    (f"{TICKS}, statistic: settled, when: {{above: 3}}, equals: 70, to_s: 50", "70,", "from 0 s to 50 s"),
    (f"{TICKS}, below: 3, statistic: rate, while: {{stream: clock, field: t_s, below: 1}}", "{stream", "rate"),
]  # fmt: skip


TIME_OF = "name: a, stream: ticks, field: lateness_us, statistic: settled, when: {above: 3}"


@pytest.mark.parametrize(
    "check",
    [
        f"{TIME_OF}, within: [50, 80]",
        f"{TIME_OF}, equals: 60",
        f"{TIME_OF}, above: 59",
        f"{TIME_OF}, below: 9, from_s: 8.5",
        "name: a, stream: ticks, statistic: count, equals: 0",
        "name: a, event: action_began, agents: [host, '*']",
        "name: a, stream: log, statistic: count, below: 3, agents: [host], while: {stream: events, field: event, equals: agent}",
        "name: a, event: killed, agents: [host, agent-01], must: not_occur",
        "name: a, event: emergency, must: not_occur",
        "name: a, event: emergency, agents: [host], must: not_occur",
        "name: a, event: anything, field: action, agents: [host]",
    ],
)
def test_what_may_hold_is_not_refused(tmp_path, check):
    assert len(load(check, folder=tmp_path).expectations) == 1


@pytest.mark.parametrize(("check", "at", "told"), BROKEN)
def test_a_broken_expectation_is_refused_with_place_and_cure(tmp_path, check, at, told):
    with pytest.raises(InputError) as refused:
        load(check, folder=tmp_path)

    fault = next(each for each in refused.value.faults if told in each.text)
    assert fault.line == FIRST_LINE
    line = f"  - {{{check}}}"
    assert fault.column and line[fault.column - 1 :].startswith(at), line[fault.column - 1 :]
    assert re.search(rf"scenario.yaml:{FIRST_LINE}:\d+: checks", fault.render())


START_OF = "name: first, event: emergency, agents: [%s]"


@pytest.mark.parametrize(
    ("first", "told"),
    [
        (START_OF % "agent-01, agent-02", "first is of agent-01, agent-02, and this of agent-03 too"),
        ("name: first, event: start, must: not_occur", "first has no time: expected an event that must"),
        (f"{PACKET.replace('name: a', 'name: first')}, above: 0", "first has no time"),
    ],
)  # fmt: skip
def test_an_event_comes_after_what_its_agents_have_a_time_of(tmp_path, first, told):
    with pytest.raises(InputError) as refused:
        load(first, "name: a, event: end, after: first", folder=tmp_path)

    (fault,) = refused.value.faults
    assert (fault.path, told in fault.text) == ("checks[1].after", True), fault.text


@pytest.mark.parametrize("agents", ["agent-01", "host", "host, agent-01", "'*'"])
def test_events_of_all_may_come_after_one_of_all_of_one_agent_or_of_the_host(tmp_path, agents):
    scenario = load(START_OF % agents, "name: a, event: end, after: first", folder=tmp_path)

    assert len(scenario.expectations) == 2


@pytest.mark.parametrize(
    "limit", ["below: .nan", "above: 1e400", "below: '${no}'", "within: [0, .inf]"]
)
def test_a_limit_that_is_no_number_is_one_fault(tmp_path, limit):
    with pytest.raises(InputError) as refused:
        load(f"{TICKS}, {limit}", folder=tmp_path)

    assert [each.path.startswith("checks[0].") for each in refused.value.faults] == [True]


def test_all_faults_are_told_at_once(tmp_path):
    with pytest.raises(InputError) as refused:
        load(
            "name: a, stream: tics, field: margin_us, above: 0",
            "name: a, stream: ticks, field: margin, above: 0, agents: [agent-9]",
            "name: b, event: start, after: a",
            folder=tmp_path,
        )

    places = [(each.line - FIRST_LINE, each.path) for each in refused.value.faults]
    assert places == [
        (0, "checks[0].stream"),
        (1, "checks[1].name"),
        (1, "checks[1].field"),
        (1, "checks[1].agents[0]"),
        (2, "checks[2].after"),
    ]


@pytest.mark.parametrize(
    ("mode", "checks", "told"),
    [
        ("lockstep", [f"{TICKS}, below: 3"], ["none can be judged, such as a: runs in lockstep"]),
        ("lockstep", [f"{TICKS}, below: 3", "name: b, event: start"], []),
        (
            "lockstep",
            [
                f"{TICKS}, statistic: first_time, when: {{above: 1}}, above: 0",
                "name: b, event: end, after: a",
            ],
            ["none can be judged, such as a: runs in lockstep"],
        ),
        ("realtime", [f"{TICKS}, below: 3"], []),
        ("lockstep", [], []),
    ],
)
def test_checks_none_of_which_can_be_judged_are_told_before_the_run(tmp_path, mode, checks, told):
    text = "".join(f"  - {{{check}}}\n" for check in checks)
    found = check_scenario(
        f"name: a\nsimulation: counter\nagents: {{count: 1}}\ntime: {{mode: {mode}, duration_s: 1}}\n"
        + (f"checks:\n{text}" if text else ""),
        tmp_path / "scenario.yaml",
    )

    assert len(found.remarks) == len(told)
    assert all(words in remark.text for words, remark in zip(told, found.remarks, strict=True))


@pytest.mark.parametrize("limit", ["equals: -1e+308, tolerance: 1.7e+308", "within: [1.2, 2]"])
def test_a_limit_that_a_count_can_keep_is_no_fault(tmp_path, limit):
    assert load(f"name: a, stream: ticks, statistic: count, {limit}", folder=tmp_path).expectations


def test_a_device_with_faults_of_its_own_is_still_one_of_its_agents(tmp_path):
    """Whoever mistyped a parameter of it was told that the device were of an inventory."""
    text = HEAD.replace("name: gyro, unit", "name: gyro, unyt") + (
        "  - {name: a, stream: imu.gyro, field: gyro, below: 1, agents: [agent-02]}\n"
        "  - {name: b, stream: imu.gyro, field: gyro, below: 1, agents: [agent-01]}\n"
    )

    with pytest.raises(InputError) as refused:
        check_scenario(text, tmp_path / "scenario.yaml")

    assert [each.path for each in refused.value.faults] == [
        "hardware.devices[0].parameters.channels[0].unyt",
        "checks[1].agents[0]",
    ]
    assert "does not use what records" in refused.value.faults[1].text


def test_more_checks_than_are_followed_are_refused(tmp_path):
    many = [f"name: c{number}, event: start" for number in range(1001)]

    with pytest.raises(InputError, match="at most 1000 items"):
        load(*many, folder=tmp_path)


def test_an_expectation_names_its_agents_and_says_itself_in_words(tmp_path):
    scenario = load(
        "name: a, stream: ticks, field: lateness_us, statistic: p99, below: 5, unit: ms, agents: ['*-0[12]']",
        "name: b, event: state, agents: [host], before_s: 9",
        "name: c, stream: round_trips, statistic: count, above: 3",
        folder=tmp_path,
    )

    first, second, third = scenario.expectations
    assert first.agents == ("agent-01", "agent-02")
    assert first.words == "p99 of ticks.lateness_us below 5 ms"
    assert first.only_realtime
    assert (second.agents, second.to_s) == (("host",), 9.0)
    assert second.words == "state in events must occur by 9 s"
    assert third.agents == ("agent-01", "agent-02", "agent-03")


def test_streams_of_devices_logs_and_machines_are_known(tmp_path):
    scenario = load(
        f"{GYRO}, below: 90, unit: deg/s, while: {{stream: imu.device_state, field: errors, below: 1}}",
        "name: b, stream: log, event: error, field: level, must: not_occur",
        "name: c, stream: health, field: core_temperature_c, below: 80",
        "name: d, stream: health, field: cpu_percent, agents: [host], below: 80",
        "name: e, stream: gps.fix, field: anything, below: 80, unit: m",
        folder=tmp_path,
    )

    found = [(each.agents, each.only_realtime) for each in scenario.expectations]
    assert found == [
        (("agent-02/imu",), False),
        (("agent-01", "agent-02", "agent-03"), False),
        ((), True),
        (("host",), True),
        ((), False),
    ]


@pytest.mark.parametrize(
    ("check", "bounds", "times"),
    [
        (f"{TICKS}, below: 5, unit: ms", ValueBounds.below(5000.0).negated(), 1),
        (f"{TICKS}, statistic: max, within: [1, 2]", ValueBounds(high=2.0).negated(), 1),
        (f"{TICKS}, statistic: min, above: 1", ValueBounds.above(1.0).negated(), 1),
        (
            f"{TICKS}, statistic: count, below: 3, when: {{above: 2}}, unit: ms",
            ValueBounds.above(2000.0),
            3,
        ),
        (f"{TICKS}, statistic: count, within: [0, 3]", ValueBounds(), 4),
        (f"{TICKS}, statistic: count, below: 1.0e+308", ValueBounds(), 2**53),
        (f"{START}, must: not_occur", ValueBounds.equals("start"), 1),
    ],
)
def test_an_expectation_that_ends_the_run_is_broken_by_one_condition(
    tmp_path, check, bounds, times
):
    scenario = load(f"{check}, stop_when_broken: true", folder=tmp_path)

    (condition,) = conditions_of_checks(scenario.expectations)
    assert (condition.bounds, condition.times, condition.ends_run) == (bounds, times, True)
    assert scenario.run_config("0001-x").conditions == (condition,)


def test_checks_are_plain_values_that_a_scenario_can_be_written_from(tmp_path):
    scenario = load(
        f"{TICKS}, below: 3, while: {{stream: clock, field: t_s, above: 1}}", folder=tmp_path
    )

    (written,) = scenario.to_mapping()["checks"]
    assert written["while"]["stream"] == "clock"


WORDY = """
from dataclasses import dataclass
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Simulation
from madns_runtime.recording.records import Field
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    pass
class Agent(AgentSimulation):
    pass
def streams(parameters, agents):
    word = Field("state", "", "str", words=("open", "shut"))
    fields = (Field("t_s", "s"), word, Field("why", "", "str"))
    return [DeclaredStream(role="agent", name="doors", fields=fields)]
simulation = Simulation(name="wordy", parameters=Parameters, agent=":Agent", streams=":streams")
"""


@pytest.mark.process
def test_a_word_is_known_where_the_simulation_declares_all_of_a_field(tmp_path):
    (tmp_path / "wordy.py").write_text(WORDY)
    head = "name: a\nsimulation: ./wordy.py:simulation\nagents: {count: 1}\nchecks:\n"
    rules = ("field: state, event: shut", "field: why, event: shut", "field: state, event: shutt")
    checks = [f"{head}  - {{name: a, stream: doors, {rule}, must: not_occur}}\n" for rule in rules]
    declared, free = (check_scenario(text, tmp_path / "a.yaml") for text in checks[:2])

    assert [each.expectations[0].has_known_words for each in (declared, free)] == [True, False]
    with pytest.raises(InputError, match=r"never holds 'shutt' in state, did you mean shut\?"):
        check_scenario(checks[2], tmp_path / "a.yaml")
