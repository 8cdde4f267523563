"""`cosmos bench` as a person meets it: short runs on loopback, counts and no speeds."""

import json
import signal
import sys

import psutil
import pytest
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.waiting import wait_until

from cosmos_cli.app import run as cosmos
from cosmos_cli.bench import floor
from cosmos_cli.commands import bench_floor
from cosmos_cli.doctor.probe import Responder
from cosmos_cli.fleet.connection import Connection
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.local import LocalConnection
from cosmos_cli.fleet.target import Target

pytestmark = pytest.mark.process


@pytest.fixture
def command(tmp_path):
    return CosmosCommand(tmp_path)


@pytest.fixture
def inventory(tmp_path, monkeypatch):
    def connect(target, options) -> Connection:
        if target.name == "pi02":
            raise MachineFailure(FailureKind.UNREACHABLE, "no route to pi02", "switch it on")
        return LocalConnection(target)

    monkeypatch.setattr("cosmos_cli.fleet.fleet.connect", connect)
    monkeypatch.setenv("COSMOS_STATE_DIR", str(tmp_path / "state"))
    path = tmp_path / "inventory.yaml"
    path.write_text('all: {hosts: {"pi[01:02]": {}, here: {ansible_connection: local}}}\n')
    return path


def settings(*more):
    return [part for each in (*LOOSE, *more) for part in ("--set", each)]


def patient():
    """Return the same without the budget, which is an option of its own."""
    return [part for each in LOOSE[1:] for part in ("--set", each)]


def test_floor_of_this_computer_tells_all_measurements(capsys):
    code = cosmos(["bench", "floor", "--seconds", "1", "--json", "--quiet"])

    told = json.loads(capsys.readouterr().out)
    (here,) = told["machines"]
    found = [(each["way"], each["rate_hz"], each["policy"]) for each in here["floor"]]
    assert code == told["exit_code"] == 0
    assert found == [
        ("loopback", 100.0, "normal"),
        ("loopback", 100.0, "fifo"),
        ("loopback", 1000.0, "normal"),
        ("loopback", 1000.0, "fifo"),
    ]
    for each in here["floor"]:
        assert each["error"] is None
        if each["refusal"] is not None:  # it is permitted to nobody here: nothing was measured
            assert (each["policy"], each["due"], each["lateness_us"]) == ("fifo", 0, None)
            continue
        assert each["due"] == each["rate_hz"]
        assert each["sent"] + each["missed"] == each["due"]
        assert 1 <= each["answered"] <= each["sent"]
        for figures in (each["lateness_us"], each["round_trip_us"]):
            assert 0 <= figures["p50"] <= figures["p99"] <= figures["p999"] <= figures["max"]


def test_floor_of_machines_goes_over_the_network_too_and_ends_with_3_for_a_lost_one(
    inventory, capsys
):
    arguments = ["bench", "floor", "-i", str(inventory), "--seconds", "0.5"]
    code = cosmos([*arguments, "--json", "--quiet"])

    machines = {each["machine"]: each for each in json.loads(capsys.readouterr().out)["machines"]}
    network = [each for each in machines["pi01"]["floor"] if each["way"] == "network"]
    assert code == 3
    assert list(machines) == ["this computer", "pi01", "pi02"]
    assert [each["policy"] for each in network] == ["normal", "fifo"]
    assert network[0]["answered"] >= 1
    assert machines["pi02"]["failure"]["kind"] == "unreachable"


def test_refused_fifo_is_told_in_the_table():

    told = {"refusal": "Operation not permitted", "error": None, "is_preempt_rt": True}
    told |= {"lateness_us": None, "round_trip_us": None, "missed": 0, "sent": 0, "answered": 0}
    (row,) = floor.rows_of(
        "pi01", [{"way": "loopback", "rate_hz": 100.0, "policy": "fifo", **told}]
    )

    assert len(row) == len(floor.COLUMNS)
    assert row[:5] == (
        "pi01",
        "PREEMPT_RT",
        "loopback",
        "100",
        "SCHED_FIFO: Operation not permitted",
    )


