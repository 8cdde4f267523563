"""The commands that start nothing: init, validate, schema, plan, inventory; and how errors leave."""

import errno
import json
import math
import os
import pwd
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from cosmos_cli import app
from cosmos_cli.cache import cache_folder
from cosmos_cli.commands import command_group, runs, validate
from cosmos_cli.commands.init import render, write_new
from cosmos_cli.errors import ExitCode, InputError, RunFailedError
from cosmos_cli.launch.feasibility import Resources, judge
from cosmos_cli.launch.plan_view import verdict_words
from cosmos_cli.models import parameters, scenario_outline, timeline
from cosmos_cli.models.loading import load_scenario
from madns_runtime.errors import MachineError, MissingExtraError, PluginError
from madns_runtime.plugin.api import Demand

ROOT = Path(__file__).parents[3]
SCENARIO = "name: a\nsimulation: counter\nagents: {count: 3}\n"
TEMPLATES = ("benchmark", "constellation", "plugin", "device")


@pytest.fixture
def cosmos(tmp_path, monkeypatch, capsys):
    """Return a function that runs the command line in an empty folder: (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    for name in ("COSMOS_DEBUG", "COSMOS_INVENTORY", "COSMOS_LIMIT", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "a.yaml").write_text(SCENARIO)

    def run(*arguments):
        code = app.run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_validate_says_what_was_found(cosmos):
    assert cosmos("validate", "a.yaml") == (
        0,
        "a.yaml: ok: a, 3 agents of counter at 10 Hz for 60 s\n",
        "",
    )


@pytest.mark.parametrize(
    "words",
    [
        ("validate", "\udcff.yaml"),
        ("validate", "a.yaml", "\udcff.yaml"),
        ("validate", "below.yaml"),
        ("inventory", "-i", "pi01,", "-i", "\udcff.yaml"),
        ("test", "\udcff.yaml"),
    ],
)
def test_file_whose_path_is_no_text_is_refused_and_never_left_out(cosmos, words):
    Path("\udcff.yaml").write_text(SCENARIO)
    Path("below.yaml").write_text("extends: link.yaml\n")
    Path("link.yaml").symlink_to("\udcff.yaml")

    code, _, err = cosmos(*words)

    assert code == ExitCode.BAD_INPUT
    assert "expected a path in UTF-8; rename the folder or file" in err


@pytest.mark.parametrize("words", [(), ("--resolved",)])
def test_validate_keeps_a_file_with_a_line_end_in_its_name_on_one_line(cosmos, words):
    Path("a\nb.yaml: ok.yaml").write_text(SCENARIO)

    code, out, _ = cosmos("validate", *words, "a\nb.yaml: ok.yaml")

    assert code == 0
    assert "a\\nb.yaml: ok.yaml: ok: a, 3 agents" in out.splitlines()[0]


def test_a_fault_in_a_file_with_a_line_end_in_its_name_is_on_one_line(cosmos):
    Path("a\nb.yaml: ok.yaml").write_text(SCENARIO + "seed: -1\n")

    _, _, faulty = cosmos("validate", "a\nb.yaml: ok.yaml")
    _, _, missing = cosmos("validate", "c\nd.yaml")

    assert faulty.splitlines()[0] == "a\\nb.yaml: ok.yaml:4:7: seed: expected >= 0, got -1"
    assert missing.splitlines()[0].startswith("c\\nd.yaml: no such file")


def test_validate_shows_the_faults_of_all_files(cosmos):
    Path("b.yaml").write_text(SCENARIO + "sed: 1\n")
    Path("c.yaml").write_text(SCENARIO + "seed: -1\n")

    code, out, err = cosmos("validate", "b.yaml", "a.yaml", "c.yaml")

    assert code == ExitCode.BAD_INPUT
    assert out.startswith("a.yaml: ok")
    assert err == (
        "b.yaml:4:1: sed: unknown key, did you mean seed?\n    sed: 1\n    ^\n"
        "c.yaml:4:7: seed: expected >= 0, got -1\n    seed: -1\n          ^\n"
    )


def test_validate_goes_on_behind_what_no_line_of_a_file_is_to_blame_for(cosmos, monkeypatch):
    Path("b.yaml").write_text(SCENARIO)
    Path("c.yaml").write_text(SCENARIO + "seed: -1\n")
    lacking = "thing is not installed here; install it with: pip install 'cosmos-madns[host]'\n"

    def load(path, *arguments, **more):
        if path.name == "b.yaml":
            raise MissingExtraError("thing", "host")
        return load_scenario(path, *arguments, **more)

    monkeypatch.setattr(validate, "load_scenario", load)
    code, out, err = cosmos("validate", "b.yaml", "c.yaml", "a.yaml")

    assert code == ExitCode.BAD_INPUT
    assert out.startswith("a.yaml: ok")
    assert err.startswith(f"b.yaml: {lacking}c.yaml:4:7: seed: ")
    assert cosmos("validate", "b.yaml")[2] == f"error: {lacking}"


def test_validate_json_holds_the_whole_scenario(cosmos):
    code, out, err = cosmos("validate", "a.yaml", "--json", "--set", "seed=7")

    result = json.loads(out)
    assert (code, err, result["valid"]) == (0, "", True)
    assert result["scenarios"][0]["scenario"]["seed"] == 7
    assert result["scenarios"][0]["scenario"]["deadline"]["overrun_ms"] == 5.0


@pytest.mark.process
@pytest.mark.parametrize(
    "command",
    [
        ("plan", "b.yaml"),
        ("run", "b.yaml", "--no-report"),
        ("run", "b.yaml", "--check"),
        ("diff", "--run", "b.yaml", "a.yaml"),
        ("doctor", "b.yaml"),
        ("up", "b.yaml", "--check", "-i", "i.yaml"),
    ],
    ids=" ".join,
)
def test_each_command_that_reads_a_scenario_tells_an_old_name_once(cosmos, monkeypatch, command):
    lockstep = "time: {mode: lockstep, duration_s: 0.2}\n"
    Path("a.yaml").write_text(SCENARIO + lockstep)
    Path("b.yaml").write_text(SCENARIO + lockstep + "deadline: {tolerance_ms: 5}\n")
    Path("i.yaml").write_text("all: {hosts: {here: {ansible_connection: local}}}\n")

    _, _, err = cosmos(*command)

    assert err.count("deadline.tolerance_ms: is an old name: write deadline.overrun_ms") == 1


def test_validate_tells_old_names_on_stderr_and_is_content(cosmos):
    Path("b.yaml").write_text(SCENARIO + "deadline: {tolerance_ms: 5}\n")

    code, out, err = cosmos("validate", "b.yaml")

    assert code == ExitCode.OK
    assert out.startswith("b.yaml: ok")
    assert "b.yaml:4:12: deadline.tolerance_ms: is an old name: write deadline.overrun_ms" in err


def test_faults_are_json_on_stdout_too(cosmos):
    code, out, err = cosmos("validate", "a.yaml", "--json", "--set", "seed=x")

    result = json.loads(out)
    assert code == result["exit_code"] == 2
    assert result["error"]["kind"] == "input"
    assert result["error"]["faults"] == [
        {
            "file": None,
            "line": None,
            "column": None,
            "path": "seed",
            "override": "seed",
            "message": "expected a whole number, got 'x'",
        }
    ]
    assert err == "--set seed: expected a whole number, got 'x'\n"


@pytest.mark.slow
def test_schema_with_json_is_the_schema_and_what_was_done_a_document(cosmos):
    assert cosmos("schema", "--json")[1] == cosmos("schema")[1]

    assert json.loads(cosmos("schema", "-o", "s.json", "--json")[1])["status"] == "written"
    code, out, _ = cosmos("schema", "-o", "s.json", "--check", "--json")

    assert (code, json.loads(out)) == (0, {"file": "s.json", "status": "current", "exit_code": 0})


def test_missing_choice_is_named_as_in_the_help_on_one_line(cosmos):
    code, _, err = cosmos("packages", "-i", "pi01,")

    words = "error: Missing argument 'ACTION'. Choose from: install, remove, upgrade\n"
    assert (code, err) == (2, f"{words}see `cosmos packages --help`\n")


def test_schema_is_printed_written_and_checked(cosmos):
    _, out, _ = cosmos("schema")
    assert cosmos("schema", "-o", "s.json")[0] == 0
    assert Path("s.json").read_text() == out
    assert cosmos("schema", "-o", "s.json", "--check")[0] == 0

    Path("s.json").write_text("{}")
    code, _, err = cosmos("schema", "-o", "s.json", "--check")

    assert code == ExitCode.BAD_INPUT
    assert err == "error: s.json: is not current; write it with: cosmos schema --output s.json\n"


@pytest.mark.parametrize(
    "words",
    [
        ("schema", "--output", "-"),
        ("schema", "--output", "-", "--check"),
        ("test", "a.yaml", "--junit", "-"),
        ("run", "a.yaml", "--junit", "-"),
    ],
)
def test_dash_is_refused_in_place_of_a_file(cosmos, words):
    code, _, err = cosmos(*words)

    assert code == ExitCode.BAD_INPUT
    assert "it is no file, and nothing goes to stdout; name a file" in err
    assert not Path("-").exists()
    assert not Path("runs").exists()


@pytest.mark.process
def test_installed_simulations_that_do_not_load_are_left_out_of_the_schema_and_told(
    cosmos, tmp_path, monkeypatch
):
    _, shipped, _ = cosmos("schema")
    info = tmp_path / "installed/broken_sims-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-sims\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[madns.simulations]\nbroken = broken_sim:simulation\ngone = no_such_module:simulation\n"
    )
    (info.parent / "broken_sim.py").write_text("raise RuntimeError('no licence')\n")
    monkeypatch.syspath_prepend(info.parent)

    code, out, err = cosmos("schema")

    assert (code, out) == (0, shipped)
    assert "broken is left out: " in err
    assert "RuntimeError: no licence" in err
    assert "gone is left out: no_such_module:simulation: No module named 'no_such_module'" in err


def test_schema_that_is_kept_in_scenarios_is_checked_by_default(cosmos):
    Path("scenarios").mkdir()
    cosmos("schema", "-o", "scenarios/scenario.schema.json")

    assert cosmos("schema", "--check") == (0, "", "scenarios/scenario.schema.json: current\n")


def test_schema_that_cannot_be_written_says_why(cosmos):
    assert cosmos("schema", "-o", "no/s.json") == (
        2,
        "",
        "error: no/s.json: No such file or directory\n",
    )


def test_plan_shows_placement_and_inequalities(cosmos):
    code, out, err = cosmos("plan", "a.yaml", "--latency-ms", "0.5")

    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert lines[1].split() == [
        "loopback",
        "127.0.0.1",
        "3",
        "3",
        "agent-01,",
        "agent-02,",
        "agent-03",
    ]
    flows = ["count", "count", "ping", "pong", "acknowledgements"]
    assert [line.split()[0] for line in lines[4:9]] == flows
    assert any(line.startswith("predicted at ") for line in lines)
    assert [line.split()[0] for line in lines[-6:-2]] == ["2.7", "2.8", "2.9", "2.10"]
    assert "T_n = 0.5 ms (given)" in lines[-2]
    assert lines[-1].startswith("3 agents keep real time; 2.10 binds first, at ")


def test_plan_of_an_impossible_run_ends_with_4(cosmos):
    code, out, _ = cosmos("plan", "a.yaml", "--bandwidth-mbit", "0.001")

    assert code == ExitCode.BUDGET_BROKEN
    assert out.splitlines()[-1] == "3 agents cannot keep real time: inequality 2.10 is broken"


def test_plan_of_more_agents_than_it_predicts_does_not_say_that_they_keep_real_time(cosmos):
    code, out, _ = cosmos(
        "plan", "a.yaml", "--set", "agents.tick_hz=10000", "--latency-ms", "0.001"
    )

    *_, last = out.splitlines()
    assert code == ExitCode.OK
    assert last.startswith(
        "3 agents may not keep real time: the inequalities hold, but up to 0 are predicted, by "
    )


def test_plan_of_a_flow_that_never_sends_again_as_json(cosmos):
    # The time to the next message of so low a rate is infinite as a number.
    flow = "plan.flows=[{name: rare, message_bytes: 8, rate_hz: 1.0e-320}]"

    code, out, err = cosmos("plan", "a.yaml", "--set", flow, "--json")

    assert (code, err) == (ExitCode.OK, "")
    assert json.loads(out)["demand"]["flows"][0]["within_s"] is None


def test_plan_names_several_broken_inequalities_in_the_plural():
    demand = Demand(
        flows=(),
        buffer_s=math.inf,
        batch_bytes=0,
        batch_compute_s=0,
        sync_bytes=1,
        sync_compute_s=1.0,
        sync_rate_hz=1.0,
        lead_s=0.01,
        measured=False,
    )
    resources = Resources(workers=1, bandwidth_bytes_s=1e9, latency_s=0.0)

    words = verdict_words(judge(demand, resources, agents=2, tick_hz=10))

    assert words == "2 agents cannot keep real time: inequalities 2.8 and 2.9 are broken"


def test_plan_over_an_inventory_as_json(cosmos):
    tower = ROOT / "inventory/tower.yaml"

    code, out, _ = cosmos("plan", "a.yaml", "-i", tower, "--json", "--workers", "2")

    result = json.loads(out)
    assert code == 0
    assert list(result["plan"]["machines"]) == ["pi01", "pi02", "pi03"]
    assert len(result["plan"]["idle"]) == 21
    assert result["resources"]["latency_source"] == "assumed"
    assert result["resources"]["workers"] == 2
    assert result["feasibility"]["holds"] is True


def test_plan_shows_what_a_run_with_the_same_options_will_do(cosmos):
    tower = ROOT / "inventory/tower.yaml"
    some = ("-i", tower, "--limit", "pi01,pi02,pi05", "--host", "pi02", "--latency-ms", "0.5")

    code, out, _ = cosmos("plan", "a.yaml", *some)
    plan = json.loads(cosmos("plan", "a.yaml", *some, "--json")[1])["plan"]

    assert code == 0
    assert "the host runs on pi02" in out
    assert plan["host"]["name"] == "pi02"
    assert {name: len(machine["agents"]) for name, machine in plan["machines"].items()} == {
        "pi01": 2,
        "pi05": 1,
    }


def test_plan_of_a_host_without_an_inventory_is_bad_input(cosmos):
    code, _, err = cosmos("plan", "a.yaml", "--host", "pi02")

    assert code == ExitCode.BAD_INPUT
    assert "--host pi02: there is no machine without an inventory; give one with -i" in err


def test_plan_of_one_agent_speaks_of_one(cosmos):
    _, out, _ = cosmos("plan", "a.yaml", "--set", "agents.count=1", "--latency-ms", "0.5")

    assert "\n1 agent keeps real time; " in out


@pytest.mark.parametrize("verb", ["run", "plan"])
def test_help_says_what_holds_by_default(cosmos, verb):
    _, out, _ = cosmos(verb, "--help")

    words = " ".join(out.replace("│", " ").split())
    assert "Machine that runs the host; default: this computer." in words
    assert "the machines to run on; default: this computer alone." in words


def test_plan_without_a_latency_measures_loopback(cosmos):
    _, out, _ = cosmos("plan", "a.yaml", "--json")

    resources = json.loads(out)["resources"]
    assert resources["latency_source"] == "measured on loopback"
    assert resources["latency_s"] > 0


@pytest.mark.process
def test_plan_of_a_simulation_that_does_not_tell_its_demand(cosmos):
    cosmos("init", "rover", "--template", "plugin")

    code, out, _ = cosmos("plan", "rover.yaml", "--set", "plan.lead_s=1")

    assert code == 0
    assert "does not say what it asks for" in out
    # What is given by itself is not enough, and is not passed over without a word.
    assert "with batch_bytes, batch_compute_s, buffer_s, sync_bytes, sync_compute_s, flows\n" in out


def test_inventory_lists_machines(cosmos):
    code, out, _ = cosmos("inventory", "-i", ROOT / "inventory/tower.yaml")

    lines = out.splitlines()
    assert code == 0
    assert lines[0].split() == ["machine", "address", "connection", "user", "groups", "devices"]
    assert lines[22].split() == ["pi22", "pi22", "ssh", "pi", "all,", "hwil,", "tower", "sense_hat"]
    assert lines[-1] == "25 machines"


def test_inventory_is_limited(cosmos):
    code, out, _ = cosmos(
        "inventory", "-i", ROOT / "inventory/tower.yaml", "--limit", "tower:&hwil", "--json"
    )

    (machine,) = json.loads(out)["machines"]
    assert code == 0
    assert list(machine) == ["name", "groups", "vars"]
    assert (machine["name"], machine["groups"]) == ("pi22", ["all", "hwil", "tower"])
    assert machine["vars"]["cosmos_devices"] == ["sense_hat"]


def test_limit_to_nothing_is_bad_input(cosmos):
    code, out, err = cosmos("inventory", "-i", ROOT / "inventory/tower.yaml", "--limit", "twer")

    assert (code, out) == (2, "")
    assert err == "error: --limit twer: no machine or group is named twer, did you mean tower?\n"


@pytest.mark.process
@pytest.mark.parametrize("template", TEMPLATES)
def test_templates_validate_as_they_are(cosmos, template):
    code, out, err = cosmos("init", "my-sim", "--template", template, "-d", "new")

    assert code == 0
    assert "new/my-sim.yaml" in out.splitlines()
    assert err == "next: cosmos validate new/my-sim.yaml; then cosmos run new/my-sim.yaml\n"
    assert cosmos("validate", "new/my-sim.yaml")[0] == 0


@pytest.mark.parametrize("name", ["2024", "1e3", "0x1f", "null", "true", "9" * 40])
def test_a_name_that_yaml_takes_for_no_text_is_a_name_all_the_same(cosmos, name):
    assert cosmos("init", name, "-d", "new")[0] == 0

    code, out, err = cosmos("validate", f"new/{name}.yaml")
    assert (code, err) == (0, "")
    assert out.startswith(f"new/{name}.yaml: ok: {name}, 4 agents of counter")


@pytest.mark.parametrize("template", (*TEMPLATES, "package"))
def test_templates_leave_no_placeholder(template):
    files = render(template, "my-sim")

    assert files
    for path, text in files.items():
        assert not [word for word in ("@NAME@", "@MODULE@") if word in text or word in str(path)]
        assert "://" not in text, path  # what is written needs no page elsewhere


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("4cars", "Python can import"),
        ("class", "Python can import"),
        ("json", "is taken"),
        ("counter", "is taken"),
        ("numpy", "is taken by a module of Python or of an installed package"),
        ("madns-runtime", "is taken"),
        ("cars-", "expected a letter or digit at the end"),
        ("streams", "no simulation can be called"),
        ("test", "tests or those beside the package are called"),
        ("tests", "tests or those beside the package are called"),
    ],
)
def test_package_has_a_name_that_can_be_imported_and_is_free(cosmos, name, text):
    code, _, err = cosmos("init", name, "--template", "package")

    assert code == ExitCode.BAD_INPUT
    assert text in err
    assert os.listdir() == ["a.yaml"]


@pytest.mark.parametrize("template", ["plugin", "device"])
def test_a_file_that_would_hide_a_module_is_not_written(cosmos, template):
    code, _, err = cosmos("init", "json", "--template", template)

    assert (code, "which it would hide" in err) == (ExitCode.BAD_INPUT, True)
    assert os.listdir() == ["a.yaml"]
    assert cosmos("init", "json")[0] == 0  # of a scenario alone Python imports nothing


def test_init_tells_commands_that_a_shell_takes_as_they_stand(cosmos):
    _, _, err = cosmos("init", "rover", "--template", "package", "-d", "my box")

    assert (
        "next: pip install -e 'my box/rover'; then cosmos validate 'my box/rover/rover.yaml'" in err
    )


def test_init_overwrites_nothing(cosmos):
    Path("rover.py").write_text("mine\n")

    code, _, err = cosmos("init", "rover", "--template", "plugin")

    assert code == ExitCode.BAD_INPUT
    assert err.startswith("error: rover.py exists already and is left as it is")
    assert Path("rover.py").read_text() == "mine\n"
    assert not Path("rover.yaml").exists()


@pytest.mark.parametrize(
    "words", [("--", "ip", "--json"), ("ip", "--json"), ("-l", "--json", "ip")]
)
def test_the_json_of_a_command_that_exec_runs_is_not_its_own(cosmos, words):
    Path("box.yaml").write_text("all:\n  hosts: {pi01: {cosmos_rot: x}}\n")

    code, out, err = cosmos("exec", "-i", "box.yaml", *words)

    assert (code, out) == (ExitCode.BAD_INPUT, "")
    assert "cosmos_rot: unknown variable" in err
    _, out, _ = cosmos("exec", "-i", "box.yaml", "--json", *words)
    assert json.loads(out)["exit_code"] == ExitCode.BAD_INPUT


@pytest.mark.parametrize("arguments", [("vlidate", "--json"), ("validate", "--json", "--jsn")])
def test_an_error_before_a_command_is_known_is_json_if_asked_for(cosmos, arguments):
    cosmos("exec", "-i", "a.yaml", "true")

    _, out, _ = cosmos(*arguments)

    assert json.loads(out)["error"]["kind"] == "usage"


def test_a_user_without_a_home_is_told_to_name_one(cosmos, monkeypatch):
    def fail(uid):
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "COSMOS_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", fail)
    monkeypatch.setattr(runs, "list_runs", lambda root: cache_folder())  # as a run's start asks

    code, _, err = cosmos("runs")

    assert code == ExitCode.BAD_INPUT
    assert err == "error: no home folder is known of this user: set HOME to a folder of yours\n"


def test_init_says_that_a_folder_cannot_be_called_so(cosmos):
    code, _, err = cosmos("init", "rover", "-d", "x" * 300)

    assert code == ExitCode.BAD_INPUT
    assert err == f"error: {'x' * 300}/rover.yaml: cannot be written: File name too long\n"


def test_init_names_the_file_that_a_disk_does_not_take_and_leaves_no_half(tmp_path):
    own = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, own[1]))  # bytes; stands in for a full disk
    try:
        with pytest.raises(InputError) as refused:
            write_new({Path("a.py"): "x = 1\n", Path("a.yaml"): "x" * 100}, tmp_path / "new")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, own)

    expected = f"{tmp_path}/new/a.yaml: cannot be written: File too large"
    assert expected == str(refused.value)
    assert os.listdir(tmp_path / "new") == []


@pytest.mark.parametrize("name", ["Rover", "../x", "a b", "-x"])
def test_init_refuses_names_that_no_scenario_can_have(cosmos, name):
    code, _, _ = cosmos("init", "--", name)

    assert code == ExitCode.BAD_INPUT
    assert os.listdir() == ["a.yaml"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["vlidate"], "error: no command 'vlidate'; did you mean validate?\nsee `cosmos --help`\n"),
        (["validate"], "error: Missing argument 'FILE...'.\nsee `cosmos validate --help`\n"),
        (["validate", "--jsn"], "see `cosmos validate --help`\n"),
        (
            ["schema", "--check"],
            "error: scenarios/scenario.schema.json: no such file here; name the file to check",
        ),
        (["plan", "a.yaml", "--workers", "0"], "see `cosmos plan --help`\n"),
        (["plan", "a.yaml", "--bandwidth-mbit", "nan"], "expected a finite number, got nan"),
        (["plan", "a.yaml", "--latency-ms", "inf"], "'--latency-ms': expected a finite number"),
        (["exec", "-i", "x", "--timeout", "1e9", "true"], "range 0.1<=x<=1000000.0"),
        (["down", "7", "--timeout", "1e9"], "range 0.0<=x<=1000000.0"),
        (["reboot", "-i", "x", "--timeout", "1e9"], "range 1.0<=x<=1000000.0"),
    ],
)
def test_wrong_usage_ends_with_2_and_says_what_is_right(cosmos, arguments, text):
    code, out, err = cosmos(*arguments)

    assert (code, out) == (ExitCode.BAD_INPUT, "")
    assert text in err


def test_wrong_usage_is_json_too(cosmos):
    code, out, _ = cosmos("validate", "--json")

    assert code == 2
    assert json.loads(out)["error"]["kind"] == "usage"


def fail_with(monkeypatch, error):
    def broken(name):
        raise error

    monkeypatch.setattr(command_group, "load_command", broken)


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (RunFailedError("agent-01 is lost"), 1, "error: agent-01 is lost\n"),
        (PluginError("no such plug-in"), 2, "error: no such plug-in\n"),
        (MachineError("port 47000 is taken"), 3, "error: port 47000 is taken\n"),
    ],
)
def test_foreseen_errors_have_their_exit_codes(cosmos, monkeypatch, error, code, text):
    fail_with(monkeypatch, error)

    assert cosmos("validate", "a.yaml") == (code, "", text)


def test_unexpected_error_names_the_file_with_its_traceback(cosmos, monkeypatch):
    fail_with(monkeypatch, ZeroDivisionError("by nought"))

    code, _, err = cosmos("validate", "a.yaml")

    assert code == 1
    assert err.startswith("error: unexpected ZeroDivisionError: by nought\n")
    assert "Traceback" not in err
    saved = Path(err.strip().rpartition(" ")[2])
    assert "ZeroDivisionError: by nought" in saved.read_text()
    saved.unlink()


@pytest.mark.parametrize("option", ["--workers", "--maneuvers-at-once"])
def test_plan_refuses_counts_beyond_all_measure(cosmos, option):
    code, _, err = cosmos("plan", "a.yaml", option, "1" + "0" * 400)

    assert code == 2
    assert option in err
    assert "unexpected" not in err


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EROFS])
def test_unexpected_error_is_told_where_no_file_takes_its_traceback(cosmos, monkeypatch, error):
    def refuse(**_):
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr("tempfile.mkstemp", refuse)
    fail_with(monkeypatch, ZeroDivisionError("by nought"))
    code, _, err = cosmos("validate", "a.yaml")

    assert code == 1
    assert err.startswith("error: unexpected ZeroDivisionError: by nought\n")
    assert f"COSMOS_DEBUG=1 shows; it could not be kept in a file: {os.strerror(error)}" in err


def test_unexpected_error_shows_its_traceback_when_asked(cosmos, monkeypatch):
    fail_with(monkeypatch, ZeroDivisionError("by nought"))
    monkeypatch.setenv("COSMOS_DEBUG", "1")

    _, _, err = cosmos("validate", "a.yaml")

    assert err.startswith("Traceback")


def command(*arguments, **options):
    return subprocess.run(
        [sys.executable, "-m", "cosmos_cli.app", *arguments],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        **options,
    )


@pytest.mark.process
def test_real_process_validates_and_ends_with_its_code(tmp_path):
    (tmp_path / "a.yaml").write_text(SCENARIO)

    good = command("validate", "a.yaml", cwd=tmp_path)
    bad = command("validate", "a.yaml", "--set", "seed=-1", cwd=tmp_path)

    assert (good.returncode, good.stderr) == (0, "")
    assert (bad.returncode, bad.stderr) == (2, "--set seed: expected >= 0, got -1\n")


@pytest.mark.process
def test_closed_pipe_is_no_error_to_talk_about():
    reader, writer = os.pipe()
    os.close(reader)
    process = subprocess.run(
        [sys.executable, "-m", "cosmos_cli.app", "schema"],
        stdout=writer,
        stderr=subprocess.PIPE,
        timeout=60,
        check=False,
    )
    os.close(writer)

    assert process.stderr == b""
    # As README says, and as a shell tells of who is ended by SIGPIPE.
    assert process.returncode == 141


@pytest.mark.process
def test_validate_imports_only_what_it_needs(tmp_path):
    (tmp_path / "a.yaml").write_text(SCENARIO)
    code = (
        "import sys; from cosmos_cli import app; app.run(['validate', 'a.yaml']);"
        "print([m for m in ('numpy', 'scipy', 'rich', 'pyarrow', 'fabric', 'asyncio') if m in sys.modules])"
    )

    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )

    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.process
def test_validate_makes_the_validator_of_parameters_once(cosmos, monkeypatch, tmp_path):
    """Not once more for the scenario as its test changes it, nor in each process that answers for code of one's own."""
    made = tmp_path / "made"

    def counted(kind):
        with made.open("a") as file:
            file.write(f"{kind.__name__}\n")
        return TypeAdapter(kind)

    monkeypatch.setattr(parameters, "TypeAdapter", counted)
    parameters.adapter_of.cache_clear()

    code, _, err = cosmos("validate", ROOT / "scenarios/planet93.yaml")

    assert (code, err) == (0, "")
    assert made.read_text() == "ConstellationParameters\n"


