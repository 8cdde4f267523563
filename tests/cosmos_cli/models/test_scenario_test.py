"""Section `test` of a scenario, and baselines: broken ones are refused with place and cure."""

import pytest

from cosmos_cli.app import run as cosmos
from cosmos_cli.errors import InputError
from cosmos_cli.models.baseline import read_baseline
from cosmos_cli.models.loading import load_scenario
from cosmos_cli.models.scenario_outline import check_test, read_outline, with_seed

HEAD = """\
name: s
simulation: counter
agents: {count: 2, tick_hz: 10}
time: {duration_s: 30}
"""


@pytest.fixture
def scenario(tmp_path):
    def write(test, name="s.yaml"):
        path = tmp_path / name
        path.write_text(f"{HEAD}test: {test}\n")
        return path

    return write


def faults(path, given=()):
    with pytest.raises(InputError) as caught:
        check_test(load_scenario(path, given), print)
    return caught.value.faults


BROKEN = [
    ("5", "5:7: test: expected a mapping"),
    ("{sets: {}}", "5:8: test.sets: unknown key, did you mean set?"),
    ("{set: [1]}", "5:13: test.set: expected a mapping"),
    ("{set: {time..x: 1}}", "5:23: test.set.time..x: expected a dotted path"),
    ("{set: {test.tags: [a]}}", "5:25: test.set.test.tags: expected a key of the scenario outside"),
    ("{set: {agents.cuont: 3}}", "5:28: test.set.agents.cuont: unknown key, did you mean count?"),
    ("{set: {agents.count: many}}", "5:28: test.set.agents.count: expected a whole number"),
    ("{set: {time.duration_s: -1}}", "5:31: test.set.time.duration_s: expected > 0"),
    ("{set: {parameters.service: bets}}", "5:34: test.set.parameters.service: expected"),
    ("{set: {time.duration_s: 0.01}}", "test.set.time.duration_s: expected at least one tick"),
    ("{set: {vars.n: 3}}", "5:22: test.set.vars.n: no variable is named n"),
    ("{set: {agents: 5}}", "5:22: test.set.agents: expected a mapping"),
    ("{tags: quick}", "5:14: test.tags: expected a list"),
    ("{tags: [Quick]}", "5:15: test.tags[0]: expected a tag such as quick"),
    ("{tags: [and]}", "5:15: test.tags[0]: expected a tag such as quick"),
    ("{tags: [a, b, a]}", "5:21: test.tags[2]: expected each tag once, got 'a' again"),
    ("{deadline_s: 0}", "5:20: test.deadline_s: expected > 0"),
    ("{deadline_s: soon}", "5:20: test.deadline_s: expected a number"),
    ("{expect: 4}", "5:16: test.expect: expected a mapping"),
    ("{expect: {exit_code: 2}}", "5:28: test.expect.exit_code: expected 0, 1, 3, 4, 5 or 130"),
    ("{expect: {exit: 4}}", "5:17: test.expect.exit: unknown key"),
    ("{expect: {broken: [drift]}}", "5:25: test.expect.broken: expected no broken checks with"),
    ("{baseline: /etc/passwd}", "5:18: test.baseline: expected a file in or below"),
    ("{baseline: ../b.yaml}", "5:18: test.baseline: expected a file in or below"),
    ("{baseline: none.yaml}", "5:18: test.baseline:"),
]


@pytest.mark.parametrize(("test", "told"), BROKEN, ids=[text for text, _ in BROKEN])
def test_broken_section_is_refused_at_its_place(scenario, test, told):
    rendered = [fault.render() for fault in faults(scenario(test))]

    assert len(rendered) == 1
    assert told in rendered[0]


def test_fault_that_only_the_test_has_says_so(tmp_path):
    path = tmp_path / "s.yaml"
    check = "{name: late, stream: ticks, field: tick, from_s: 20, above: 1}"
    path.write_text(f"{HEAD}test: {{set: {{time.duration_s: 5}}}}\nchecks:\n  - {check}\n")

    (fault,) = faults(path)

    assert fault.path == "checks[0].from_s"
    assert fault.text.endswith("then (of the scenario as its test.set changes it)")