@pytest.mark.parametrize(
    ("is_preempt_rt", "kernel"), [(True, "PREEMPT_RT"), (False, "ordinary"), (None, "")]
)
def test_floor_says_what_kernel_it_was_measured_on(is_preempt_rt, kernel):
    told = {"refusal": None, "error": None, "is_preempt_rt": is_preempt_rt, "missed": 0}
    told |= {"lateness_us": None, "round_trip_us": None, "sent": 0, "answered": 0}
    (row,) = floor.rows_of("pi01", [{"way": "loopback", "rate_hz": 1e3, "policy": "fifo", **told}])

    assert row[1] == kernel


def test_floor_leaves_out_the_network_of_a_machine_whose_way_here_is_not_known(monkeypatch):
    monkeypatch.setattr(LocalConnection, "own_address", "")  # as through a ProxyCommand
    target = Target(name="pi01", address="pi01", connection="local", python=sys.executable)
    said = []
    with Responder() as responder:
        told = floor.measure_floor(
            LocalConnection(target), 0.02, responder=responder, say=said.append
        )

    network = [each for each in told if each["way"] == "network"]
    assert [each["sent"] for each in network] == [0, 0]
    assert all("cosmos_host_address" in each["error"] for each in network)
    assert len([text for text in said if "not measured: through a ProxyCommand" in text]) == 2
    rows = list(floor.rows_of("pi01", told))
    assert len(rows) == 6
    assert "through a ProxyCommand" in rows[-1][4]


def test_measurement_that_could_not_be_made_is_counted_and_ends_with_3(monkeypatch, capsys):
    made = {"refusal": None, "is_preempt_rt": False, "lateness_us": None, "round_trip_us": None}
    made |= {"way": "loopback", "rate_hz": 100.0, "missed": 0, "sent": 0, "answered": 0}
    told = [
        {**made, "policy": "normal", "error": "not done in 5 s"},
        {**made, "policy": "fifo", "error": None, "refusal": "Operation not permitted"},
    ]
    monkeypatch.setattr(bench_floor, "measure_floor", lambda *_, **more: told)

    code = cosmos(["bench", "floor", "--seconds", "0.5"])

    assert code == 3
    out = capsys.readouterr().out
    assert "1 machine measured, 1 measurement not made, SCHED_FIFO refused on 1 in" in out


OF_A_MOMENT = ("vars.trip_ms_max=60000", "vars.sd_ms_max=60000", "vars.trips_hz_min=0")
"""What a second of round trips comes to says nothing on a busy machine."""


@pytest.mark.nightly
def test_suite_runs_shortest_first_and_tells_round_trips_of_both_ends(command):
    files = [SCENARIOS / "thesis" / f"benchmark_{name}.yaml" for name in ("6min", "3min")]
    done = command(
        *("bench", "suite", *files, "--minutes", "0.02", *settings("agents.count=2", *OF_A_MOMENT)),
        *("--set", "recording.flush_interval_s=0.1", "--json", "--quiet"),
    )

    told = json.loads(done.stdout)
    assert (done.returncode, told["exit_code"]) == (0, 0), done.stderr
    assert sorted(p.name for p in command.runs.iterdir() if p.is_dir()) == [
        each["run"] for each in told["runs"]
    ]
    for each in told["runs"]:
        rows = {(row["seen_by"], row["agent"]): row for row in each["round_trips_ms"]}
        names = ("agent-01", "agent-02", "all")
        assert set(rows) == {(who, name) for who in ("agent", "host") for name in names}
        counts = each["agents"]["agent-01"]
        assert counts["ticks"] + counts["missed"] == 24
        assert counts["sent"] == counts["ticks"]
        assert rows["agent", "all"]["count"] <= 48
        assert rows["agent", "all"]["min"] <= rows["agent", "all"]["p50"]


def test_suite_prints_a_table_per_run_and_one_of_all(command):
    file = SCENARIOS / "thesis" / "benchmark_at_once.yaml"
    chosen = settings("agents.count=1", "parameters.host_round_trips=false", *OF_A_MOMENT)
    done = command("bench", "suite", file, file, "--minutes", "0.02", *chosen)

    lines = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert len([line for line in lines if line.startswith("agent    all")]) == 2
    assert len([line for line in lines if line.endswith("complete")]) == 2
    assert lines[-1].startswith("2 of 2 runs passed in ")


