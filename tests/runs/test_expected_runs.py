"""Runs that are judged by what their scenario expects, in both time modes, and those that end as soon as it is broken."""

import json

import pytest
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

SCENARIO = """\
name: expected
simulation: counter
agents: {count: 3, tick_hz: 20}
time: {duration_s: 4, mode: MODE}
on_agent_loss: abort
"""
STOPS = "{name: few, stream: round_trips, field: packet, below: 20, stop_when_broken: true}"
LASTING = "{name: more, stream: round_trips, statistic: count, above: 1}"
OF_HEALTH = "{name: room, stream: health, field: ram_percent, below: 100}"
OF_LOG = (
    "{name: calm, stream: log, field: level, event: critical, agents: [host, '*'], must: not_occur}"
)
OF_TICKS = "{name: prompt, stream: ticks, field: lateness_us, statistic: p99, below: 60, unit: s}"


@pytest.fixture
def run(tmp_path):
    """Run the scenario with checks; return the exit code and run.json."""
    cosmos = CosmosCommand(tmp_path)

    def run(mode, *checks, settings=LOOSE, options=("--no-report",), timeline=""):
        path = tmp_path / "expected.yaml"
        listed = "".join(f"  - {check}\n" for check in checks)
        text = SCENARIO.replace("MODE", mode) + (f"checks:\n{listed}" if checks else "") + timeline
        path.write_text(text, "utf-8")
        return cosmos.run(path, *settings, options=options)

    run.cosmos = cosmos
    return run


def of_name(document, name):
    (check,) = [check for check in document["checks"] if check["name"] == name]
    return check


def test_a_lockstep_run_ends_at_the_tick_that_breaks_it_and_repeats_to_the_bit(run):
    (code, first), (_, second) = run("lockstep", STOPS), run("lockstep", STOPS)

    check = of_name(first, "few")
    assert (code, first["status"], check["passed"], check["got"]) == (4, "broken", False, 20)
    assert first["data"]["complete"]
    assert first["verdict"].startswith("CHECK BROKEN: agent-01: expectation few is broken at t = 1")
    assert first["records_sha256"] == second["records_sha256"]
    events = (run.cosmos.directory(first) / "host" / "events.jsonl").read_text().splitlines()
    met = [json.loads(line) for line in events if '"condition_met"' in line]
    assert [each["agent"] for each in met] == ["agent-01", "agent-02", "agent-03"][: len(met)]
    assert {each["delay_s"] for each in met} == {0.0}


def test_a_count_that_ends_a_run_goes_on_when_its_agent_is_started_anew(run):
    few = "{name: few, stream: round_trips, statistic: count, agents: [agent-01], below: 40, stop_when_broken: true}"
    code, document = run(
        "lockstep",
        few,
        settings=("agents.restarts_max=1", "on_agent_loss=continue"),
        timeline="timeline: [{at_s: 1, action: restart, agents: [agent-01]}]\n",
    )

    assert (code, document["status"], of_name(document, "few")["got"]) == (4, "broken", 40)
    folder = run.cosmos.directory(document) / "agents" / "agent-01"
    assert (folder / "round_trips.2.jsonl").exists()


def test_a_run_in_real_time_ends_as_soon_as_the_host_has_heard(run):
    # Of one agent: what ends the run may come before others, which a busy machine keeps waiting, have recorded anything.
    stops = STOPS.replace("stream:", "agents: [agent-01], stream:")
    code, document = run("realtime", stops, settings=(*LOOSE, "time.duration_s=60"))

    check = of_name(document, "few")
    assert (code, document["status"], check["passed"]) == (4, "broken", False)
    assert 20 <= check["got"] < 60 * 20 / 2, "it did not go on to its end"
    assert document["data"]["complete"]


def test_records_are_the_same_with_checks_and_without(run):
    bare, judged = run("lockstep"), run("lockstep", LASTING)
    tapped = run("lockstep", STOPS.replace("below: 20", "below: 2000"))

    assert [code for code, _ in (bare, judged, tapped)] == [0, 0, 0]
    assert len({document["records_sha256"] for _, document in (bare, judged, tapped)}) == 1


def test_what_a_time_mode_does_not_record_is_not_judged_and_alone_no_pass(run):
    code, document = run("lockstep", LASTING, OF_TICKS)
    alone, other = run("lockstep", OF_TICKS)

    assert (code, document["checks_not_judged"][0]["name"]) == (0, "prompt")
    assert any(text.startswith("prompt: not judged") for text in document["remarks"])
    assert (alone, other["verdict"][:15]) == (5, "DATA INCOMPLETE")


