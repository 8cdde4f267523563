"""Parameters of every kind reach host and agents as what their class says, in either time mode, and come back from plan.json."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from annotated_types import Gt
from harness.cosmos_command import CosmosCommand

from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.schema import scenario_schema
from madns_runtime.config import RunConfig, from_mapping, to_mapping
from madns_runtime.plugin.api import ActionKind, Simulation
from madns_runtime.plugin.registry import parse_parameters, resolve

pytestmark = pytest.mark.process

PLUGIN = '''
from __future__ import annotations
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum, IntEnum, StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal
from annotated_types import Ge
from madns_runtime.plugin.api import AgentSimulation, Demand, HostSimulation, Simulation

class Colour(Enum):
    RED = "red"
    BLUE = "blue"

class Gear(IntEnum):
    LOW = 1
    HIGH = 2

class Mood(StrEnum):
    CALM = "calm"

@dataclass(frozen=True, kw_only=True)
class Wheel:
    radius_m: Annotated[float, Ge(0)] = 0.3
    colour: Colour = Colour.RED

@dataclass(frozen=True, kw_only=True)
class Sail:
    area_m2: float

@dataclass(frozen=True, kw_only=True)
class Parameters:
    table: Path
    """A file beside the scenario."""
    colour: Colour = Colour.RED
    gear: Gear = Gear.LOW
    mood: Mood = Mood.CALM
    mode: Literal["slow", "quick", 3] = "slow"
    wheel: Wheel = Wheel()
    drive: Wheel | Sail = Wheel()
    wheels: tuple[Wheel, ...] = ()
    position_m: tuple[float, float, str] = (0.0, 0.0, "up")
    names: list[str] = field(default_factory=list)
    by_name: dict[str, Wheel] = field(default_factory=dict)
    paths: Mapping[str, list[Path]] = field(default_factory=dict)
    spare: Path | None = None
    either: Path | str | int | None = None
    number: float | int = 1.5
    anything: Any = None

EXPECTED = Parameters(
    table=Path("data/a.csv"),
    colour=Colour.BLUE,
    gear=Gear.HIGH,
    mood=Mood.CALM,
    mode="quick",
    wheel=Wheel(radius_m=0.5, colour=Colour.BLUE),
    drive=Sail(area_m2=4.0),
    wheels=(Wheel(radius_m=1.0), Wheel(colour=Colour.BLUE)),
    position_m=(1.0, 2.0, "down"),
    names=["a", "b"],
    by_name={"left": Wheel(radius_m=2.0)},
    paths={"x": [Path("p"), Path("q")]},
    spare=Path("spare.csv"),
    either="text",
    number=3,
    anything={"deep": [1, {"er": None}]},
)

def wrong(parameters):
    if parameters != EXPECTED or repr(parameters) != repr(EXPECTED):
        return [f"parameters: got {parameters!r}"]
    return []

def check(parameters, agents, base_directory):
    return wrong(parameters)

def demand(parameters, agents, tick_hz, base_directory):
    assert not wrong(parameters)
    return Demand(
        flows=(), buffer_s=10.0, batch_bytes=0, batch_compute_s=0.0, sync_bytes=0,
        sync_compute_s=0.0, sync_rate_hz=0.0, lead_s=0.0, measured=False,
    )

class Half:
    def setup(self, context, *initial):
        self.wrong = wrong(context.parameters)
    def finish(self):
        passed = not self.wrong
        return {"wrong": self.wrong, "checks": [
            {"name": "parameters", "limit": 0.0, "got": 0.0 if passed else 1.0, "passed": passed}
        ]}

class Agent(Half, AgentSimulation):
    pass

class Host(Half, HostSimulation):
    pass

simulation = Simulation(
    name="kinds", parameters=Parameters, agent=":Agent", host=":Host", check=":check",
    demand=":demand",
)
'''
SCENARIO = """
name: kinds
simulation: ./kinds.py:simulation
agents: {count: 2, tick_hz: 10}
time: {duration_s: 1}
parameters:
  table: data/a.csv
  colour: blue
  gear: 2
  mood: calm
  mode: quick
  wheel: {radius_m: 0.5, colour: blue}
  drive: {area_m2: 4}
  wheels: [{radius_m: 1}, {colour: blue}]
  position_m: [1, 2, down]
  names: [a, b]
  by_name: {left: {radius_m: 2}}
  paths: {x: [p, q]}
  spare: spare.csv
  either: text
  number: 3
  anything: {deep: [1, {er: null}]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "kinds.py").write_text(PLUGIN)
    (tmp_path / "a.yaml").write_text(SCENARIO)
    return tmp_path