def test_all_faults_of_the_section_come_at_once(scenario):
    path = scenario("{set: {x: 1, agents.count: 0}, baseline: none.yaml}")

    assert [fault.path for fault in faults(path)] == [
        "test.set.x",
        "test.set.agents.count",
        "test.baseline",
    ]


def test_fault_of_a_baseline_blames_no_test_set(scenario, tmp_path):
    path = scenario("{set: {agents.count: 1}, baseline: b.yaml}")
    (path.parent / "b.yaml").write_text("figures: {a: {path: x, tolerance: -1}}")

    (fault,) = faults(path)

    assert fault.file.endswith("b.yaml")
    assert "test.set" not in fault.text


def test_validate_checks_the_scenario_as_its_test_changes_it(scenario, capsys):
    path = scenario("{set: {agents.count: 0}}")

    assert cosmos(["validate", str(path)]) == 2
    assert "test.set.agents.count: expected >= 1" in capsys.readouterr().err
    assert cosmos(["run", str(path), "--check"]) in (0, 3)  # a run by itself ignores it


def test_values_of_any_kind_come_through(scenario):
    path = scenario(
        "{set: {agents.names: [a, b], seed: 7, description: 'é \"x\": {}', agents.tick_hz: 1e1}}"
    )
    outline = read_outline(path)

    found = outline.load(outline.overrides(), print).scenario
    assert found.agents.names == ("a", "b")
    assert (found.seed, found.description, found.agents.tick_hz) == (7, 'é "x": {}', 10.0)


def test_a_variables_number_stands_as_the_test_writes_it(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text(
        f"{HEAD}vars: {{tag: 1}}\ndescription: run ${{tag}}\ntest: {{set: {{vars.tag: 007}}}}\n"
    )
    outline = read_outline(path)

    loaded = outline.load(outline.overrides(), print)

    assert loaded.scenario.description == "run 007"


def test_the_command_line_counts_more_than_the_test(scenario):
    outline = read_outline(scenario("{set: {agents.count: 3, time.duration_s: 5, seed: 1}}"))

    assert outline.overrides(["agents.count=4"]) == [
        "time.duration_s=5",
        "seed=1",
        "agents.count=4",
    ]
    assert outline.overrides(["time={duration_s: 2}"])[:2] == ["agents.count=3", "seed=1"]
    assert outline.overrides(["seed=2"], is_shortened=False) == ["seed=2"]
    assert with_seed(["seed=1", "seeds=3"], 9) == ["seeds=3", "seed=9"]


FIGURES = [
    ("[]", "expected a mapping"),
    ("{}", "figures: missing"),
    ("figures: {}", "expected 1 to"),
    ("figures: {a: {}}", "1:11: figures.a: expected path, or all of stream, field and statistic"),
    ("figures: {a: {path: x, stream: s, field: f, statistic: mean}}", "got both"),
    ("figures: {a: {stream: s, field: f}}", "figures.a: expected path, or all of"),
    ("figures: {a: {path: 'a..b'}}", "1:21: figures.a.path: expected a dotted path"),
    ("figures: {a: {path: x, tolerance: -1}}", "figures.a.tolerance: expected >= 0"),
    ("figures: {a: {path: x, tolerances: 1}}", "did you mean tolerance?"),
    ("figures: {a: {stream: s, field: f, statistic: meen}}", "figures.a.statistic: expected"),
    ("figures: {a: {path: x, expected: [1]}}", "figures.a.expected: expected"),
    ("figures: {a: {path: x, agents: []}}", "figures.a.agents: expected at least 1"),
    ("figures: {a: {path: x}, a: {path: y}}", "duplicate key"),
]


@pytest.mark.parametrize(("text", "told"), FIGURES, ids=[text for text, _ in FIGURES])
def test_broken_baseline_is_refused_at_its_place(tmp_path, text, told):
    path = tmp_path / "b.yaml"
    path.write_text(text)

    with pytest.raises(InputError) as caught:
        read_baseline(path)
    rendered = "\n".join(fault.render() for fault in caught.value.faults)
    assert "b.yaml" in rendered
    assert told in rendered
