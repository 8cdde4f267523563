import json
import os
import shutil

import pyarrow.parquet as pq
import pytest
from harness.synthetic_run import SyntheticRun

from cosmos_cli import app
from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.run_documents import Problem

pytestmark = pytest.mark.usefixtures("own_places")


@pytest.fixture
def made(tmp_path):
    return SyntheticRun(tmp_path / "runs").write()


def finish(made):
    return finish_run(made.run, made.result(), made.expected)


def test_collect_prints_the_verdict_as_run_does_and_tells_the_package(made, capsys):
    finish(made)

    code = app.run(["collect", "1"])

    out, err = capsys.readouterr()
    assert code == 0
    assert out == f"PASSED: 11 checks hold | {made.run.path}\n"
    assert f"packed: {made.run.bundle}\n" in err


def test_collect_of_a_cut_off_run_ends_with_5_and_names_what_is_missing(made, capsys):
    made.kill("agent-01")

    code = app.run(["collect", "last"])

    err = capsys.readouterr().err
    assert code == 5
    assert "host: no result" in err
    assert "agent-01: " in err
    assert made.run.bundle.exists()


def test_collect_tells_how_records_come_back_from_a_package_that_it_keeps_for_them(made, capsys):
    finish(made)
    made.stream("agent-01", "ticks").write_bytes(b"")

    assert app.run(["collect", "1"]) == 5

    err = capsys.readouterr().err
    member = f"{made.run.name}/agents/agent-01/ticks.jsonl"
    assert f"tar -xf {made.run.bundle} -C {made.run.path} --strip-components=1 {member};" in err
    assert "packed:" not in err


def test_collect_as_json_prints_run_json_alone(made, capsys):
    finish(made)

    assert app.run(["collect", "--json", "--quiet"]) == 0

    out, err = capsys.readouterr()
    assert json.loads(out) == made.run.read_json(made.run.run_json)
    assert err == ""


def test_runs_lists_what_was_run(made, capsys):
    finish(made)
    SyntheticRun(made.run.path.parent)

    assert app.run(["runs", "--json"]) == 0

    first, second = json.loads(capsys.readouterr().out)
    assert (first["run"], first["status"], first["exit_code"]) == ("0001-synthetic", "complete", 0)
    assert (second["run"], second["status"]) == ("0002-synthetic", "cut off")


@pytest.mark.parametrize(
    ("status", "shown"), [("complete", "20 s "), ("interrupted", "20 s planned")]
)
def test_runs_tell_a_planned_duration_from_one_that_was_simulated(made, capsys, status, shown):
    finish_run(made.run, made.result(status=status), made.expected, has_report=False)

    assert app.run(["runs"]) == 0

    (line,) = [x for x in capsys.readouterr().out.splitlines() if "0001-synthetic" in x]
    assert f"  {shown}" in line


def test_run_that_went_on_without_its_operator_is_not_called_cut_off(made, capsys):
    plan = made.run.read_json(made.run.plan_json)
    made.run.plan_json.write_text(json.dumps(plan | {"is_detached": True}))

    assert app.run(["runs", "--json"]) == 0

    (entry,) = json.loads(capsys.readouterr().out)
    assert (entry["status"], entry["exit_code"]) == ("detached", None)


def test_runs_of_an_empty_folder_says_how_to_make_one(capsys):
    assert app.run(["runs"]) == 0

    out, err = capsys.readouterr()
    assert out == ""
    assert "cosmos run SCENARIO" in err


def test_report_shows_verdict_checks_and_tables(made, capsys):
    finish(made)

    assert app.run(["report"]) == 0

    out = capsys.readouterr().out
    assert out.startswith("0001-synthetic: PASSED")
    for text in (
        "deadline.miss_ratio",
        "Round trips by agent, ms",
        "agent-02",
        "p99.9",
        "lateness",
    ):
        assert text in out
    assert "no temperature sensor" in out


