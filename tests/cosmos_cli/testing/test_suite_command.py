"""`cosmos test` as a person and a CI job meet it: results, kept evidence, deadlines, interruption."""

import json
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from harness.cosmos_command import CosmosCommand
from harness.waiting import wait_until
from lxml import etree
from suite_cases import make_result

from cosmos_cli.app import run as run_here
from cosmos_cli.errors import MachinesError
from cosmos_cli.testing.junit import junit_case_of, junit_text
from cosmos_cli.testing.outcome import judge_case
from cosmos_cli.testing.suite import SuiteResult
from madns_runtime.processes import list_processes

pytestmark = pytest.mark.process

SCHEMA = etree.XMLSchema(etree.parse(Path(__file__).with_name("junit.xsd")))


@pytest.fixture
def cosmos(tmp_path):
    return CosmosCommand(tmp_path)


def scenario(cosmos, name, *, duration_s=600, **test):
    path = cosmos.folder / "scenarios" / f"{name}.yaml"
    path.parent.mkdir(exist_ok=True)
    content = {
        "name": name,
        "simulation": "counter",
        "agents": {"count": 2, "tick_hz": 10},
        "time": {"mode": "lockstep", "duration_s": duration_s},
        "timeouts": {"agents_ready_s": 120, "silence_s": 30},
        "test": {"set": {"time.duration_s": 5}, **test},
    }
    path.write_text(yaml.safe_dump(content))
    return path


def results(done):
    document = json.loads(done.stdout)
    assert document["exit_code"] == done.returncode, done.stderr
    return document, {Path(each["scenario"]).stem: each for each in document["tests"]}


def nobody_is_left(cosmos, monkeypatch):
    monkeypatch.setenv("COSMOS_STATE_DIR", cosmos.environment["COSMOS_STATE_DIR"])
    wait_until(lambda: not list_processes())


def test_a_suite_tells_each_test_keeps_failures_and_runs_them_again(cosmos):
    scenario(cosmos, "good", tags=["quick"])
    scenario(cosmos, "bad", tags=["quick"], expect={"exit_code": 4, "broken": ["counter.*"]})
    scenario(cosmos, "slow", tags=["slow"])
    done = cosmos("test", "-k", "quick", "--junit", "out/junit.xml")

    assert done.returncode == 1, done.stderr
    lines = done.stdout.splitlines()
    assert "collected 3 tests / 1 deselected, 2 selected (3 scenarios)" in done.stderr
    assert [line.split()[1] for line in lines[:2]].count("PASSED") == 1
    assert all(line.endswith(("[ 50%]", "[100%]")) for line in lines[:2])
    assert "expected exit code 4, got 0: PASSED" in done.stdout
    assert "expected counter.* to be broken: it held, or was not judged" in done.stdout
    assert (
        "repeat it: cosmos run scenarios/bad.yaml --set time.duration_s=5 --set seed=0"
        in done.stdout
    )
    assert "1 failed, 1 passed, 1 deselected in" in lines[-1]
    (kept,) = [path for path in (cosmos.runs / "tests").iterdir() if path.is_dir()]
    assert kept.name.endswith("-bad")
    assert [path.name for path in (cosmos.runs / "tests").glob("*.zst")] == [f"{kept.name}.tar.zst"]
    junit = etree.parse(cosmos.folder / "out/junit.xml")
    SCHEMA.assertValid(junit)
    assert junit.getroot()[0].get("failures") == "1"

    again, tests = results(cosmos("test", "--last-failed", "--json"))
    assert list(tests) == ["bad"]
    assert again["deselected"] == 2

    text = cosmos.folder.joinpath("scenarios/bad.yaml").read_text()
    cosmos.folder.joinpath("scenarios/bad.yaml").write_text(
        text.replace("exit_code: 4", "exit_code: 0").replace(
            "broken:\n    - counter.*", "verdict: hold"
        )
    )
    mended, tests = results(cosmos("test", "--last-failed", "--json"))
    assert (mended["exit_code"], tests["bad"]["outcome"]) == (0, "passed")
    scenario(cosmos, "elsewhere", expect={"verdict": "nothing says this"})
    assert cosmos("test", "-k", "elsewhere").returncode == 1
    others = cosmos("test", "scenarios/good.yaml", "--last-failed")
    assert (others.returncode, "none of these failed last time" in others.stderr) == (0, True)


