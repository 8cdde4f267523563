"""Words that choose what `cosmos diff --run` compares: one that is misspelt costs no run."""

from dataclasses import replace

import pytest

from cosmos_cli import app
from cosmos_cli.diff.chosen import check_will_be_chosen
from cosmos_cli.diff.compare import Selection
from cosmos_cli.errors import InputError
from cosmos_cli.models.agent_labels import AgentLabels
from cosmos_cli.models.loading import load_scenario

SCENARIO = """
name: {name}
simulation: counter
agents: {{count: {count}, tick_hz: 10}}
time: {{mode: lockstep, duration_s: 0.2}}
"""
GPS = """
hardware:
  devices: [{name: gps, kind: synthetic, parameters: {channels: [{name: value, elements: [{offset: 1}]}]}}]
"""


@pytest.fixture
def paths(tmp_path):
    found = [tmp_path / name for name in ("one.yaml", "two.yaml")]
    for count, path in enumerate(found, start=1):
        path.write_text(SCENARIO.format(name=path.stem, count=count))
    return found


@pytest.mark.process
@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (
            "--agents agent-03",
            "no agent of these scenarios is called so; there are agent-01, agent-02",
        ),
        ("--streams round_trip", "record no such stream, did you mean round_trips?"),
        ("--streams ticks", "these scenarios record no such stream"),
    ],
)
def test_a_word_that_will_choose_nothing_is_refused_before_the_first_run(
    paths, tmp_path, capsys, asked, told
):
    words = ["diff", "--run", *map(str, paths), *asked.split(), "--runs", str(tmp_path / "runs")]

    code = app.run(words)

    assert code == 2
    assert f"{asked}: " in (err := capsys.readouterr().err)
    assert told in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "selection",
    [
        Selection(agents=("agent-02", "*1"), streams=("round_*", "log", "host_events")),
        Selection(agents=("IRIDIUM*",)),
        Selection(),
    ],
)
def test_words_that_fit_one_of_the_scenarios_are_content(paths, selection):
    scenarios = [load_scenario(path) for path in paths]
    labels = AgentLabels(names={"agent-01": "IRIDIUM 8"})

    check_will_be_chosen([scenarios[0], replace(scenarios[1], labels=labels)], selection)


def test_streams_that_nobody_declares_may_be_recorded(paths):
    scenarios = [replace(load_scenario(path), streams=None) for path in paths]

    check_will_be_chosen(scenarios, Selection(streams=("own",)))


def test_streams_of_devices_may_be_recorded(paths):
    paths[1].write_text(paths[1].read_text() + GPS)
    scenarios = [load_scenario(path) for path in paths]

    check_will_be_chosen(scenarios, Selection(streams=("gps.value", "device_gps*", "gps.???nt?")))
    with pytest.raises(InputError, match="--streams round_trip: these scenarios record no"):
        check_will_be_chosen(scenarios, Selection(streams=("round_trip",)))
