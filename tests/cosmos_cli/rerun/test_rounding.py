"""A rerun forgives what whole microseconds of recorded times explain, and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest
from harness.cosmos_command import CosmosCommand

from cosmos_cli.diff.compare import Comparison
from cosmos_cli.diff.fields import FieldDifference
from cosmos_cli.diff.stream import StreamDifference
from cosmos_cli.rerun.outcome import RerunOutcome
from cosmos_cli.rerun.rounding import is_rounding
from madns_runtime.analysis.matching import Rows
from madns_runtime.recording.records import Field

FIELDS = (
    *(Field(f"{axis}_teme_m", "m") for axis in "xyz"),
    *(Field(f"v{axis}_m_s", "m/s") for axis in "xyz"),
    *(Field(f"q{number}", "1") for number in (1, 2)),
    Field("gap_m", "m"),
    Field("count", "m", "int"),
    Field("t_s", "s"),
)
VALUES = {
    "x_teme_m": 7.1e6,
    "vy_m_s": 7.5e3,
    "q2": 1.0,
    "gap_m": 5.0,
    "count": 10**10,
    "t_s": 1e9,
}


def recorded(values=None):
    """Return what an agent recorded: the same in each of two records; 0 of what is not given."""
    columns = {one.name: np.full(2, (values or VALUES).get(one.name, 0)) for one in FIELDS}
    return SimpleNamespace(fields=FIELDS, batches=lambda names: [{n: columns[n] for n in names}])


def difference(name, by):
    field = next(one for one in FIELDS if one.name == name)
    found = FieldDifference(field)
    rows = [
        Rows(keys=np.zeros(1), who=np.zeros(1), columns={name: np.array([value])})
        for value in (0, by)
    ]
    found.add(*rows)
    return found


@pytest.mark.parametrize(
    ("name", "by", "expected"),
    [
        ("z_teme_m", 7.5e-3, True),  # 1 us at 7.5 km/s, as y and z are 0 where x is 7100 km
        ("z_teme_m", 0.08, False),
        ("vx_m_s", 8e-6, True),  # 1 us under the Earth's gravity
        ("vx_m_s", 1e-3, False),
        ("q1", 1e-9, True),
        ("gap_m", 7.5e-3, False),  # beside positions of 7100 km
        ("gap_m", 4e-8, True),
        ("count", 1, False),
        ("t_s", 1e-6, True),
        ("t_s", 2e-6, False),
    ],
)
def test_a_difference_counts_by_the_size_of_its_own_vector(name, by, expected):
    assert is_rounding(difference(name, by), recorded()) is expected


def test_a_value_that_one_run_lacks_is_no_rounding():
    found = difference("x_teme_m", 1e-9)
    found.null_in_one = 1

    assert not is_rounding(found, recorded())


@pytest.mark.parametrize(
    ("is_exact", "of_b", "expected"), [(False, 7e6, 0), (False, 1, 1), (True, 7e6, 1)]
)
def test_each_agents_records_are_the_measure_of_its_own_differences(is_exact, of_b, expected):
    streams = [
        StreamDifference(table="state", source=source, matched=1, fields={"x_teme_m": found})
        for source, found in (("a", difference("x_teme_m", 0)), ("b", difference("x_teme_m", 0.01)))
    ]
    sides = {
        ("state", "a"): recorded(),
        ("state", "b"): recorded({"x_teme_m": of_b}),
    }
    found = RerunOutcome(
        devices=(),
        streams=Comparison(a=SimpleNamespace(streams=sides), b=None, streams=streams),
        remarks=(),
        unlike=(),
        is_exact=is_exact,
    )

    assert len(found.differing) == expected


DICE = """
from dataclasses import dataclass
import random
from madns_runtime.plugin.api import AgentSimulation, DeclaredStream, Simulation
from madns_runtime.recording.records import Field

FIELDS = (Field("tick", "", "int"), Field("die", "", "int"), Field("share"), Field("large"))


@dataclass(frozen=True)
class Parameters:
    pass


class Agent(AgentSimulation):
    def setup(self, context, initial):
        self.context = context
        context.open_stream("throws", FIELDS)

    def step(self, tick):
        die = random.SystemRandom().randrange(1_000_000)
        self.context.record("throws", (tick.index, die, die / 1e6, 1e15))


def streams(parameters, agents):
    return [DeclaredStream(role="agent", name="throws", fields=FIELDS)]


simulation = Simulation(name="dice", parameters=Parameters, agent=":Agent", streams=":streams")
"""
SCENARIO = """
name: dice
simulation: ./dice.py:simulation
agents: {count: 1}
time: {mode: lockstep, duration_s: 1}
"""


@pytest.mark.process
def test_chance_beside_a_large_value_is_a_difference(tmp_path):
    (tmp_path / "dice.py").write_text(DICE)
    (tmp_path / "dice.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)
    cosmos.run(tmp_path / "dice.yaml")

    done = cosmos("rerun", "last", "--quiet")

    assert done.returncode == 1, done.stderr
    assert "throws: die differs in 10 records" in done.stdout
    assert "share differs in 10 records" in done.stdout
    assert done.stdout.splitlines()[-1].startswith("DIFFERENT: in throws")