@pytest.mark.nightly
def test_a_seed_that_failed_is_run_again_alone(cosmos):
    cosmos.environment["COSMOS_INVENTORY"] = "none.yaml"  # tests run here, whatever it names
    scenario(cosmos, "s", expect={"verdict": "nothing says this"})
    document, _ = results(cosmos("test", "--seeds", "1..2", "--json"))
    assert [(each["seed"], each["outcome"]) for each in document["tests"]] == [
        (1, "failed"),
        (2, "failed"),
    ]
    again, _ = results(cosmos("test", "--last-failed", "-k", "seed=2", "--json"))
    assert [each["seed"] for each in again["tests"]] == [2]


def test_baselines_are_written_and_hold_the_run_to_them(cosmos):
    scenario(cosmos, "s", baseline="figures.yaml")
    file = cosmos.folder / "scenarios/figures.yaml"
    file.write_text(
        "figures:\n"
        "  # All ticks of both agents.\n"
        "  ticks: {path: timing.ticks}\n"
        "  packets: {stream: round_trips, field: packet, statistic: max, expected: 7}\n"
    )

    _, tests = results(cosmos("test", "--json"))
    assert tests["s"]["reasons"] == [
        "baseline: ticks: has no expected value: write it with cosmos test --update-baselines",
        "baseline: packets: expected 7, got 49",
    ]
    written, _ = results(cosmos("test", "--update-baselines", "--json"))
    assert written["exit_code"] == 0
    assert file.read_text() == (
        "figures:\n"
        "  # All ticks of both agents.\n"
        "  ticks: {expected: 100, path: timing.ticks}\n"
        "  packets: {stream: round_trips, field: packet, statistic: max, expected: 49}\n"
    )
    before = file.read_bytes()
    refused = cosmos("test", "--update-baselines", "--set", "time.duration_s=6")
    assert (refused.returncode, file.read_bytes()) == (2, before)
    assert "and --set (but that of deadline.* and time.rtf_tolerance)" in refused.stderr
    file.write_text(file.read_text().replace("100", "99").replace("49", "48"))
    loose = ("--set", "deadline.max_miss_ratio=1", "--set", "time.rtf_tolerance=1")
    written = cosmos("test", "--update-baselines", *loose)
    assert file.read_bytes() == before
    assert "scenarios/figures.yaml: 2 expected values written" in written.stderr
    file.write_text(
        "figures:\n"
        "  ticks: {expected: 100, path: timing.ticks}\n"
        "  packets: {stream: round_trips, field: packet, statistic: max, expected: !!int 48}\n"
    )
    scenario(cosmos, "other")
    failed, tests = results(cosmos("test", "--update-baselines", "--json"))
    assert (tests["s"]["outcome"], tests["other"]["outcome"]) == ("failed", "passed")
    assert "figures.packets: no value can be put into what" in " ".join(tests["s"]["reasons"])
    file.write_text(file.read_text().replace("!!int 48", "49"))
    held, tests = results(cosmos("test", "--json"))
    assert (held["exit_code"], [each["passed"] for each in tests["s"]["figures"]]) == (
        0,
        [True] * 2,
    )


def test_a_run_beyond_its_deadline_is_ended_with_all_that_it_started(cosmos, monkeypatch):
    scenario(cosmos, "endless", set={"time.duration_s": 1e7}, deadline_s=4)
    scenario(cosmos, "short")
    document, tests = results(cosmos("test", "--json"))

    assert (document["passed"], document["failed"]) == (1, 1)
    assert tests["endless"]["reasons"] == ["not done after 4 s (its deadline), and ended"]
    nobody_is_left(cosmos, monkeypatch)