def test_report_names_the_page_with_figures_only_where_it_is(made, capsys):
    finish(made)
    made.run.report_html.unlink(missing_ok=True)  # as `cosmos run --no-report` leaves it

    assert app.run(["report"]) == 0
    err = capsys.readouterr().err
    assert "with figures" not in err
    assert "--html FILE draws them" in err

    made.run.report_html.write_text("<html>")
    assert app.run(["report"]) == 0
    assert f"with figures: {made.run.report_html}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["", ".", "/"])  # "" as of a variable that is not set
def test_report_takes_no_folders_place(made, capsys, name):
    finish(made)

    assert app.run(["report", "1", "--html", name]) == 2

    assert "cannot be written: it is a folder; name a file" in capsys.readouterr().err


def test_report_writes_html_where_it_is_told_to(made, tmp_path, capsys):
    finish(made)
    target = tmp_path / "here.html"

    assert app.run(["report", "1", "--html", str(target)]) == 0

    assert "PASSED" in target.read_text()
    assert capsys.readouterr().out == ""


def test_report_to_an_impossible_path_is_bad_input(made, tmp_path, capsys):
    finish(made)

    assert app.run(["report", "1", "--html", str(tmp_path / "no/such/here.html")]) == 2

    assert "no/such/here.html: cannot be written" in capsys.readouterr().err


def test_report_as_json_to_an_impossible_path_is_one_document(made, tmp_path, capsys):
    finish(made)

    assert app.run(["report", "1", "--json", "--html", str(tmp_path / "no/such/here.html")]) == 2

    document = json.loads(capsys.readouterr().out)
    assert "no/such/here.html: cannot be written" in document["error"]["message"]


def test_report_takes_no_devices_place(made, tmp_path, capsys):
    finish(made)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)

    assert app.run(["report", "1", "--html", str(pipe)]) == 2

    assert "pipe: cannot be written: it is a device, a pipe or a stream" in capsys.readouterr().err
    assert pipe.is_fifo()


def test_report_of_a_run_that_is_not_collected_says_what_to_do(made, capsys):
    assert app.run(["report", "1"]) == 2

    assert "cosmos collect 1" in capsys.readouterr().err


def test_judge_of_a_run_that_failed_is_no_pass_and_names_what_ended_it(made, tmp_path, capsys):
    finish_run(made.run, made.result(status="failed", who="host", reason="boom"), made.expected)
    checks = tmp_path / "checks.yaml"
    checks.write_text(
        "name: some\nsimulation: counter\nagents: {count: 2, tick_hz: 10}\ntime: {duration_s: 20}\n"
        "checks: [{name: some, stream: round_trips, statistic: count, above: 1}]\n"
    )

    code = app.run(["judge", "1", "-s", str(checks), "--json"])

    document = json.loads(capsys.readouterr().out)
    assert (code, document["exit_code"]) == (1, 1)
    assert document["verdict"] == "FAILED: host: boom; judged by what it recorded: 1 check holds"


@pytest.mark.parametrize("verb", ["report", "judge", "tabulate", "rerun", "diff"])
def test_run_that_lives_is_to_be_waited_for_as_collecting_it_would_be_refused_too(
    made, capsys, monkeypatch, verb
):
    living = made.living_agent()
    monkeypatch.setattr("cosmos_cli.collect.finished_run.list_processes", lambda: [living])
    monkeypatch.setattr("cosmos_cli.commands.judge.list_processes", lambda: [living])

    assert app.run([verb, "1", *(["1"] if verb == "diff" else [])]) == 2

    told = capsys.readouterr().err
    assert "is still running: agent agent-02 (pid 4242); wait for its end" in told
    assert "not collected" not in told


@pytest.mark.parametrize("verb", ["report", "judge", "tabulate", "rerun", "diff"])
def test_commands_to_be_copied_name_a_folder_with_a_space_as_a_shell_takes_it(
    tmp_path, capsys, verb
):
    run = SyntheticRun(tmp_path / "my runs").write().run

    assert app.run([verb, str(run.path), *([str(run.path)] if verb == "diff" else [])]) == 2

    assert f"cosmos collect '{run.path}'" in capsys.readouterr().err