def cosmos(folder: Path, *arguments: str) -> str:
    done = CosmosCommand(folder)(*arguments)
    assert done.returncode in (0, 4), done.stdout + done.stderr
    return done.stdout


def test_plan_asks_with_the_typed_object(folder):
    told = json.loads(cosmos(folder, "plan", "a.yaml", "--latency-ms", "0.1", "--json"))

    assert len(told["feasibility"]["inequalities"]) == 4


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_host_and_agents_get_the_typed_object(folder, mode):
    cosmos(folder, "run", "a.yaml", "--set", f"time.mode={mode}")
    run = folder / "runs/0001-kinds"
    result = json.loads((run / "run.json").read_text())
    own = [check for check in result["checks"] if check["name"] == "parameters"]

    assert len(own) == 2, "the host and, of all agents, the worst"
    assert all(check["passed"] for check in own), result["simulation"]

    plan = json.loads((run / "plan.json").read_text())
    mapping = from_mapping(RunConfig, plan["config"]).parameters
    simulation = resolve("./kinds.py:simulation", folder)
    again = parse_parameters(simulation, mapping)
    module = sys.modules[type(again).__module__]

    assert again == module.EXPECTED
    assert to_mapping(again) == mapping


def test_the_schema_knows_every_kind(folder):
    simulation = resolve("./kinds.py:simulation", folder)
    schema = scenario_schema({"kinds": simulation})
    fields = schema["$defs"]["Parameters"]["properties"]

    assert fields["table"]["format"] == "path"
    assert schema["$defs"]["Colour"]["anyOf"][0]["enum"] == ["red", "blue"]
    assert fields["mode"]["enum"] == ["slow", "quick", 3]
    assert fields["position_m"]["prefixItems"][2]["type"] == "string"
    # What a scenario must say that extends no other one.
    whole = schema["allOf"][1]["then"]["else"]
    assert "table" in whole["properties"]["parameters"]["required"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Share:
    factor: Annotated[float, Gt(0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    share: Share


@pytest.mark.parametrize("parameters", [Grid, Share])
def test_the_schema_knows_actions_that_have_one_class_of_parameters(parameters):
    actions = tuple(
        ActionKind(word=word, summary=word, parameters=Share) for word in ("trip", "shed")
    )
    of_two = {
        name: Simulation(name=name, parameters=parameters, agent="x:Y", actions=actions)
        for name in ("grid", "grid-two")
    }

    schema = scenario_schema(of_two)

    for choice in schema["allOf"][1:]:
        rules = choice["then"]["properties"]["timeline"]["items"]["allOf"]
        found = [rule["then"]["properties"]["factor"]["exclusiveMinimum"] for rule in rules]
        assert found == [0, 0]
        assert [rule["then"]["required"] for rule in rules] == [["agents", "factor"]] * 2
    assert schema["$defs"]["Share"]["properties"]["factor"]["exclusiveMinimum"] == 0


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("colour", "green", "parameters.colour: expected red or blue, got 'green'"),
        ("gear", "7", "parameters.gear: expected 1 or 2, got 7"),
        ("table", "3", "parameters.table: expected a text, got 3"),
        ("paths", "{x: p}", "parameters.paths.x: expected a list, got 'p'"),
        ("names", "[a, 1]", "parameters.names[1]: expected a text, got 1"),
        ("by_name", "{left: {radius: 1}}", "parameters.by_name.left.radius: unknown key"),
        ("position_m", "[1, 2]", "parameters.position_m[2]: missing"),
        ("wheel", "{radius_m: -1}", "parameters.wheel.radius_m: expected >= 0, got -1"),
    ],
)
def test_a_wrong_value_is_told_at_its_place(folder, key, value, told):
    with pytest.raises(InputError) as caught:
        load_scenario(folder / "a.yaml", [f"parameters.{key}={value}"])

    assert told in str(caught.value)


ODD = """
import datetime, decimal, enum
from dataclasses import dataclass, field
from typing import Annotated, Any, Callable, NamedTuple
from madns_runtime.plugin.api import AgentSimulation, Simulation

class Bits(enum.Flag):
    A = 1

class Oddity(enum.Enum):
    A = (1, 2)

@dataclass(frozen=True)
class Inner:
    part: KIND

@dataclass(frozen=True)
class Parameters:
    inner: Inner | None = None

class Agent(AgentSimulation):
    pass

simulation = Simulation(name="o", parameters=Parameters, agent=":Agent")
"""


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("datetime.datetime", "got datetime.datetime"),
        ("set[str]", "got set[str]"),
        ("decimal.Decimal", "got decimal.Decimal"),
        ("bytes", "got bytes"),
        ("Callable[[int], int]", "got typing.Callable[[int], int]"),
        ("dict[int, str]", "expected texts as keys, got dict[int, str]"),
        ("tuple[complex, ...]", "got complex"),
        ("Bits", "Bits"),
        ("Oddity", "Oddity"),
        ("'Nowhere'", "name 'Nowhere' is not defined"),
    ],
)
def test_a_kind_that_no_scenario_can_hold_is_named_with_those_that_are_allowed(
    tmp_path, kind, told
):
    (tmp_path / "odd.py").write_text(ODD.replace("KIND", kind))
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: ./odd.py:simulation\nagents: {count: 1}")
    with pytest.raises(InputError) as caught:
        load_scenario(tmp_path / "a.yaml")
    text = str(caught.value)

    assert f"{tmp_path}/odd.py:" in text
    assert "Parameters.inner (Inner).part" in text or "Nowhere" in text
    assert told in text
    assert "see docs/plugins.md" in text