def test_ctrl_c_ends_all_runs_cleanly_and_tells_what_was_found(cosmos, monkeypatch):
    scenario(cosmos, "short", set={"time.duration_s": 1})
    for name in ("a", "b", "c"):
        scenario(cosmos, name, set={"time.duration_s": 1e7}, deadline_s=600)
    scenario(cosmos, "in-realtime", set={"time.mode": "realtime"})  # waits for the others
    with cosmos.start(
        "test", "-j", "4", "-k", "not c.yaml", "--json", "--junit", "j.xml"
    ) as process:
        monkeypatch.setenv("COSMOS_STATE_DIR", cosmos.environment["COSMOS_STATE_DIR"])
        wait_until(lambda: sum(entry.role == "host" for entry in list_processes()) >= 2)
        wait_until(lambda: not any("short" in entry.run for entry in list_processes()))
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=120)

    document = json.loads(out)
    assert (process.returncode, document["exit_code"]) == (130, 130), err
    ended = {Path(each["scenario"]).stem: each["outcome"] for each in document["tests"]}
    assert {name: ended[name] for name in ("a", "b")} == dict.fromkeys("ab", "interrupted")
    junit = etree.parse(cosmos.folder / "j.xml")
    SCHEMA.assertValid(junit)
    told = {each.get("name"): each for each in junit.getroot()[0]}
    assert set(told) == {"a", "b", "short", "in-realtime"}
    assert "not run" in told["in-realtime"].find("skipped").get("message")
    nobody_is_left(cosmos, monkeypatch)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("-k", "nothing"), "no tests: none of 1 scenarios is meant"),
        (("-k", "and"), "-k:1:1: expected a word"),
        (("--seeds", "5..1"), "--seeds: expected a range that goes up"),
        (("--seeds", ""), "--seeds: expected numbers or ranges such as 1..20, got ''"),
        (("--seeds", "1..2", "--set", "seed=4"), "--set seed: each run has a seed of --seeds"),
        (("none.yaml",), "none.yaml: no such file or folder"),
        (("--set", "agents.count=0"), "agents.count: expected >= 1"),
        (("--set", "test.deadline_s=1"), "--set test.deadline_s: changes nothing"),
        (("--set", "test={tags: [x]}"), "--set test: changes nothing"),
        (("--update-baselines", "--seeds", "1"), "leave out --seeds"),
        (("--update-baselines", "--realtime-max", "1"), "--full-length, --realtime-max"),
        (("--update-baselines", "--set", "seed=4"), "leave out --seeds"),
        (("--runs", "scenarios/s.yaml/runs"), "tests: cannot be made: Not a directory; choose"),
        (("empty",), "no tests: no scenarios there"),
    ],
)
def test_what_cannot_be_meant_ends_with_2_and_starts_nothing(
    cosmos, monkeypatch, capsys, words, told
):
    scenario(cosmos, "s")
    (cosmos.folder / "empty").mkdir()
    monkeypatch.chdir(cosmos.folder)
    monkeypatch.setenv("COSMOS_RUNS", str(cosmos.runs))
    code, said = run_here(["test", *words]), capsys.readouterr()

    assert (code, said.out) == (2, "")
    assert told in said.err
    assert not (cosmos.runs / "tests").exists()


def test_two_tests_do_not_write_one_baseline(cosmos):
    for name in ("a", "b"):
        scenario(cosmos, name, baseline="figures.yaml")
    (cosmos.folder / "scenarios/figures.yaml").write_text("figures: {a: {path: seed}}\n")
    done = cosmos("test", "--update-baselines")

    assert done.returncode == 2
    assert "each needs its own" in done.stderr


