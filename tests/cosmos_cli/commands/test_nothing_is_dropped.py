"""Words of a command line that cannot all count are refused, and never dropped in silence."""

import pytest

from cosmos_cli import app
from cosmos_cli.commands.command_group import each_command
from cosmos_cli.errors import InputError
from cosmos_cli.models.loading import load_scenario

SCENARIO = "name: s\nsimulation: counter\nagents: {count: 1, tick_hz: 10}\ntime: {duration_s: 1}\n"


@pytest.fixture
def scenario(tmp_path, monkeypatch):
    for name in ("COSMOS_INVENTORY", "COSMOS_LIMIT", "COSMOS_RUNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "s.yaml"
    path.write_text(SCENARIO)
    return path


def single_options():
    for verb, command in each_command():
        for parameter in command.params:
            is_option = parameter.param_type_name == "option"
            if is_option and not (parameter.multiple or parameter.is_flag or parameter.count):
                yield verb, parameter.opts[0]


@pytest.mark.parametrize(("verb", "option"), sorted(set(single_options())))
def test_option_given_twice_is_refused(scenario, capsys, verb, option):
    code = app.run([*verb.split(), option, "1", option, "2"])

    assert code == 2
    assert f"{option} is given twice" in capsys.readouterr().err


def test_flag_and_its_opposite_are_refused(scenario, capsys):
    assert app.run(["run", "s.yaml", "--report", "--no-report"]) == 2
    assert "--report/--no-report is given twice" in capsys.readouterr().err


def test_flag_given_twice_says_the_same(scenario, capsys):
    assert app.run(["runs", "--json", "--json"]) == 0


def test_words_of_a_command_for_machines_are_its_own(capsys):
    """Not refused as given twice: what follows the first word is not ours."""
    assert app.run(["exec", "-i", "none.yaml", "ls", "--limit", "a", "--limit", "b"]) == 2
    assert "none.yaml: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["agents.count=2", "agents.count=3"], "--set agents.count: is given twice"),
        (["agents.count=2", "agents.count=2"], "--set agents.count: is given twice"),
        (["agents.count=2", "agents={count: 1, tick_hz: 10}"], "--set agents: would replace"),
    ],
)
def test_value_set_twice_is_refused(scenario, overrides, words):
    with pytest.raises(InputError) as caught:
        load_scenario(scenario, overrides)

    assert words in str(caught.value)


def test_value_within_one_that_was_set_refines_it(scenario):
    loaded = load_scenario(scenario, ["agents={count: 1, tick_hz: 10}", "agents.count=2"])

    assert loaded.scenario.agents.count == 2


def test_duration_and_a_set_duration_are_refused(scenario, capsys):
    assert app.run(["run", "s.yaml", "--duration", "1", "--set", "time.duration_s=2"]) == 2
    assert "is given twice, and only one could count (--duration" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["run", "s.yaml", "--duration", "-1"], "--duration"),
        (["diff", "--run", "s.yaml", "s.yaml", "--duration", "0"], "--duration"),
        (["bench", "suite", "s.yaml", "--minutes", "0.01"], "--minutes"),
    ],
)
def test_fault_of_a_value_names_the_option_that_was_typed(scenario, capsys, words, option):
    """And not the --set that it stands for."""
    scenario.write_text(SCENARIO.replace("tick_hz: 10", "tick_hz: 1"))

    assert app.run(words) == 2

    told = capsys.readouterr().err
    assert f"{option}: expected" in told
    assert "--set" not in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["down", "3", "--all"], "--all ends every living run, not only 3"),
        (["doctor", "--set", "agents.count=3"], "there is no scenario whose value"),
        (
            ["plan", "s.yaml", "--set", "time.mode=lockstep", "--latency-ms", "3"],
            "in lockstep none of it applies",
        ),
        (
            ["plan", "s.yaml", "--set", "time.mode=lockstep", "--bandwidth-mbit", "3"],
            "in lockstep none of it applies",
        ),
        (["devices", "verify", "synthetic", "--place", "1,2"], "--place are of calibrate alone"),
        (["devices", "verify", "synthetic", "--limit", "x"], "no machines without an inventory"),
        (["devices", "calibrate", "imu", "--limit", "x"], "no machines without an inventory"),
        (
            ["devices", "verify", "synthetic", "-i", "x,"],
            "and no inventory: leave out -i and COSMOS_INVENTORY",
        ),
        (["ps", "--limit", "x"], "no machines without an inventory"),
        (["run", "s.yaml", "--host", "x"], "no machine without an inventory"),
    ],
)
def test_option_without_anything_to_act_on_is_refused(scenario, capsys, words, told):
    assert app.run(words) == 2
    assert told in capsys.readouterr().err
