"""What flight software of a ring survives, shortened: each scenario passes, and fails with the behaviour off that it tests."""

import json

import pytest
from harness.cosmos_command import SCENARIOS, CosmosCommand

pytestmark = [pytest.mark.process, pytest.mark.nightly]

PATIENCE_S = 900.0
OFF = {
    "losses": (("vars.repairs=false",), {"slots", "worst"}),
    "parted": (("vars.repairs=false",), {"slots"}),
    "lossy": (("vars.repairs=false", "vars.patience=2"), {"slots"}),
    "biased_gnss": (("vars.guards_gnss=false",), {"own"}),
    "liar": (("vars.screens=false",), {"slots"}),
    "stuck_thruster": (("vars.closes=false",), {"closed", "given"}),
}
"""By scenario: settings that switch the behaviour off, and the expectations that are broken then."""


def outcome_of(folder, scenario, settings=()):
    """Return the one test of `cosmos test` of a scenario of survival."""
    path = SCENARIOS / "survival" / f"{scenario}.yaml"
    chosen = [part for setting in settings for part in ("--set", setting)]
    folder.mkdir()
    cosmos = CosmosCommand(folder)
    done = cosmos("test", path, *chosen, "--json", "--quiet", patience_s=PATIENCE_S)
    (test,) = json.loads(done.stdout)["tests"]
    return test


def test_each_scenario_of_survival_has_a_behaviour_that_can_be_off():
    there = {path.stem for path in (SCENARIOS / "survival").glob("*.yaml")}

    assert there - {"undisturbed"} == set(OFF)


@pytest.mark.timeout(2 * PATIENCE_S + 60)
@pytest.mark.parametrize("scenario", sorted(OFF))
def test_scenario_passes_and_fails_by_its_own_expectation_with_the_behaviour_off(
    tmp_path, scenario
):
    settings, broken = OFF[scenario]

    survived = outcome_of(tmp_path / "on", scenario)
    lost = outcome_of(tmp_path / "off", scenario, settings)

    assert survived["outcome"] == "passed", survived["reasons"]
    assert lost["outcome"] == "failed"
    assert {line.partition(":")[0] for line in lost["broken"]} == broken