def test_a_rate_is_of_the_time_that_a_run_which_was_stopped_had(run):
    rate = "{name: rate, stream: round_trips, statistic: rate, within: [19, 21]}"

    code, document = run("lockstep", rate, timeline="timeline: [{at_s: 2, action: stop}]\n")
    again = run.cosmos("judge", document["run"], "--json")

    assert (code, document["duration_s"]) == (0, 2.0)
    check = of_name(document, "rate")
    assert check["got"] == pytest.approx(20, abs=1)
    assert of_name(json.loads(again.stdout), "rate") == check


def test_what_was_to_be_looked_for_after_the_end_of_a_run_that_was_stopped_is_no_pass(run):
    calm = "{name: calm, event: emergency, must: not_occur, from_s: 3, agents: [host]}"

    code, document = run("lockstep", calm, timeline="timeline: [{at_s: 1, action: stop}]\n")

    assert code == 4
    assert of_name(document, "calm")["got"] is None
    assert "calm not measured" in document["verdict"]
    assert "(the run ended at 1 s, before its from_s)" in document["verdict"]


def test_a_rate_is_of_the_time_that_a_run_which_a_check_ended_had(run):
    few = "{name: few, stream: round_trips, statistic: count, below: 40, stop_when_broken: true}"
    rate = "{name: rate, stream: round_trips, statistic: rate, within: [19, 21]}"

    code, document = run("lockstep", few, rate, settings=("time.duration_s=10",))
    again = run.cosmos("judge", document["run"], "--json")

    assert (code, document["status"]) == (4, "broken")
    check = of_name(document, "rate")
    assert check["got"] == pytest.approx(40 / 2.05), "41 ticks at 20 Hz had begun"
    assert of_name(json.loads(again.stdout), "rate") == check


def test_a_finished_run_is_judged_by_expectations_it_did_not_have_and_again_after_collect(run):
    code, document = run("realtime", OF_TICKS, OF_HEALTH, OF_LOG, options=())
    cosmos, name = run.cosmos, document["run"]
    page = (cosmos.directory(document) / "report.html").read_text("utf-8")
    strict = cosmos.folder / "strict.yaml"
    text = SCENARIO.replace("MODE", "realtime")
    strict.write_text(
        f"{text}checks:\n  - {{name: none, event: state, agents: ['*'], must: not_occur}}\n"
    )
    foreign = cosmos.folder / "foreign.yaml"
    foreign.write_text(
        f"{text.replace('count: 3', 'count: 9')}checks:\n"
        "  - {name: ninth, event: state, agents: [agent-09]}\n"
    )

    again = cosmos("judge", name)
    other = cosmos("judge", name, "-s", strict, "--json")
    refused = cosmos("judge", name, "-s", foreign)
    collected = cosmos("collect", name, "--json")

    assert code == 0, document["verdict"]
    check = of_name(document, "prompt")
    assert (check["unit"], check["passed"], check["agents_broken"]) == ("s", True, 0)
    assert "p99 of ticks.lateness_us below 60 s" in page and "Expectations" in page
    assert (again.returncode, "PASSED: 3 checks hold" in again.stdout) == (0, True)
    assert (of_name(document, "room")["agent"], of_name(document, "room")["unit"]) == (
        "loopback",
        "%",
    )
    told = json.loads(other.stdout)
    assert (other.returncode, told["exit_code"], told["checks"][0]["agents_broken"]) == (4, 4, 3)
    assert refused.returncode == 2
    assert "foreign.yaml:7:" in refused.stderr and "no agent is named agent-09" in refused.stderr
    assert of_name(json.loads(collected.stdout), "prompt") == check


def test_a_run_whose_tables_are_cut_is_not_judged_by_what_is_left(run):
    _, document = run("lockstep", LASTING)
    tables = run.cosmos.directory(document) / "tables"
    (table,) = tables.glob("round_trips*")
    whole = table.read_bytes()
    table.write_bytes(whole[:-100])

    cut = run.cosmos("judge", document["run"])
    table.write_bytes(bytes(len(whole)))
    other = run.cosmos("judge", document["run"])
    table.unlink()
    gone = run.cosmos("judge", document["run"])
    run.cosmos("collect", document["run"])
    anew = run.cosmos("judge", document["run"])

    assert (cut.returncode, other.returncode, gone.returncode) == (2, 2, 2)
    for refused in (cut, other, gone):
        assert "not as it was collected; make it anew with: cosmos collect" in refused.stderr
    assert (anew.returncode, "PASSED" in anew.stdout) == (0, True)


