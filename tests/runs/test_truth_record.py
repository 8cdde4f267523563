"""The host's record of truth in whole runs: a killed board takes nothing with it, and a table tells all of it."""

import json
import os
import signal

import numpy as np
import orjson
import pyarrow.parquet as pq
import pytest
from harness.cosmos_command import LOOSE, CosmosCommand
from harness.waiting import wait_until

pytestmark = pytest.mark.process

PATIENCE_S = 120.0
LOCKSTEP = ("time.mode=lockstep", "on_agent_loss=abort")
SCENARIO = """
name: survive
simulation: constellation
agents: {count: 3, tick_hz: 10}
time: {mode: realtime, duration_s: 8, rtf_tolerance: 100}
deadline: {max_miss_ratio: 1, overrun_ms: 2000}
on_agent_loss: continue
recording: {flush_interval_s: 0.05}
parameters:
  satellites: {walker: "86.4:66/6/2", altitude_km: 780}
  segments: {buffer_s: 2}
  vehicles:
    - {thruster: {isp_s: 220, propellant_kg: 1, direction_error_deg: 1}}
  flight: {software: "burn.py:Burn", input: truth}
"""
FLIGHT = '''
from madns_runtime.simulations.constellation.flight.api import FlightSoftware


class Burn(FlightSoftware):
    """Burns at 6.3 s, commanded in its first tick."""

    def setup(self, context):
        self.context, self.is_new = context, True

    def step(self, t_s, readings):
        if self.is_new:
            self.is_new = False
            self.context.delta_v((0.0, 2.0, 0.0), at_s=6.3)
'''
COLUMNS = ["x_teme_m", "y_teme_m", "z_teme_m", "vx_teme_m_s", "vy_teme_m_s", "vz_teme_m_s"]


class Place(CosmosCommand):
    """A folder with the scenario, and the command."""

    def __init__(self, folder):
        super().__init__(folder)
        (folder / "survive.yaml").write_text(SCENARIO)
        (folder / "burn.py").write_text(FLIGHT)

    def cosmos(self, *arguments):
        done = self(*arguments)
        return done.returncode, done.stdout, done.stderr

    def begin(self, *settings):
        return self.start_run(self.folder / "survive.yaml", *settings)

    def table(self, document, rate_hz=10):
        done = self("tabulate", document["run"], "--rate-hz", rate_hz, "--quiet")
        assert done.returncode == 0, done.stdout + done.stderr
        return pq.read_table(self.directory(document) / "truth.parquet")


def rows(path):
    lines = map(orjson.loads, path.read_bytes().splitlines()) if path.exists() else ()
    return [line for line in lines if isinstance(line, list)]


def states(table, agent):
    mine = table.filter(np.array(table["agent"].to_pylist()) == agent)
    return np.array(mine["t_s"]), np.stack([np.array(mine[name]) for name in COLUMNS], axis=1)


@pytest.mark.timeout(300)
@pytest.mark.nightly
def test_a_killed_agent_takes_nothing_of_its_satellites_truth_with_it(tmp_path):
    place = Place(tmp_path)
    process = place.begin(*LOOSE)
    # Its burn is in truth: from now on the host needs it no more.
    wait_until(
        lambda: any(
            row[1] == "agent-02"
            for path in tmp_path.glob("runs/0001-survive/host/maneuvers.jsonl")
            for row in rows(path)
        ),
        "no burn of agent-02",
        process=process,
    )
    entries = [json.loads(p.read_text()) for p in tmp_path.glob("state/processes/[0-9]*.json")]
    os.kill(next(e["pid"] for e in entries if e["name"] == "agent-02"), signal.SIGKILL)
    out, err = process.communicate(timeout=PATIENCE_S)
    killed = json.loads(out)
    out, err = place.begin(*LOOSE).communicate(timeout=PATIENCE_S)
    control = json.loads(out)

    assert (killed["agents"]["lost"], control["agents"]["lost"]) == (["agent-02"], []), err
    kept = rows(place.directory(killed) / "agents/agent-02/state.jsonl")
    assert len(kept) < 70
    expected, found = place.table(control), place.table(killed)
    for agent in ("agent-01", "agent-02", "agent-03"):
        times_s, truth = states(found, agent)
        assert times_s.tolist() == [k / 10 for k in range(81)]
        # The same numbers, but for rounding where one run heard of the burn at another moment.
        assert np.abs(truth - states(expected, agent)[1]).max() < 1e-6
    # It was burnt: 2 m/s of what would have been flown.
    lost = states(found, "agent-02")[1]
    recorded = rows(place.directory(control) / "agents/agent-02/state.jsonl")
    own = np.array([lost[row[0]] - row[1:] for row in recorded])
    assert np.abs(own).max() < 6e-6  # recorded to 10 um