@pytest.mark.parametrize(
    ("field", "told"),
    [
        ("x: list = None", "x: expected a list, got None"),
        ("x: tuple[int, ...] = ('a',)", "x[0]: expected int, got 'a'"),
    ],
)
def test_a_default_that_is_none_of_its_type_is_told_with_file_and_line(tmp_path, field, told):
    code = ODD.replace("KIND", "int").replace("inner: Inner | None = None", field)
    (tmp_path / "odd.py").write_text(code)
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: ./odd.py:simulation\nagents: {count: 1}")
    line = code.split("\n").index("class Parameters:")  # its decorator's, counted from 1
    with pytest.raises(InputError) as caught:
        load_scenario(tmp_path / "a.yaml")

    assert f"{tmp_path}/odd.py:{line}: Parameters.{told}; a default must be" in str(caught.value)


def test_parameters_that_change_when_they_are_made_again_are_refused(tmp_path):
    (tmp_path / "odd.py").write_text(
        ODD.replace("KIND", "int").replace(
            "    inner: Inner | None = None\n",
            "    height: float = 1.0\n"
            "    def __post_init__(self):\n"
            "        object.__setattr__(self, 'height', self.height * 1000)\n",
        )
    )
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: ./odd.py:simulation\nagents: {count: 1}")
    with pytest.raises(InputError, match="do, height came out another; let __post_init__ keep"):
        load_scenario(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("kind", "default", "told"),
    [
        ("float", "float('nan')", "expected a finite number, got nan"),
        ("float", "float('inf')", "expected a finite number, got inf"),
        (
            "tuple[float, ...]",
            "(1.0, float('-inf'))",
            r"height\[1\]: expected a finite number, got -inf",
        ),
        ("int", "10**30", r"expected a whole number from -2\^63 to 2\^63 - 1"),
        ("int", "10**5000", "expected a whole number|4300 digits"),
        ("str", "chr(0xDC80)", r"expected text that UTF-8 can hold, got '\\udc80'"),
    ],
)
def test_default_that_no_message_can_hold_is_refused(tmp_path, kind, default, told):
    assert_refused(tmp_path, kind, default, told)