def test_a_table_that_no_collection_made_is_not_judged(run):
    _, document = run("lockstep", LASTING)
    tables = run.cosmos.directory(document) / "tables"
    (table,) = tables.glob("round_trips*")
    (tables / "foreign.parquet").write_bytes(table.read_bytes())

    refused = run.cosmos("judge", document["run"])

    assert refused.returncode == 2
    assert "foreign.parquet: no collection made it" in refused.stderr


def test_a_run_whose_manifest_is_gone_is_not_judged(run):
    """A table that is gone, too, would be one without records: no event of it occurred, and its count is 0."""
    _, document = run("lockstep", LASTING)
    (run.cosmos.directory(document) / "manifest.json").unlink()

    refused = run.cosmos("judge", document["run"])

    assert refused.returncode == 2
    assert "manifest.json: missing; make it anew with: cosmos collect" in refused.stderr


def test_a_run_whose_plan_is_not_what_it_was_is_not_judged_by_it(run):
    """A limit that was changed, or a check that cannot be read any more, would pass for what the run had."""
    _, document = run("lockstep", LASTING, LASTING.replace("more", "again"))
    path = run.cosmos.directory(document) / "plan.json"
    whole = path.read_bytes()
    plan = json.loads(whole)
    plan["expectations"][1]["bounds"]["low"] = -1.0
    path.write_text(json.dumps(plan))
    changed = run.cosmos("judge", document["run"])
    plan["expectations"][1]["bounds"] = "above 1"
    path.write_text(json.dumps(plan))
    unread = run.cosmos("judge", document["run"])
    collected = run.cosmos("collect", document["run"])
    noted = run.cosmos("judge", document["run"])
    path.write_bytes(whole)
    run.cosmos("collect", document["run"])
    back = run.cosmos("judge", document["run"])

    assert (changed.returncode, unread.returncode, noted.returncode) == (2, 2, 2)
    assert "plan.json: changed since the run was collected" in changed.stderr
    assert "plan.json: cannot be used: expectations[1].bounds: expected" in unread.stderr
    assert (collected.returncode, "plan.json: changed since" in collected.stdout) == (5, True)
    assert (back.returncode, "PASSED: 2 checks hold" in back.stdout) == (0, True)


def test_a_run_without_checks_is_judged_by_none(run):
    _, document = run("lockstep")

    refused = run.cosmos("judge", document["run"])

    assert refused.returncode == 2
    assert "its scenario has no `checks:` (those of its simulation stand in" in refused.stderr
    assert "name a scenario that has: cosmos judge " in refused.stderr


DEVICES = """\
hardware:
  devices:
    - {name: imu, kind: synthetic, agents: [agent-02, agent-03], rate_hz: 5, parameters: PARAMETERS}
"""
PARAMETERS = "{channels: [{name: gyro, unit: rad/s, elements: [{shape: sine, amplitude: 2}, {}]}]}"
OF_DEVICES = (
    "{name: turns, stream: imu.gyro, field: gyro_1, statistic: max, above: 60, unit: deg/s}",
    "{name: slow, stream: imu.gyro, field: gyro_1, agents: [agent-03], below: 1}",
    "{name: samples, stream: imu.gyro, statistic: count, within: [20, 20]}",
    "{name: opened, stream: imu.events, event: opened}",
    "{name: after, agents: [agent-02], event: end, after: opened}",
)


def test_what_devices_measure_is_judged_by_their_full_names_and_judged_again(run, tmp_path):
    hardware = DEVICES.replace("PARAMETERS", PARAMETERS)
    path = tmp_path / "devices.yaml"
    listed = "".join(f"  - {check}\n" for check in OF_DEVICES)
    path.write_text(f"{SCENARIO.replace('MODE', 'lockstep')}{hardware}checks:\n{listed}")

    code, document = run.cosmos.run(path, options=())
    again = run.cosmos("judge", document["run"], "-s", path, "--json")

    assert code == 4
    of_expected = [check for check in document["checks"] if check.get("expected")]
    found = {check["name"]: (check["agent"], check["passed"]) for check in of_expected}
    assert found == {
        "turns": ("agent-02/imu", True),
        "slow": ("agent-03/imu", False),
        "samples": ("agent-02/imu", True),
        "opened": ("agent-02/imu", True),
        "after": ("agent-02", True),
    }
    assert of_name(document, "turns")["got"] == pytest.approx(114.6, abs=6.0)
    told = json.loads(again.stdout)["checks"]
    assert [(each["name"], each["got"]) for each in told] == [
        (each["name"], each["got"]) for each in of_expected
    ]
    page = (run.cosmos.directory(document) / "report.html").read_text("utf-8")
    assert "max of imu.gyro.gyro_1 above 60 deg/s" in page