@pytest.mark.timeout(300)
def test_in_lockstep_the_record_repeats_to_the_byte_and_agents_flew_it(tmp_path):
    place = Place(tmp_path)
    documents = []
    for _ in range(2):
        out, err = place.begin(*LOCKSTEP).communicate(timeout=PATIENCE_S)
        documents.append(json.loads(out))
        assert documents[-1]["status"] == "complete", err

    first, second = (place.directory(d) / "host/truth.jsonl" for d in documents)
    assert first.read_bytes() == second.read_bytes()
    table = place.table(documents[0])
    for agent in ("agent-01", "agent-02", "agent-03"):
        _, truth = states(table, agent)
        flown = rows(place.directory(documents[0]) / f"agents/{agent}/state.jsonl")
        assert len(flown) == 80
        # Agents round what they record: half of 1e-5 m and of 1e-8 m/s.
        assert max(np.abs(truth[row[0]] - row[1:]).max() for row in flown) < 1e-5
    # A packed field is no column, and the run's own comparison judges it all the same.
    columns = pq.read_schema(place.directory(documents[0]) / "tables/host_truth.parquet").names
    assert {"agent", "t0_s", "knots"} <= set(columns)
    assert not {"states", "attitude"} & set(columns)
    code, out, err = place.cosmos("diff", "1", "2", "--expect-same")
    assert code == 0, out + err
    assert "IDENTICAL" in out
    code, out, err = place.cosmos("tabulate", "1", "--agents", "agent-9*")
    assert (code, "no agent of the run is called so" in err) == (2, True)
    code, out, err = place.cosmos("tabulate", "1", "--rate-hz", "1e9")
    assert (code, "take a lower rate" in err) == (2, True)


@pytest.mark.timeout(300)
def test_what_cannot_be_tabulated_is_told(tmp_path):
    place = Place(tmp_path)
    settings = (*LOCKSTEP, "time.duration_s=4")
    out, err = place.begin(*settings).communicate(timeout=PATIENCE_S)
    path = place.directory(json.loads(out)) / "host/truth.jsonl"
    whole = path.read_text()

    lines = whole.splitlines(keepends=True)
    gone = [n for n, line in enumerate(lines) if '"agent-03",0,1.0,' in line]
    path.write_text("".join(line for n, line in enumerate(lines) if n not in gone))
    code, out, err = place.cosmos("tabulate", "--rate-hz", "10", "--json")
    assert code == 5, out + err
    assert "agent-03: nothing is on record at 9 of 41 times" in err
    assert json.loads(out)["gaps"] == {"agent-03": 9}

    path.write_text(whole.replace('"agent-02",0,1.0,1.0,2,"', '"agent-02",0,1.0,1.0,2,"x'))
    code, out, err = place.cosmos("tabulate")
    assert code == 3, out + err
    assert "truth.jsonl: agent-02: no packed numbers" in err

    path.unlink()
    code, out, err = place.cosmos("tabulate")
    assert code == 2
    assert "truth.jsonl: this run recorded no truth, or its record was deleted" in err
    assert "Traceback" not in err