def assert_refused(folder, kind, default, told):
    """See that a parameter's default is refused with the plug-in's line."""
    (folder / "odd.py").write_text(
        ODD.replace("KIND", "int").replace(
            "    inner: Inner | None = None\n", f"    height: {kind} = {default}\n"
        )
    )
    (folder / "a.yaml").write_text("name: a\nsimulation: ./odd.py:simulation\nagents: {count: 1}")
    with pytest.raises(InputError, match=told) as caught:
        load_scenario(folder / "a.yaml")

    assert f"{folder}/odd.py:" in str(caught.value)


@pytest.mark.parametrize(
    ("default", "told"),
    [
        ("object()", "height: expected None, true or false, a number, a text, a list or a mapping"),
        ("b'abc'", r"got b'abc'; turn it into one of these"),
        ("complex(1)", "a list or a mapping, got"),
        ("frozenset((1, 2))", "a list or a mapping, got frozenset"),
        ("(1, object())", r"height\[1\]: expected None, true or false"),
        ("__import__('numpy').int64(3)", r"got np.int64\(3\)"),
        ("field(default_factory=lambda: __import__('numpy').zeros(2))", r"got array\("),
        ("field(default_factory=lambda: {1: 2})", "height: expected texts as keys, got 1"),
    ],
)
def test_a_default_of_any_kind_that_is_no_value_of_yaml_is_refused(tmp_path, default, told):
    assert_refused(tmp_path, "Any", default, told)


@pytest.mark.parametrize(
    ("kind", "default"),
    [
        ("float", "5"),
        ("Annotated[float, Ge(0)]", "0"),
        ("tuple[float, ...]", "(5, 1.5)"),
        ("tuple[tuple[float, float], ...]", "((0, 1), (2, 3))"),
        ("float | None", "5"),
    ],
)
def test_a_whole_number_does_as_the_default_of_a_float(tmp_path, kind, default):
    code = PLUGIN.split("class Sail")[0].rsplit("@dataclass", 1)[0] + (
        "@dataclass(frozen=True, kw_only=True)\n"
        f"class Parameters:\n    height_m: {kind} = {default}\n\n"
        "class Boat(AgentSimulation):\n    pass\n\n"
        'simulation = Simulation(name="boat", parameters=Parameters, agent=":Boat")\n'
    )
    (tmp_path / "odd.py").write_text(code)
    (tmp_path / "a.yaml").write_text("name: a\nsimulation: ./odd.py:simulation\nagents: {count: 1}")

    load_scenario(tmp_path / "a.yaml")


@dataclass(frozen=True, kw_only=True)
class Wave:
    lambda_: Annotated[float, Gt(0)] = 2.0


@dataclass(frozen=True, kw_only=True)
class Waves:
    x_: int = 1
    wave: Wave = Wave()


def test_a_field_whose_name_ends_with_an_underscore_is_written_as_it_is_called(tmp_path):
    (tmp_path / "waves.py").write_text(
        "from dataclasses import dataclass, field\n"
        "from madns_runtime.plugin.api import ActionKind, AgentSimulation, Simulation\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Wave:\n    lambda_: float = 2.0\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Waves:\n    wave: Wave = Wave()\n"
        "class Agent(AgentSimulation):\n    def begin_action(self, action):\n        pass\n"
        "DIM = ActionKind(\n"
        "    word='dim', summary='Dims.', parameters=Wave, lasting='never', carried_out_by='agent')\n"
        "simulation = Simulation(name='w', parameters=Waves, agent=':Agent', actions=(DIM,))\n"
    )
    (tmp_path / "a.yaml").write_text(
        "name: a\nsimulation: ./waves.py:simulation\nagents: {count: 1}\ntime: {duration_s: 2}\n"
        "parameters: {wave: {lambda_: 3}}\n"
        "timeline: [{at_s: 1, action: dim, agents: [agent-01], lambda_: 4}]\n"
    )
    scenario = load_scenario(tmp_path / "a.yaml")

    assert scenario.to_mapping()["parameters"] == {"wave": {"lambda_": 3.0}}
    assert from_mapping(Waves, to_mapping(Waves(x_=5, wave=Wave(lambda_=4.0)))) == Waves(
        x_=5, wave=Wave(lambda_=4.0)
    )