def test_report_on_the_terminal_tells_all_that_did_not_go_as_it_should_as_the_page_does(
    made, capsys
):
    made.kill("agent-01")
    problems = [Problem(text=f"agent-0{n} (pid {n}) had to be killed") for n in range(1, 6)]
    finish_run(made.run, made.result(), made.expected, problems=problems)

    assert app.run(["report", "1"]) == 0

    told = capsys.readouterr().out.splitlines()
    assert [f"problem: {problem.text}" for problem in problems] == [
        line for line in told if line.startswith("problem: ")
    ]


def test_verdict_that_is_not_there_is_said_to_be_none(made, capsys):
    finish(made)
    document = json.loads(made.run.run_json.read_text())
    del document["verdict"]
    made.run.run_json.write_text(json.dumps(document))

    assert app.run(["report", "1"]) == 0

    assert capsys.readouterr().out.splitlines()[0] == "0001-synthetic: no verdict"


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_pipe_among_the_tables_is_named_and_not_waited_for(made, capsys):
    finish(made)
    os.mkfifo(made.run.tables / "pipe.parquet")

    assert app.run(["report", "1"]) == 0
    assert "tables/pipe.parquet cannot be read" in " ".join(capsys.readouterr().out.split())
    assert app.run(["diff", "1", "1"]) == 0
    assert "links or no files: tables/pipe.parquet" in capsys.readouterr().out
    assert app.run(["collect", "1"]) == 0


@pytest.mark.parametrize("arguments", [["report", "1"], ["diff", "1", "1"]])
def test_table_that_no_collection_made_is_not_read_for_the_run(made, capsys, arguments):
    finish(made)
    (made.run.tables / "foreign.parquet").write_bytes(
        (made.run.tables / "round_trips.parquet").read_bytes()
    )

    assert app.run(arguments) == 2
    assert "foreign.parquet: no collection made it" in capsys.readouterr().err

    made.run.manifest_json.unlink()  # nobody knows what was collected
    assert app.run(arguments) == 0


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_stream_of_terabytes_is_read_by_no_command(made, capsys):
    finish(made)
    os.truncate(made.run.path / "agents/agent-01/ticks.jsonl", 9 * 10**12)

    assert app.run(["diff", "1", "1"]) == 0
    assert "agents/agent-01/ticks.jsonl: not read: it is 9.0 TB" in capsys.readouterr().out
    assert app.run(["collect", "1", "--no-retrieve", "--size-max", "2GB"]) == 5
    assert "can have recorded at most 2.0 GB" in capsys.readouterr().err
    assert app.run(["report", "1"]) == 0


@pytest.mark.parametrize("command", ["runs", "report", "collect", "logs", "tabulate", "diff"])
def test_file_in_place_of_the_folder_of_runs_is_bad_input(tmp_path, capsys, command):
    (tmp_path / "file").touch()
    which = [] if command == "runs" else ["1", "2"] if command == "diff" else ["1"]

    assert app.run([command, *which, "--runs", str(tmp_path / "file")]) == 2

    assert "file: expected the folder of all runs: Not a directory" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["t.csv", "t.json", "t.parquet.gz"])
def test_table_is_not_written_under_the_suffix_of_another_format(made, tmp_path, capsys, name):
    finish(made)

    assert app.run(["tabulate", "1", "--output", str(tmp_path / name)]) == 2

    told = capsys.readouterr().err
    assert f"{name}: the table is a Parquet file; expected a name such as " in told
    assert not (tmp_path / name).exists()


def test_table_of_a_run_whose_plan_is_lost_is_refused_for_that_and_not_for_want_of_a_collection(
    made, capsys
):
    finish(made)
    made.run.plan_json.unlink()

    assert app.run(["tabulate", "1"]) == 2

    told = capsys.readouterr().err
    assert f"{made.run.plan_json}: missing; put it back as it was" in told
    assert "cosmos collect" not in told


@pytest.mark.slow
def test_linked_run_is_neither_collected_nor_written_into(made, tmp_path, capsys):
    finish(made)
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "run.json").write_text("precious")
    (made.run.path.parent / "0099-evil").symlink_to(victim)

    assert app.run(["collect", "last"]) == 0
    assert app.run(["collect", "99"]) == 2

    assert "0099-evil: a link, which is not followed" in capsys.readouterr().err
    assert [path.name for path in victim.iterdir()] == ["run.json"]
    assert (victim / "run.json").read_text() == "precious"


