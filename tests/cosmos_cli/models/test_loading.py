"""Golden texts: what a person sees for each kind of mistake, to the letter."""

import re
import textwrap
from pathlib import Path

import pytest

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from madns_runtime.config import Deadline, RunConfig, from_mapping, to_mapping

MINIMAL = "name: a\nsimulation: counter\nagents: {count: 3}\n"

PLUGIN = """
from __future__ import annotations
from dataclasses import dataclass
from typing import Annotated, Literal
from annotated_types import Ge, Gt
from madns_runtime.plugin.api import AgentSimulation, Simulation

@dataclass(frozen=True, kw_only=True)
class Slow:
    kind: Literal["slow"]
    delay_s: Annotated[float, Gt(0)] = 1.0

@dataclass(frozen=True, kw_only=True)
class Quick:
    kind: Literal["quick"]
    steps: int = 1

@dataclass(frozen=True, kw_only=True)
class Parameters:
    mass_kg: Annotated[float, Gt(0)]
    files: tuple[str, ...] = ()
    method: Slow | Quick = Quick(kind="quick")
    spare: int | None = None

def check(parameters, agents, base_directory):
    faults = [
        f"files[{i}]: no such file {name}"
        for i, name in enumerate(parameters.files)
        if not (base_directory / name).is_file()
    ]
    if parameters.mass_kg > agents:
        faults.append("mass_kg: expected at most one a agent")
    if parameters.spare == 0:
        faults.append("parameters.method.steps: expected more with spare: 0")
    if parameters.spare == 1:
        faults.append("spare and mass_kg do not fit together")
    if parameters.spare and parameters.spare > 1:
        faults += ["remark: spare: odd"] * parameters.spare
    return faults

class Agent(AgentSimulation):
    pass

simulation = Simulation(name="p", parameters=Parameters, agent=":Agent", check=":check")
"""