def test_suite_in_lockstep_leaves_ticks_that_nobody_records_empty(command):
    file = SCENARIOS / "thesis" / "benchmark_at_once.yaml"
    chosen = settings("agents.count=2", "time.mode=lockstep", *OF_A_MOMENT)
    done = command("bench", "suite", file, "--minutes", "0.02", *chosen)

    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("agent    all")]
    assert line.split()[-2:] == ["48", "0"]  # sent and lost are the last that are told


def test_folder_without_a_suite_and_a_faulty_file_are_bad_input(tmp_path, capsys):
    assert cosmos(["bench", "suite", str(tmp_path)]) == 2
    assert "expected benchmark_*.yaml there, found none" in capsys.readouterr().err

    assert cosmos(["bench", "suite", str(SCENARIOS / "none.yaml")]) == 2
    assert cosmos(["bench", "capacity", "--first", "9", "--largest", "8"]) == 2
    assert "--first 9 is more than --largest 8" in capsys.readouterr().err


def test_trials_shorter_than_a_tick_are_told_by_the_commands_own_options(capsys):
    assert cosmos(["bench", "capacity", "--hz", "0.1", "--seconds", "1"]) == 2

    told = "error: --seconds 1 is less than one tick at --hz 0.1: give at least --seconds 10"
    assert capsys.readouterr().err.strip() == told

    assert cosmos(["bench", "capacity", "--set", "agents.count=3"]) == 2
    assert "trials set that themselves" in capsys.readouterr().err


def test_capacity_is_not_sought_in_lockstep_where_no_tick_is_ever_missed(tmp_path, capsys):
    file = tmp_path / "waits.yaml"
    file.write_text(
        "{name: waits, simulation: counter, agents: {count: 1, tick_hz: 20},"
        " time: {mode: lockstep, duration_s: 1}}"
    )

    for words in ([str(file)], ["--set", "time.mode=lockstep"]):
        assert cosmos(["bench", "capacity", *words, "--largest", "8", "--seconds", "1"]) == 2
        told = capsys.readouterr()
        assert "in lockstep no tick is ever missed" in told.err
        assert "--set time.mode=realtime" in told.err


def test_capacity_tries_runs_and_sets_the_plan_beside(command):
    done = command(
        *("bench", "capacity", "--hz", "20", "--max-miss-ratio", "1", "--seconds", "1"),
        *("--first", "1", "--largest", "2", "--per-process", "2", *patient(), "--json"),
    )

    told = json.loads(done.stdout)
    assert done.returncode == told["exit_code"] == 0, done.stderr
    assert [(trial["agents"], trial["holds"]) for trial in told["trials"]] == [(1, True), (2, True)]
    assert (told["agents"], told["broken_at"]) == (2, None)
    assert told["predicted"]["agents"] is None or told["predicted"]["agents"] > 0
    assert {trial["run"] for trial in told["trials"]} <= {p.name for p in command.runs.iterdir()}
    assert "trial 2: 2 agents at 20 Hz for 1 s" in done.stderr


@pytest.mark.nightly
def test_interrupted_capacity_leaves_its_table_and_nothing_running(command):
    done = command.start(
        *("bench", "capacity", "--hz", "20", "--max-miss-ratio", "1", "--seconds", "1"),
        *("--first", "1", *patient(), "--minutes", "9"),
    )
    wait_until(
        lambda: len(list(command.runs.glob("*/run.json"))) > 1, "a second trial", process=done
    )
    done.send_signal(signal.SIGINT)
    out, err = done.communicate(timeout=120)

    assert done.returncode == 130, err
    assert "stopped: interrupted" in out.splitlines()[-1]
    assert "kept" in out
    assert not alive_with(str(command.runs))


def alive_with(word):
    """Return the commands of living processes that name a word."""
    commands = [each.info["cmdline"] or [] for each in psutil.process_iter(["cmdline"])]
    return [command for command in commands if any(word in part for part in command)]
