"""
The thesis's experiments: each expects what the thesis aimed at or measured, and what the thesis met breaks it.

No run is made; what records would say is made up, and judged as a run's.
"""

import numpy as np
import pytest
from harness.cosmos_command import SCENARIOS

from cosmos_cli.evidence.expectations.judge import judge_expectations
from cosmos_cli.models.known_streams import KnownStreams
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.scenario_test import override_of
from madns_runtime.recording.records import Field

pytestmark = pytest.mark.process  # a simulation answers for its scenario in a process of its own

FOLDER = SCENARIOS / "thesis"
OF_PLANS = ("table_2_2.yaml", "table_2_2_corrected.yaml")
"""Of `cosmos plan` alone: their aims are the inequalities of tests/cosmos_cli/commands/test_plan_of_the_thesis.py."""
FILES = sorted(path.name for path in FOLDER.glob("*.yaml") if path.name not in OF_PLANS)
AIMS = {
    "basilisk": {"past_45_s", "states", "energy"},
    "benchmark": {"round_trip_mean", "round_trip_rate"},
    "boards24": {"states", "energy", "lateness_mean"},
    "guidance": {"burn", "apogee", "no_burn", "no_change"},
    "hwil": {"lateness_mean"},
    "orbits": {"states", "energy", "lateness_mean"},
}
"""Checks that each family of scenarios has, by what its files' names begin with."""


class SameForAll:
    """A table in memory in which all agents recorded the same."""

    role = "agent"

    def __init__(self, name, agents, columns, declared):
        self.name, self._columns, self.sources = name, columns, agents
        fields = {field.name: field for field in declared}
        self.fields = tuple(fields.get(name, Field(name, "s")) for name in columns)

    @property
    def rows(self):
        return len(self.sources) * len(self._columns["t_s"])

    def unit(self, source, name):
        return next(field.unit for field in self.fields if field.name == name)

    def has(self, *names):
        return set(names) <= {field.name for field in self.fields}

    def batches(self, source, names, rows_max):
        yield {name: self._columns[name] for name in names}


@pytest.fixture(scope="module")
def loaded():
    """Each scenario at full length, by its file's name."""
    return {name: load_scenario(FOLDER / name) for name in FILES}


def test_each_family_of_experiments_expects_what_the_thesis_aimed_at(loaded):
    for name, file in loaded.items():
        checks = {each.name for each in file.expectations}

        assert checks >= AIMS[name.split("_")[0]], name


@pytest.mark.parametrize("name", FILES)
def test_shortened_it_is_judged_as_well(name, loaded):
    test = loaded[name].scenario.test
    shortened = load_scenario(FOLDER / name, [override_of(*each) for each in test.set.items()])

    is_lockstep = shortened.scenario.time.mode == "lockstep"
    judged = [each for each in shortened.expectations if each.is_judged_in(is_lockstep=is_lockstep)]
    assert judged
    assert "thesis" in test.tags


def judged(file, stream, field, values):
    """Return which checks on a field hold, by name, where each agent's records of a whole run are *values*."""
    scenario = file.scenario
    t_s = np.linspace(0.0, scenario.time.duration_s, len(values))
    declared = KnownStreams(file.streams).of(stream)[0].fields
    agents = scenario.agents.resolved_names()
    table = SameForAll(stream, agents, {"t_s": t_s, field: np.asarray(values)}, declared)
    about = [each for each in file.expectations if (each.stream, each.field) == (stream, field)]
    found = judge_expectations(
        about,
        {stream: table},
        agents=agents,
        is_lockstep=False,
        duration_s=scenario.time.duration_s,
    )
    return {each.name: each.passed for each in found.results}


def test_a_round_trip_of_one_period_holds_and_that_of_frozen_queues_does_not(loaded):
    file = loaded["benchmark_3min.yaml"]
    spread_ms = np.random.default_rng(1).normal(0.0, 1.5, 3600)

    one_period = judged(file, "round_trips", "round_trip_us", 1e3 * (50.0 + spread_ms))
    frozen = judged(file, "round_trips", "round_trip_us", 1e3 * (1100.0 + spread_ms))

    assert one_period == {"round_trip_mean": True, "round_trip_sd": True}
    assert frozen == {"round_trip_mean": False, "round_trip_sd": True}


@pytest.mark.parametrize("name", [name for name in FILES if name.startswith("hwil")])
def test_an_agent_that_waits_for_its_hardware_is_found(name, loaded):
    prompt = judged(loaded[name], "ticks", "lateness_us", np.full(600, 200.0))
    serial = judged(loaded[name], "ticks", "lateness_us", np.full(600, 10_500.0))

    assert (prompt, serial) == ({"lateness_mean": True}, {"lateness_mean": False})


def test_energy_without_potential_is_none_that_stays(loaded):
    """The kinetic energy of a satellite of IRIDIUM swings by 2 e."""
    kinetic = 0.006 * np.sin(np.linspace(0.0, 15.0, 600))
    about = ("invariants", "energy_drift")
    checks = [
        each for each in loaded["orbits_4h.yaml"].expectations if (each.stream, each.field) == about
    ]

    assert [check.bounds.holds(float(kinetic.max())) for check in checks] == [False]
    assert [check.bounds.holds(1e-14) for check in checks] == [True]


def test_the_apogee_is_beyond_the_thesis_s_four_hours(loaded):
    """Half of a period of 38,541 s from the burn at 60 s on."""
    file = loaded["guidance_apogee.yaml"]
    degrees_per_s = 360.0 / 38_541.0

    def at_apogee(last_s):
        t_s = np.arange(0.0, file.scenario.time.duration_s)
        anomaly_deg = np.minimum(t_s, last_s) * degrees_per_s
        return judged(file, "elements", "mean_anomaly_deg", anomaly_deg - 0.5)

    assert at_apogee(file.scenario.time.duration_s) == {"at_apogee": True}
    assert at_apogee(14_400.0) == {"at_apogee": False}