def test_a_baseline_is_not_written_with_the_seed_that_failed_last(cosmos, monkeypatch, capsys):
    path = scenario(cosmos, "s", baseline="figures.yaml")
    file = path.with_name("figures.yaml")
    file.write_text("figures: {a: {path: seed, expected: 0}}\n")
    monkeypatch.setattr("cosmos_cli.commands.test.read_failed", lambda: ((str(path), 7),))
    monkeypatch.setenv("COSMOS_RUNS", str(cosmos.runs))
    code = run_here(["test", str(path), "--last-failed", "--update-baselines"])

    assert code == 2
    assert "figures of the scenario's own: leave out --last-failed" in capsys.readouterr().err
    assert file.read_text() == "figures: {a: {path: seed, expected: 0}}\n"


def test_what_failed_is_told_though_junit_xml_cannot_be_written_at_the_end(
    cosmos, monkeypatch, capsys
):
    path = scenario(cosmos, "s")

    def fail_all(cases, options, tell):
        """Let every test fail, and the folder of the results go."""
        (cosmos.folder / "out").rmdir()
        (cosmos.folder / "out").touch()
        failed = [judge_case(case, make_result(4), is_interrupted=False) for case in cases]
        return SuiteResult(outcomes=failed)

    monkeypatch.setattr("cosmos_cli.commands.test.run_cases", fail_all)
    monkeypatch.setattr("cosmos_cli.commands.test.remember_failed", list)
    monkeypatch.setenv("COSMOS_RUNS", str(cosmos.runs))
    code, said = (
        run_here(["test", str(path), "--junit", str(cosmos.folder / "out/j.xml")]),
        capsys.readouterr(),
    )

    assert code == 2
    assert "out/j.xml: cannot be written: " in said.err
    assert "repeat it: cosmos run" in said.out
    assert "1 failed in" in said.out


def test_the_verdict_of_a_run_is_told_though_junit_xml_cannot_be_written_at_the_end(
    cosmos, monkeypatch, capsys
):
    path = scenario(cosmos, "s")

    def end_without_folder(*about):
        """Return a run that has ended, and let the folder of its results go."""
        (cosmos.folder / "out").rmdir()
        (cosmos.folder / "out").touch()
        run = SimpleNamespace(path=Path("r"), run_json=Path("r/run.json"))
        return SimpleNamespace(
            run=run, document={}, verdict=SimpleNamespace(text=""), last_line="CHECK BROKEN: x"
        )

    monkeypatch.setattr("cosmos_cli.commands.run.execute", end_without_folder)
    code = run_here(["run", str(path), "--junit", str(cosmos.folder / "out/j.xml")])

    assert code == 2
    assert capsys.readouterr().out == "CHECK BROKEN: x\n"


def test_json_stays_one_document_though_junit_xml_cannot_be_written_at_the_end(
    cosmos, monkeypatch, capsys
):
    path = scenario(cosmos, "s")

    def fail_all(cases, options, tell):
        """Let every test fail, and the folder of the results go."""
        (cosmos.folder / "out").rmdir()
        (cosmos.folder / "out").touch()
        failed = [judge_case(case, make_result(4), is_interrupted=False) for case in cases]
        return SuiteResult(outcomes=failed)

    monkeypatch.setattr("cosmos_cli.commands.test.run_cases", fail_all)
    monkeypatch.setattr("cosmos_cli.commands.test.remember_failed", list)
    monkeypatch.setenv("COSMOS_RUNS", str(cosmos.runs))
    code = run_here(["test", str(path), "--json", "--junit", str(cosmos.folder / "out/j.xml")])

    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (code, document["failed"], document["exit_code"]) == (2, 1, 2)
    assert "out/j.xml: cannot be written: " in said.err