def test_validate_reads_a_scenario_without_a_test_once(cosmos, monkeypatch):
    monkeypatch.setattr(scenario_outline, "read_scenario_source", None)

    assert cosmos("validate", "a.yaml")[0] == 0


def test_all_entries_of_a_timeline_have_one_validator(cosmos, monkeypatch):
    made = []
    monkeypatch.setattr(
        timeline, "TypeAdapter", lambda kind: made.append(kind) or TypeAdapter(kind)
    )
    entries = "".join(f"- {{at_s: {t_s}, action: annotate, text: x}}\n" for t_s in range(20))
    Path("b.yaml").write_text(f"{SCENARIO}timeline:\n{entries}")

    assert cosmos("validate", "b.yaml")[0] == 0
    assert len(made) <= 1


@pytest.mark.process
def test_no_garbage_is_looked_for_among_what_was_imported():
    code = (
        "import gc; gc.disable(); from cosmos_cli.commands.command_group import load_command;"
        "load_command('validate');"
        "print(gc.isenabled(), len(gc.get_objects()) < gc.get_freeze_count())"
    )

    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    assert result.stdout == "True True\n"


@pytest.mark.process
def test_a_run_begins_before_what_only_its_evidence_or_a_check_needs_is_imported():
    code = (
        "import sys; import cosmos_cli.commands.run;"
        "print([m for m in ('numpy', 'scipy', 'pyarrow', 'paramiko', 'packaging') if m in sys.modules])"
    )

    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )

    assert result.stdout == "[]\n"


