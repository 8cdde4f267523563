"""A plug-in whose commands and records are NaN: nothing of it is green."""

import json

import pytest
from harness.cosmos_command import CosmosCommand

SPEED = "speed_m_s = GAIN_1_S * (self.mark_m - self.measured_m)"


@pytest.mark.process
def test_commands_and_records_of_nan_break_checks_that_name_the_agent(tmp_path):
    cosmos = CosmosCommand(tmp_path)
    assert cosmos("init", "rover", "--template", "plugin", "--directory", ".").returncode == 0
    plugin = tmp_path / "rover.py"
    text = plugin.read_text()
    assert SPEED in text
    is_second = 'self.context.name == "agent-02"'
    plugin.write_text(text.replace(SPEED, f'{SPEED} + (float("nan") if {is_second} else 0.0)'))

    done = cosmos("run", "rover.yaml", "--set", "time.mode=lockstep", "-q", "--json")

    assert done.returncode == 4, done.stderr
    broken = {c["name"]: c for c in json.loads(done.stdout)["checks"] if not c["passed"]}
    assert broken["records.not_finite"]["worst"] == "agent-02/drive"
    assert broken["records.not_finite"]["got"] == broken["commands_refused"]["got"] > 0
    assert broken["commands_refused"]["worst"] == "agent-02"
    assert broken["agent-02.error_m"]["worst"] == "agent-02"

    (tmp_path / "checks.yaml").write_text(
        (tmp_path / "rover.yaml").read_text()
        + "checks: [{name: few, stream: truth, statistic: count, above: 1}]\n"
    )
    judged = cosmos("judge", "last", "-s", "checks.yaml", "--json")

    count = broken["records.not_finite"]["got"]
    assert judged.returncode == 0, judged.stderr
    assert json.loads(judged.stdout)["records_not_finite"] == count
    assert f"{count} values were NaN or infinite when recorded" in judged.stderr