def test_a_run_without_a_verdict_takes_the_place_of_an_earlier_one_in_junit_xml(
    cosmos, monkeypatch, capsys
):
    def fail(*_):
        raise MachinesError("pi01 (10.0.0.1): no answer\npi02 (10.0.0.2): no answer")

    path, junit = scenario(cosmos, "s"), cosmos.folder / "j.xml"
    junit.write_text("<testsuites/>")
    monkeypatch.setattr("cosmos_cli.commands.run.execute", fail)
    monkeypatch.setenv("COSMOS_RUNS", str(cosmos.runs))
    code = run_here(["run", str(path), "--junit", str(junit)])

    assert (code, "pi02 (10.0.0.2): no answer" in capsys.readouterr().err) == (3, True)
    SCHEMA.assertValid(etree.parse(junit))
    (failure,) = etree.parse(junit).iter("failure")
    assert failure.get("message") == "pi01 (10.0.0.1): no answer"
    assert "pi02 (10.0.0.2): no answer" in failure.text


@pytest.mark.parametrize(("code", "word"), [(130, "skipped"), (4, "failure"), (None, "failure")])
def test_a_run_that_was_interrupted_is_skipped_in_junit_xml_as_a_test_is(code, word):
    case = junit_case_of(Path("s.yaml"), Path("runs/1"), {"exit_code": code, "verdict": "told"})
    root = etree.fromstring(junit_text([case], seconds=1.0, started_utc="2026-01-01T00:00:00Z"))

    assert [each.tag for each in root[0][0] if each.tag != "properties"] == [word]


def test_a_run_by_itself_writes_junit_xml_too(cosmos):
    path = scenario(cosmos, "s")
    done = cosmos("run", path, "--no-report", "--duration", "1", "--junit", "j.xml")

    assert done.returncode == 0, done.stderr
    junit = etree.parse(cosmos.folder / "j.xml")
    SCHEMA.assertValid(junit)
    assert junit.getroot()[0][0].get("name") == "s"
    refused = cosmos("run", path, "--check", "--junit", "j.xml")
    assert (refused.returncode, "leave out --check" in refused.stderr) == (2, True)


EXAMPLE = """
import numpy as np
import pytest

from cosmos_cli.errors import InputError
from cosmos_cli.testing import run


def test_arrays(tmp_path):
    found = run("scenarios/s.yaml", {"agents.count": 3}, runs=tmp_path, time__duration_s=2)
    assert found.passed and found.exit_code == 0, found.verdict
    assert found.broken == []
    table = found.table("round_trips", "packet")
    assert table["agent-01"]["packet"].dtype == np.int64
    assert sorted(table) == ["agent-01", "agent-02", "agent-03"]
    assert table["agent-02"]["packet"].tolist() == list(range(20))
    assert isinstance(table["agent-01"]["packet"], np.ndarray)
    with pytest.raises(KeyError, match="no stream none; there are"):
        found.table("none")
    with pytest.raises(KeyError, match="no none in round_trips; there are"):
        found.table("round_trips", "none")


def test_settings_of_numpy_and_paths(tmp_path):
    found = run("scenarios/s.yaml", runs=str(tmp_path), description=tmp_path, time__duration_s=np.float64(1), agents={"count": np.int64(3)})
    assert found.document["timing"]["ticks"] == 30
    assert str(tmp_path) in (found.directory.path / "scenario.yaml").read_text()


def test_refused(tmp_path):
    with pytest.raises(InputError, match="--set agents.count: expected a text, a number.* got set"):
        run("scenarios/s.yaml", runs=tmp_path, agents__count={3})
    with pytest.raises(InputError, match="agents.count: expected >= 1"):
        run("scenarios/s.yaml", runs=tmp_path, agents__count=0)
"""


def test_from_pytest_a_run_gives_its_verdict_and_its_records_as_arrays(cosmos):
    scenario(cosmos, "s")
    (cosmos.folder / "test_mine.py").write_text(EXAMPLE)
    words = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "test_mine.py"]
    done = subprocess.run(
        [sys.executable, *words],
        cwd=cosmos.folder,
        env=cosmos.environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 passed" in done.stdout