@pytest.fixture
def see(tmp_path, monkeypatch):
    """Return what a person sees for the text of a scenario."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.py").write_text(PLUGIN)

    def refused(text, *overrides):
        Path("a.yaml").write_text(textwrap.dedent(text))
        with pytest.raises(InputError) as caught:
            load_scenario(Path("a.yaml"), overrides)
        return str(caught.value)

    return refused


def golden(text):
    return textwrap.dedent(text).strip("\n")


@pytest.mark.process
def test_every_fault_of_a_file_is_shown_at_once_in_order(see):
    shown = see(
        """\
        name: Iridium10
        simulation: conter
        agents: {count: 10.5, tick_hz: 10, tickhz: 3}
        time: {mode: lokstep, duration_s: no}
        deadline:
          overrun_ms: -1
        executor: {kind: proces}
        sed: 3
        """
    )

    assert shown == golden(
        """
        a.yaml:1:7: name: expected lower-case letters, digits and hyphens, got 'Iridium10'
            name: Iridium10
                  ^
        a.yaml:2:13: simulation: no simulation named 'conter', did you mean counter?; installed are constellation, counter
            simulation: conter
                        ^
        a.yaml:3:17: agents.count: expected a whole number, got 10.5
            agents: {count: 10.5, tick_hz: 10, tickhz: 3}
                            ^
        a.yaml:3:36: agents.tickhz: unknown key, did you mean tick_hz?
            agents: {count: 10.5, tick_hz: 10, tickhz: 3}
                                               ^
        a.yaml:4:14: time.mode: expected realtime or lockstep, got 'lokstep', did you mean lockstep?
            time: {mode: lokstep, duration_s: no}
                         ^
        a.yaml:4:35: time.duration_s: expected a number, got 'no'
            time: {mode: lokstep, duration_s: no}
                                              ^
        a.yaml:6:15: deadline.overrun_ms: expected >= 0, got -1
              overrun_ms: -1
                          ^
        a.yaml:7:18: executor.kind: expected process, thread, dask or module:callable, got 'proces'
            executor: {kind: proces}
                             ^
        a.yaml:8:1: sed: unknown key, did you mean seed?
            sed: 3
            ^
        """
    )


def test_missing_keys_are_placed_at_what_lacks_them(see):
    assert see("name: a\nagents:\n  tick_hz: 3\n") == golden(
        """
        a.yaml:1:1: simulation: missing; expected a text
            name: a
            ^
        a.yaml:2:1: agents.count: missing; expected a whole number
            agents:
            ^
        """
    )


MISTAKES = [
    ("agents: {count: 0}", "a.yaml:3:17: agents.count: expected >= 1, got 0"),
    ("agents: {count: 1e4}", "a.yaml:3:17: agents.count: expected <= 5000, got 1e4"),
    ("agents: {count: '3'}", "a.yaml:3:17: agents.count: expected a whole number, got '3'"),
    ("agents: {count: yes}", "a.yaml:3:17: agents.count: expected a whole number, got 'yes'"),
    ("agents: {count: true}", "a.yaml:3:17: agents.count: expected a whole number, got true"),
    ("agents: {count: }", "a.yaml:3:17: agents.count: expected a whole number, got nothing"),
    ("agents: 3", "a.yaml:3:9: agents: expected a mapping, got 3"),
    ("agents: [3]", "a.yaml:3:9: agents: expected a mapping, got a list"),
    (
        "agents: {count: 3, phase: stagered}",
        "a.yaml:3:27: agents.phase: expected staggered or aligned, got 'stagered', "
        "did you mean staggered?",
    ),
    (
        "agents: {count: 3, names: [a, 2, c]}",
        "a.yaml:3:31: agents.names[1]: expected a text, got 2",
    ),
    (
        "agents: {count: 3, names: abc}",
        "a.yaml:3:27: agents.names: expected a list, got 'abc'",
    ),
    (
        "agents: {count: 3, tick_hz: 12:30}",
        "a.yaml:3:29: agents.tick_hz: expected a number, got '12:30'",
    ),
    (
        "agents: {count: 3, xyz: 1}",
        "a.yaml:3:20: agents.xyz: unknown key; known here: count, tick_hz, names, phase, "
        "per_process, restarts_max",
    ),
    (
        "agents: {count: 3, \u00a0tick_hz: 10}",
        "a.yaml:3:20: agents.\u00a0tick_hz: unknown key: it holds U+00A0, which looks like a space or like"
        " nothing; type the key anew",
    ),
    (
        "agents: {count: 3, names: [a, b]}",
        "a.yaml:3:27: agents.names: expected 3 names (agents.count), got 2",
    ),
    (
        "agents: {count: 3, names: [a, Host, c]}",
        "a.yaml:3:31: agents.names[1]: 'Host' is reserved; give the agent another name",
    ),
    (
        "agents: {count: 3, names: [a, b, A]}",
        "a.yaml:3:34: agents.names[2]: expected unique names, got 'A' again (first at [0])",
    ),
    (
        "agents: {count: 1, names: [../x]}",
        "a.yaml:3:28: agents.names[0]: expected letters, digits, '.', '_' or '-' "
        "(a folder is named after the agent), got '../x'",
    ),
    (
        "agents: {count: 3, per_process: 4}",
        "a.yaml:3:33: agents.per_process: expected <= agents.count (3), got 4",
    ),
    (
        "agents: {count: 3, restarts_max: 2}",
        "a.yaml:3:34: agents.restarts_max: expected 0 with on_agent_loss: abort, got 2; "
        "say on_agent_loss: continue",
    ),
    (
        "on_agent_loss: continue\nagents: {count: 3, restarts_max: 2, per_process: 3}",
        "a.yaml:4:34: agents.restarts_max: expected 0 with agents.per_process: 3, got 2: "
        "an agent that shares its process cannot be started again alone",
    ),
    (
        "agents: {count: 3}\nexecutor: {address: 'tcp://a:8786'}",
        "a.yaml:4:21: executor.address: expected nothing with executor.kind process; "
        "say kind: dask",
    ),
    (
        "agents: {count: 3}\nseed: 9223372036854775808",
        "a.yaml:4:7: seed: expected a whole number from -2^63 to 2^63 - 1, got 9223372036854775808:"
        " write one that need not be whole such as 1e20, and a text in quotes",
    ),
    (
        "agents: {count: 3}\ntime: {duration_s: 4e8}",
        "a.yaml:4:20: time.duration_s: expected <= 315576000, got 4e8",
    ),
    (
        "agents: {count: 3}\ntimeouts: {shutdown_s: 1e10}",
        "a.yaml:4:24: timeouts.shutdown_s: expected <= 315576000, got 1e10",
    ),
    (
        "agents: {count: 3}\nnetwork: {receive_buffer_bytes: 2147483648}",
        "a.yaml:4:33: network.receive_buffer_bytes: expected <= 2147483647, got 2147483648",
    ),
    (
        "agents: {count: 3}\nrecording: {flush_interval_s: 1e-9}",
        "a.yaml:4:31: recording.flush_interval_s: expected >= 0.001, got 1e-9",
    ),
    (
        "agents: {count: 3, tick_hz: .nan}",
        "a.yaml:3:29: agents.tick_hz: expected a finite number, got .nan",
    ),
    (
        "agents: {count: 3, tick_hz: 0.01}",
        "a.yaml:1:1: time.duration_s: expected at least one tick (100 s at 0.01 Hz), got 60",
    ),
]


@pytest.mark.parametrize(
    ("line", "shown"),
    MISTAKES,
)
def test_each_mistake_has_its_sentence(see, line, shown):
    text = f"name: a\nsimulation: counter\n{line}\n"

    assert see(text).split("\n")[0] == shown
    assert see(text).count("\n") == 2  # one fault: the sentence, the source, the caret


def test_numbers_that_are_not_finite_are_told_among_all_other_faults(see):
    shown = see(
        "name: a\nsimulation: counter\nagents: {count: .inf}\ntime: {duration_s: .nan}\nsed: 3\n"
    )

    assert [line for line in shown.splitlines() if line.startswith("a.yaml")] == [
        "a.yaml:3:17: agents.count: expected a finite number, got .inf",
        "a.yaml:4:20: time.duration_s: expected a finite number, got .nan",
        "a.yaml:5:1: sed: unknown key, did you mean seed?",
    ]


def test_sections_without_faults_are_checked_against_each_other_even_if_another_is_broken(see):
    shown = see("name: a\nsimulation: counter\nagents: {count: 2, names: [b]}\nseed: x\n")

    assert [line.split(" ")[1] for line in shown.splitlines() if line.startswith("a.yaml")] == [
        "agents.names:",
        "seed:",
    ]


MANY = """\
name: a
simulation: counter
seed: -1
agents: {count: 3, tick_hz: 10}
time: {duration_s: 5}
placement: [{agents: [agent-09], machines: pi01}]
agent_parameters: [{agents: [agent-08], parameters: {payload_byte: 500}}]
checks:
  - {name: b, stream: round_trip, field: packet, statistic: max, below: 10}
  - {name: c, stream: round_trips, field: packet, statistic: max, below: ten}
  - {name: d, event: agent_rejoined, agents: [host], before_s: 2, after: c}
  - {name: d, stream: ticks, field: tick, agents: [agent-07], above: 1}