@pytest.mark.process
def test_help_and_version():
    assert command("--version").stdout.startswith("cosmos 0.")
    assert "validate" in command("--help").stdout
    assert command("validate", "--help").returncode == 0


@pytest.mark.process
def test_help_imports_no_command(tmp_path):
    code = (
        "import sys; from cosmos_cli import app; app.run(['--help']);"
        "print([m for m in sys.modules if m.partition('.')[0] in ('pydantic', 'yaml', 'numpy')])"
    )

    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )

    assert result.stdout.splitlines()[-1] == "[]"


def test_commands_are_listed_with_their_own_help():
    commands = [(verb, command_group.load_command(verb)) for verb in command_group.COMMANDS]
    commands += command_group.each_command()
    told = {verb: command_group.command_outline(verb).help for verb, _ in commands}

    assert len(told) > 30
    assert told == {verb: command.help for verb, command in commands}


def test_interrupt_ends_with_130_and_no_traceback(cosmos, monkeypatch):
    fail_with(monkeypatch, KeyboardInterrupt())

    assert cosmos("validate", "a.yaml") == (ExitCode.INTERRUPTED, "", "interrupted\n")


@pytest.mark.process
def test_plugin_of_the_template_records_what_it_declares_and_shows_it(cosmos):
    cosmos("init", "rover", "--template", "plugin")
    settings = ("--set", "time.mode=lockstep", "--no-report", "--json", "--quiet")

    code, out, _ = cosmos("run", "rover.yaml", *settings)

    document = json.loads(out)
    assert code == 0
    assert [text for text in document["remarks"] if "declared" in text] == []
    own = document["columns"]["agent-01"]
    assert own["drive.measured_m"] == pytest.approx(5.0, abs=0.1)
