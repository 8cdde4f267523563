"""docs/ci.md and its job: the job's file is one that GitHub takes, its commands run, and the guide's examples hold."""

import re
import shlex
import sys
from typing import get_args

import jsonschema
import pytest
import yaml
from guides import ROOT, blocks, run

from cosmos_cli.commands.command_group import each_command
from cosmos_cli.models.baseline import Statistic, read_baseline
from cosmos_cli.models.scenario_outline import read_outline

GUIDE = (ROOT / "docs/ci.md").read_text("utf-8")
FILE = ROOT / "docs/ci-job.yml"
# Words such as `on` stay words: GitHub reads YAML 1.2.
JOB = yaml.load(FILE.read_text("utf-8"), Loader=yaml.BaseLoader)  # noqa: S506 - texts alone
STEP = {
    "type": "object",
    "properties": {
        "name": {"type": "string"},
        "if": {"type": "string"},
        "uses": {"type": "string", "pattern": r"^[\w.-]+/[\w.-]+@v[0-9]+$"},
        "with": {"type": "object", "additionalProperties": {"type": "string"}},
        "run": {"type": "string", "minLength": 1},
        "env": {"type": "object"},
    },
    "additionalProperties": False,
    "oneOf": [{"required": ["uses"]}, {"required": ["run"], "not": {"required": ["with"]}}],
}
WORKFLOW = {
    "type": "object",
    "required": ["name", "on", "jobs", "permissions"],
    "properties": {
        "name": {"type": "string"},
        "on": {
            "type": "object",
            "properties": {
                "push": {"type": "object"},
                "pull_request": {},
                "schedule": {
                    "type": "array",
                    "items": {
                        "type": "object",
                        "properties": {"cron": {"pattern": r"^[0-9*/,-]+( [0-9*/,-]+){4}$"}},
                        "required": ["cron"],
                    },
                },
            },
            "additionalProperties": False,
        },
        "permissions": {"additionalProperties": {"enum": ["read", "none"]}},
        "concurrency": {
            "type": "object",
            "required": ["group"],
            "properties": {"group": {}, "cancel-in-progress": {"enum": ["true", "false"]}},
            "additionalProperties": False,
        },
        "jobs": {
            "type": "object",
            "minProperties": 1,
            "additionalProperties": {
                "type": "object",
                "required": ["runs-on", "timeout-minutes", "steps"],
                "properties": {
                    "if": {"type": "string"},
                    "runs-on": {"pattern": "^ubuntu-"},
                    "timeout-minutes": {"pattern": "^[0-9]+$"},
                    "env": {"type": "object"},
                    "steps": {"type": "array", "minItems": 2, "items": STEP},
                },
                "additionalProperties": False,
            },
        },
    },
    "additionalProperties": False,
}
SCENARIO = """\
name: ring
simulation: counter
agents: {count: 4, tick_hz: 10}
time: {mode: lockstep, duration_s: 600}
test: {set: {time.duration_s: 2}, tags: [quick]}
"""


def steps():
    return [step for job in JOB["jobs"].values() for step in job["steps"]]


def commands():
    return [shlex.split(step["run"]) for step in steps() if "run" in step]


def test_the_jobs_file_has_the_form_of_a_workflow():
    jsonschema.Draft202012Validator.check_schema(WORKFLOW)
    jsonschema.validate(JOB, WORKFLOW)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda job: job.pop("on"),
        lambda job: job["jobs"]["quick"].pop("runs-on"),
        lambda job: job["jobs"]["quick"]["steps"].append({"name": "nothing"}),
        lambda job: job["jobs"]["quick"]["steps"].append({"uses": "actions/checkout"}),
        lambda job: job["jobs"]["quick"]["steps"].append({"run": "x", "with": {"a": "b"}}),
        lambda job: job["on"]["schedule"].append({"cron": "daily"}),
    ],
)
def test_a_file_that_is_none_is_found(spoil):
    job = yaml.load(FILE.read_text("utf-8"), Loader=yaml.BaseLoader)  # noqa: S506
    spoil(job)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(job, WORKFLOW)


def test_expressions_name_what_github_knows():
    text = FILE.read_text("utf-8")
    inside = re.findall(r"\$\{\{ *(.*?) *\}\}", text)
    assert inside and text.count("${{") == len(inside)
    assert {one.partition(".")[0] for one in inside} <= {"github", "runner", "env", "matrix"}
    conditions = [each["if"] for each in (*JOB["jobs"].values(), *steps()) if "if" in each]
    for condition in conditions:
        assert re.fullmatch(
            r"(always|failure|success)\(\)|github\.event_name [!=]= '\w+'", condition
        )


def test_it_caches_packages_and_keeps_results_and_failed_runs():
    for job in JOB["jobs"].values():
        uses = {step["uses"].partition("@")[0]: step for step in job["steps"] if "uses" in step}
        assert uses["actions/setup-python"]["with"]["cache"] == "pip"
        kept = "".join(
            step["with"]["path"]
            for step in job["steps"]
            if "upload-artifact" in step.get("uses", "")
        )
        assert "results/junit.xml" in kept and "runs/tests/" in kept


def test_its_commands_and_their_options_exist():
    options = {
        verb: {name for each in command.params for name in (*each.opts, *each.secondary_opts)}
        for verb, command in each_command()
    }
    ours = [words for words in commands() if words[0] == "cosmos"]
    assert [words[1] for words in ours] == ["validate", "test", "test"]
    for words in ours:
        assert {word for word in words[2:] if word.startswith("-")} <= options[words[1]]


@pytest.mark.process
def test_its_commands_run_one_after_the_other(tmp_path):
    (tmp_path / "scenarios").mkdir()
    (tmp_path / "scenarios/ring.yaml").write_text(SCENARIO)
    for words in (step["run"] for step in JOB["jobs"]["quick"]["steps"] if "run" in step):
        if words.startswith("cosmos "):
            done = run(words, tmp_path, COSMOS_RUNS=str(tmp_path / "runs"))
            assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "results/junit.xml").is_file()


@pytest.mark.process
def test_the_guides_pytest_example_runs(tmp_path):
    (tmp_path / "ring.yaml").write_text(SCENARIO)
    (block,) = blocks(GUIDE, "python")
    (tmp_path / "test_ring.py").write_text(block)
    done = run(
        f"{shlex.quote(sys.executable)} -m pytest -q -p no:cacheprovider test_ring.py",
        tmp_path,
        COSMOS_RUNS=str(tmp_path / "runs"),
    )

    assert done.returncode == 0, done.stdout + done.stderr
    assert "1 passed" in done.stdout


def test_the_guides_section_and_baseline_are_right(tmp_path):
    section, figures = blocks(GUIDE, "yaml")
    (tmp_path / "s.yaml").write_text(SCENARIO.partition("test:")[0] + section)
    (tmp_path / "baselines").mkdir()
    (tmp_path / "baselines/ring.yaml").write_text(figures)

    outline = read_outline(tmp_path / "s.yaml")
    assert outline.load(outline.overrides(), print).scenario.agents.count == 5
    assert outline.baseline().figures == read_baseline(tmp_path / "baselines/ring.yaml").figures


def test_the_guide_names_every_statistic_and_no_other():
    sentence = GUIDE.split("`statistic` is", 1)[1].split("over all records", 1)[0]

    assert re.findall(r"`(\w+)`", sentence) == list(get_args(Statistic))


def test_the_guide_shows_the_jobs_heart():
    shown = " ".join(GUIDE.split())
    quick = next(" ".join(words) for words in commands() if words[:2] == ["cosmos", "test"])
    assert quick in shown