timeline: [{at_s: 1, action: anotate, text: x}]
"""


@pytest.mark.parametrize("parameters", ["", "parameters: {payload_byte: 8}\n"])
def test_faults_of_all_sections_come_at_once_and_none_that_follows_from_another(see, parameters):
    """Those of checks, the timeline and parameters of some agents were told once all others were mended."""
    shown = see(MANY + parameters)

    places = [line.split(" ")[1] for line in shown.splitlines() if line.startswith("a.yaml")]
    of_streams = ["checks[0].stream:"]  # which those are follows from the parameters
    assert places == [
        "seed:",
        "placement[0].agents[0]:",
        "agent_parameters[0].agents[0]:",
        "agent_parameters[0].parameters.payload_byte:",
        *([] if parameters else of_streams),
        "checks[1].below:",
        "checks[3].name:",
        "checks[3].agents[0]:",
        "timeline[0].action:",
        *(["parameters.payload_byte:"] if parameters else []),
    ]


def test_streams_of_faulty_parameters_are_not_known_and_not_judged(see):
    shown = see(
        "name: a\nsimulation: counter\nagents: {count: 3}\nparameters: {payload_byte: 8}\n"
        "checks: [{name: a, stream: own, field: x, agents: [host], unit: m, below: 1, stop_when_broken: true}]\n"
        "timeline: [{when: {stream: own, field: x, agents: [host], unit: m, below: 1}, action: annotate, text: x}]\n"
    )

    assert shown.count("a.yaml") == 1
    assert "parameters.payload_byte" in shown


@pytest.mark.process
def test_required_parameters_that_are_missing_are_told_once_beside_rules(see):
    shown = see(
        PLUGGED
        + "parameters: {spare: 2}\n"
        + "agent_parameters: [{agents: ['*'], parameters: {spare: 1.5}}]\n"
    )

    assert [line.split(" ")[1] for line in shown.splitlines() if line.startswith("a.yaml")] == [
        "parameters.mass_kg:",
        "agent_parameters[0].parameters.spare:",
    ]


PLUGGED = "name: a\nsimulation: ./p.py:simulation\nagents: {count: 3}\n"


@pytest.mark.process
def test_faults_of_parameters_have_their_place(see):
    shown = see(
        PLUGGED
        + "parameters:\n  mass_kg: 0\n  files: [x, 3]\n  spare: 1.5\n  filse: []\n"
        + "  method: {kind: slow, delay_s: -1, steps: 3}\n"
    )

    assert shown == golden(
        """
        a.yaml:5:12: parameters.mass_kg: expected > 0, got 0
              mass_kg: 0
                       ^
        a.yaml:6:14: parameters.files[1]: expected a text, got 3
              files: [x, 3]
                         ^
        a.yaml:7:10: parameters.spare: expected a whole number, got 1.5
              spare: 1.5
                     ^
        a.yaml:8:3: parameters.filse: unknown key, did you mean files?
              filse: []
              ^
        a.yaml:9:33: parameters.method.delay_s: expected > 0, got -1
              method: {kind: slow, delay_s: -1, steps: 3}
                                            ^
        a.yaml:9:37: parameters.method.steps: unknown key; known here: kind, delay_s
              method: {kind: slow, delay_s: -1, steps: 3}
                                                ^
        """
    )


@pytest.mark.process
def test_missing_parameters_are_placed_at_the_section_or_the_file(see):
    assert see(PLUGGED).startswith("a.yaml:1:1: parameters.mass_kg: missing; expected a number\n")
    assert see(PLUGGED + "parameters: {spare: 2}\n").startswith(
        "a.yaml:4:1: parameters.mass_kg: missing; expected a number\n"
    )


@pytest.mark.process
def test_faults_that_the_simulation_finds_have_their_place(see):
    shown = see(PLUGGED + "parameters:\n  mass_kg: 9\n  files: [p.py, no.tle]\n  spare: 0\n")

    assert shown == golden(
        """
        a.yaml:4:1: parameters.method.steps: expected more with spare: 0
            parameters:
            ^
        a.yaml:5:12: parameters.mass_kg: expected at most one a agent
              mass_kg: 9
                       ^
        a.yaml:6:17: parameters.files[1]: no such file no.tle
              files: [p.py, no.tle]
                            ^
        """
    )


@pytest.mark.process
def test_fault_of_the_simulation_without_a_name_stands_at_parameters(see):
    shown = see(PLUGGED + "parameters: {mass_kg: 1, spare: 1}\n")

    assert shown.startswith("a.yaml:4:1: parameters: spare and mass_kg do not fit together\n")


@pytest.mark.process
def test_simulation_that_can_be_no_file_is_a_fault_of_its_place(see):
    shown = see(f"name: a\nsimulation: {'a' * 300}\nagents: {{count: 3}}\n")

    assert shown.startswith("a.yaml:2:13: simulation: not to be found: File name too long\n")


@pytest.mark.process
def test_fault_in_the_plugin_file_is_shown_with_both_places(see):
    Path("broken.py").write_text("x = 1\nx.nothing\n")

    shown = see("name: a\nsimulation: ./broken.py:simulation\nagents: {count: 3}\n")

    assert shown.startswith("a.yaml:2:13: simulation: ")
    assert "broken.py:2: AttributeError: 'int' object has no attribute 'nothing'" in shown


def test_faults_of_overrides_name_the_option_and_come_last(see):
    shown = see(
        "name: a\nsimulation: counter\nagents: {count: 3}\nseed: x\n",
        "agents.count=-1", "agents.tickhz=3", "parameters.service=bets", "nonsense",
    )  # fmt: skip

    assert shown == golden(
        """
        a.yaml:4:7: seed: expected a whole number, got 'x'
            seed: x
                  ^
        --set nonsense: expected KEY=VALUE, such as agents.count=5
        --set agents.count: expected >= 1, got -1
        --set agents.tickhz: unknown key, did you mean tick_hz?
        --set parameters.service: expected best, reliable or sync, got 'bets', did you mean best?
        """
    )


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("tme.duration_s=5", "tme: unknown key, did you mean time?"),
        ("time.duration.s=5", "time.duration: unknown key, did you mean duration_s?"),
        ("hardware.devises[0].x=1", "hardware.devises: unknown key, did you mean devices?"),
        ("agents.names[0]=a", "agents.names: expected 3 names (agents.count), got 1"),
    ],
)
def test_a_section_that_an_override_makes_is_blamed_on_the_option(see, override, told):
    shown = see("name: a\nsimulation: counter\nagents: {count: 3}\n", override)

    assert shown == f"--set {override.partition('=')[0]}: {told}"


def test_long_lines_are_shown_around_the_caret(see):
    names = ", ".join(f"agent-{i}" for i in range(40))

    shown = see(f"name: a\nsimulation: counter\nagents: {{count: 41, names: [{names}, /]}}\n")

    source, caret = shown.splitlines()[-2:]
    assert len(source) <= 110
    assert source[caret.index("^")] == "/"


def load(tmp_path, text, *overrides, **how):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    return load_scenario(path, overrides, **how)


def test_right_scenario_is_read_with_overrides_and_defaults(tmp_path):
    found = load(tmp_path, MINIMAL, "agents.tick_hz=100", "parameters.service=reliable")

    assert found.scenario.agents.tick_hz == 100.0
    assert found.scenario.deadline.overrun_ms == 5.0
    assert found.parameters["service"] == "reliable"
    assert found.base_directory == tmp_path
    assert found.text == MINIMAL


def test_old_name_of_a_key_is_read_with_a_remark_that_tells_the_new_one(tmp_path):
    told = []

    found = load(tmp_path, MINIMAL + "deadline: {tolerance_ms: 3}\n", warn=told.append)

    assert found.scenario.deadline == Deadline(overrun_ms=3.0)
    (remark,) = told
    line = MINIMAL.count("\n") + 1
    assert (
        f"a.yaml:{line}:12: deadline.tolerance_ms: is an old name: write deadline.overrun_ms"
        in (remark)
    )
    load(tmp_path, MINIMAL + "deadline: {overrun_ms: 3}\n", warn=told.append)
    assert told == [remark]


def test_old_name_beside_the_new_one_is_a_fault_with_its_place(see):
    old = "--set deadline.tolerance_ms: is the old name of deadline.overrun_ms, which is given as"
    written = "a.yaml:4:27: deadline.tolerance_ms: is the old name of deadline.overrun_ms"

    assert written in see(MINIMAL + "deadline: {overrun_ms: 1, tolerance_ms: 2}\n")
    shown = see(MINIMAL + "deadline: {overrun_ms: 1}\n", "deadline.tolerance_ms=2")
    assert shown == f"{old} well: leave it out"


def test_fault_of_a_value_under_an_old_name_stands_at_its_place(see):
    shown = see(MINIMAL + "deadline: {tolerance_ms: [1]}\n")

    assert "a.yaml:4:26: deadline.overrun_ms: expected a number, got a list" in shown
    assert "deadline: expected a mapping, got a list" in see(MINIMAL + "deadline: [1]\n")


def test_configuration_with_an_old_name_is_read(tmp_path):
    config = load(tmp_path, MINIMAL, "deadline.overrun_ms=3").run_config("0001-a")
    mapping = to_mapping(config)
    old = {**mapping, "deadline": {"tolerance_ms": 3.0, "max_miss_ratio": 1e-3}}

    assert from_mapping(RunConfig, old) == config


def test_run_config_holds_everything_and_survives_the_journey(tmp_path):
    found = load(tmp_path, MINIMAL)

    config = found.run_config("0001-a")

    assert (config.run, config.scenario, config.simulation) == ("0001-a", "a", "counter")
    assert config.parameters == {
        "service": "best",
        "payload_bytes": 0,
        "send_device": "",
        "answer_hz": 0.0,
        "read_on_tick": False,
        "host_round_trips": False,
    }
    assert from_mapping(RunConfig, to_mapping(config)) == config


def test_scenario_written_out_in_full_is_read_back_the_same(tmp_path):
    import yaml

    found = load(tmp_path, MINIMAL, "agents.names=[x, y, z]")

    again = load(tmp_path, yaml.safe_dump(found.to_mapping()))

    assert again.scenario.agents == found.scenario.agents
    assert again.to_mapping() == found.to_mapping()


def test_thousand_agents_with_names_are_read(tmp_path):
    names = ", ".join(f"sat-{i}" for i in range(1000))

    found = load(
        tmp_path, f"name: a\nsimulation: counter\nagents: {{count: 1000, names: [{names}]}}\n"
    )

    assert found.scenario.agents.names[999] == "sat-999"


def test_of_a_union_no_member_of_another_type_speaks_for_a_mapping(see):
    flight = "parameters: {flight: {command: [x], input: foo}}\n"
    shown = see("name: a\nsimulation: constellation\nagents: {count: 1}\n" + flight)

    assert (
        "a.yaml:4:44: parameters.flight.input: expected measurements or truth, got 'foo'" in shown
    )
    assert "expected a text" not in shown


@pytest.mark.process
def test_choice_that_no_member_of_a_union_knows_lists_those_of_all(see):
    shown = see(PLUGGED + "parameters: {mass_kg: 1, method: {kind: quik, steps: 2, x: 1}}\n")

    assert shown.splitlines()[0] == (
        "a.yaml:4:41: parameters.method.kind: expected slow or quick, got 'quik', "
        "did you mean quick?"
    )
    assert len(shown.splitlines()) == 3


ORBIT = (
    "satellites: {keplerian: [{name: A, altitude_km: 500, e: 1.2}, {name: B, altitude_km: 500}]}"
)
FLYING = "satellites: {walker: '56:1/1/0', altitude_km: 500}\n  flight: {command: [f], settings: "


@pytest.mark.parametrize(
    ("parameters", "shown"),
    [
        (ORBIT, ["parameters.satellites.keplerian[0].e: expected < 1, got 1.2"]),
        (
            ORBIT.replace("}, {name: B, altitude_km: 500}", "}"),
            ["parameters.satellites.keplerian[0].e: expected < 1, got 1.2"],
        ),
        (
            ORBIT.replace("e: 1.2}", "inc: 1}").replace("km: 500}]", "km: 500, inc: 1}]"),
            [
                f"parameters.satellites.keplerian[{number}].inc: unknown key; known here: name, a_km, "
                "altitude_km, e, i_deg, raan_deg, argp_deg, mean_anomaly_deg"
                for number in (0, 1)
            ],
        ),
        (
            "satellites: {keplerian: []}",
            ["parameters.satellites.keplerian: expected at least 1 items, got a list"],
        ),
        (
            FLYING + "{a: {b: 1}}}",
            [
                "parameters.flight.settings.a: "
                "expected true or false, a number, a text or a list, got a mapping"
            ],
        ),
        (
            FLYING + "{a: [{b: 1}]}}",
            ["parameters.flight.settings.a[0]: expected a number or a text, got a mapping"],
        ),
        (
            FLYING + "{a: [1, x]}}",
            ["parameters.flight.settings.a[1]: expected a number, got 'x'"],
        ),
    ],
)
def test_what_is_of_no_type_and_what_is_in_a_list_is_told_as_it_is(see, parameters, shown):
    text = MINIMAL.replace("counter", "constellation").replace("count: 3", "count: 1")

    told = see(f"{text}parameters:\n  {parameters}\n").splitlines()

    assert [line.split(": ", 1)[1] for line in told if line.startswith("a.yaml:")] == shown


@pytest.mark.process
def test_a_remark_of_the_simulation_is_no_fault_and_told_at_its_place(see, capsys):
    scenario = "name: a\nsimulation: ./p.py:simulation\nagents: {count: 2}\nparameters: {mass_kg: 1, spare: 2}\n"
    Path("a.yaml").write_text(scenario)

    assert app.run(["validate", "a.yaml"]) == 0

    told = capsys.readouterr()
    assert told.out.startswith("a.yaml: ok: ")
    assert told.err.count("note: a.yaml:4:33: parameters.spare: odd") == 2
    assert see(scenario, "parameters.mass_kg=3").count("odd") == 0


@pytest.mark.process
@pytest.mark.parametrize(
    ("kind", "code", "told"),
    [
        ("concurrent.futures:ThreadPoolExecutor", 0, ""),
        (
            "json:dumpz",
            2,
            "a.yaml:4:18: executor.kind: json:dumpz: .* has no 'dumpz', did you mean dump",
        ),
        ("json:__all__", 2, "executor.kind: json:__all__: expected a function, got list"),
        (
            "json.nothing:make",
            2,
            "executor.kind: json.nothing:make: No module named 'json.nothing'",
        ),
        (
            "nosuch.pool:make",
            0,
            "note: a.yaml:4:18: executor.kind: no module nosuch.pool is found here: the run needs it",
        ),
    ],
)
def test_an_executor_of_ones_own_is_looked_for(see, capsys, kind, code, told):
    Path("a.yaml").write_text(MINIMAL + f'executor: {{kind: "{kind}"}}\n')

    assert app.run(["validate", "a.yaml"]) == code

    assert re.search(told, capsys.readouterr().err)


@pytest.mark.process
def test_of_very_many_remarks_the_first_are_told_and_the_rest_is_counted(see, capsys):
    Path("a.yaml").write_text(
        "name: a\nsimulation: ./p.py:simulation\nagents: {count: 2}\nparameters: {mass_kg: 1, spare: 9999}\n"
    )

    assert app.run(["validate", "a.yaml"]) == 0

    notes = capsys.readouterr().err.count(": odd")
    assert 0 < notes < 9999
    assert app.run(["validate", "a.yaml"]) == 0
    assert f"{9999 - notes} more remarks" in capsys.readouterr().err


HEAD = "name: a\nagents: {count: 1}\nsimulation: "
CONSTELLATION = 'constellation\nparameters: {satellites: {altitude_km: 500, walker: "53:1/1/0"}, '
LONG = "x" * 300
"""No file has such a name, and to look whether one has is an error, as it is in a folder that may not be entered."""


@pytest.mark.process
@pytest.mark.parametrize(
    ("text", "told"),
    [
        (f"counter\nrequirements: [./{LONG}]", "requirements[0]: "),
        (f"counter\ntest: {{baseline: {LONG}.yaml}}", "test.baseline: "),
        (
            "counter\nhardware: {devices: [{name: mcu, kind: emulated_mcu, agents: ['*'],"
            f" parameters: {{firmware: {LONG}}}}}]}}",
            "hardware.devices[0].parameters.firmware: no file ",
        ),
        (
            f"{CONSTELLATION}flight: {{command: [{LONG}]}}}}",
            "parameters.flight.command: no program",
        ),
    ],
)
def test_file_that_cannot_be_looked_for_is_told_at_its_place(tmp_path, capsys, text, told):
    path = tmp_path / "a.yaml"
    path.write_text(HEAD + text + "\n")

    assert app.run(["validate", str(path)]) == 2

    said = capsys.readouterr()
    assert told in said.out + said.err
    assert "defect" not in said.err


@pytest.mark.parametrize("arguments", [["test", LONG], ["inventory", "-i", LONG]])
def test_argument_that_no_file_can_be_called_is_bad_input(capsys, arguments):
    assert app.run(arguments) == 2
    assert "defect" not in capsys.readouterr().err


def test_in_lockstep_agents_that_share_a_process_may_be_started_again(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(
        "name: a\nsimulation: counter\nagents: {count: 3, restarts_max: 2, per_process: 3}\n"
        "on_agent_loss: continue\ntime: {mode: lockstep, duration_s: 5}\n"
    )

    assert load_scenario(path).scenario.agents.restarts_max == 2