@pytest.mark.parametrize("which", ["1", "0001-synthetic", "0001-synthetic.tar.zst", "last"])
def test_run_of_which_only_the_package_is_left_is_named_with_the_way_to_unpack_it(
    made, capsys, which
):
    finish(made)
    shutil.rmtree(made.run.path)

    assert app.run(["report", which]) == 2

    root = made.run.path.parent
    told = capsys.readouterr().err
    assert (
        f"0001-synthetic: packed, its folder is gone; unpack it with: tar -xf {made.run.bundle}"
        in told
    )
    assert f" -C {root}" in told


def test_package_that_is_named_by_its_path_is_told_from_a_folder_that_is_not_there(made, capsys):
    finish(made)

    assert app.run(["diff", "1", str(made.run.bundle)]) == 2

    assert "a packed run; unpack it with: tar -xf " in capsys.readouterr().err


def test_unknown_run_is_bad_input(made, capsys):
    assert app.run(["collect", "9"]) == 2

    assert "0001-synthetic" in capsys.readouterr().err


def of_newer_schema(path):
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"schema": 2, "versions": {"cosmos-madns": "9.1"}}))


@pytest.mark.parametrize("name", ["run.json", "manifest.json"])
@pytest.mark.parametrize(
    "command",
    [
        ["collect", "1"],
        ["report", "1"],
        ["judge", "1"],
        ["tabulate", "1"],
        ["diff", "1", "1"],
        ["rerun", "1"],
        ["logs", "1"],
        ["inject", "1", "--list"],
    ],
    ids=lambda command: command[0],
)
def test_run_of_a_newer_program_is_refused_and_left_as_it_is(made, capsys, command, name):
    finish(made)
    path = made.run.path / name
    of_newer_schema(path)
    before = path.read_bytes()

    code = app.run(command)

    told = capsys.readouterr().err
    assert code == 2
    assert f"{name}: schema 2 is of a newer COSMoS (9.1), this one knows 1" in told
    assert "upgrade cosmos-madns" in told
    assert path.read_bytes() == before


def test_runs_tells_of_a_run_of_a_newer_program(made, capsys):
    finish(made)
    of_newer_schema(made.run.run_json)

    assert app.run(["runs", "--json"]) == 0

    (entry,) = json.loads(capsys.readouterr().out)
    assert entry["verdict"].startswith("run.json: schema 2 is of a newer COSMoS (9.1)")


def test_records_of_a_newer_program_are_named_and_make_a_run_incomplete(made, capsys):
    path = made.stream("agent-01", "ticks")
    path.write_text(path.read_text().replace('"schema":1', '"schema":2', 1))
    finish(made)

    assert app.run(["collect", "1"]) == 5
    assert (
        "agent-01: ticks schema 2 is of a newer COSMoS, this one knows 1" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    "arguments",
    [["report", "1"], ["runs"], ["runs", "--json"], ["init", "x"], ["test"]],
)
def test_current_folder_that_was_deleted_is_told_as_such(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.delenv("COSMOS_RUNS", raising=False)
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()

    assert app.run(arguments) == 2
    assert "the current folder is gone" in capsys.readouterr().err


def test_report_tells_of_a_table_that_is_not_as_it_was_collected(made, capsys):
    """As one that somebody wrote again with another program, which may put records of two agents into one group."""
    finish(made)
    path = made.run.tables / "round_trips.parquet"
    rows = pq.read_table(path)
    pq.write_table(rows, path)
    page = made.run.path.parent / "page.html"

    assert app.run(["report", "1"]) == 0
    assert app.run(["report", "1", "--html", str(page)]) == 0

    remark = "tables/round_trips.parquet is not as it was collected: what is told of it need not be of the run"
    assert remark in capsys.readouterr().out
    assert remark in page.read_text()
    assert app.run(["collect", "1"]) == 0  # makes it anew
    capsys.readouterr()
    assert app.run(["report", "1"]) == 0
    assert "not as it was collected" not in capsys.readouterr().out
