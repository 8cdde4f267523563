"""The benchmark flown again: what it counted is judged, how long messages took is not."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """
name: counting
simulation: counter
agents: {count: 2, tick_hz: 20}
time: {duration_s: 1.5}
parameters: {service: sync, host_round_trips: true}
"""


def test_a_run_in_real_time_is_the_same_again_but_for_times_of_messages(tmp_path):
    (tmp_path / "counting.yaml").write_text(SCENARIO)
    cosmos = CosmosCommand(tmp_path)
    _, document = cosmos.run(tmp_path / "counting.yaml", *LOOSE)

    done = cosmos("rerun", document["run"], "--json", "--quiet")
    told = json.loads(done.stdout)

    assert "round_trips.round_trip_us" in told["not_compared"]
    tables = {each["table"]: each for each in told["diff"]["streams"]}
    assert tables["round_trips"]["fields"]["round_trip_us"]["different"] > 0
    if not document["timing"]["missed"]:  # lockstep flies ticks that a busy machine skipped
        assert (done.returncode, told["same"]) == (0, True), done.stderr
        assert tables["round_trips"]["matched"] == 60
