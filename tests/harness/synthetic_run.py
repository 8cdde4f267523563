"""Run directories for tests, written through the real recorder from a seed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from cosmos_cli.evidence.completeness import ExpectedRecords
from cosmos_cli.evidence.run_directory import RunDirectory, begin_run, create_run, write_json
from madns_runtime.config import Agents, Recording, RunConfig, TimeSettings
from madns_runtime.processes import ProcessEntry
from madns_runtime.recording.record_files import RecordFiles
from madns_runtime.recording.recorder import Recorder
from madns_runtime.recording.records import (
    CLOCK,
    EVENTS,
    HEALTH,
    LOG,
    PROCESS,
    TICKS,
    Field,
    StreamSchema,
)

ROUND_TRIPS = StreamSchema(
    "round_trips",
    (Field("packet", "", "int"), Field("value", "", "int"), Field("round_trip_us", "us", "int")),
)
STATE = StreamSchema(
    "state",
    (
        Field("tick", "", "int"),
        *(Field(f"{axis}_m", "m") for axis in "xyz"),
        *(Field(f"v{axis}_m_s", "m/s") for axis in "xyz"),
    ),
)
T0_UTC = "2024-05-06T07:08:09.000Z"
MACHINE = "loopback"
RECORDING = Recording(buffer_bytes=256 * 1024 * 1024)
MU_M3_S2 = 3.986004418e14


def make_config(agents: int = 2, *, ticks: int = 200, tick_hz: float = 10.0, **more) -> RunConfig:
    return RunConfig(
        run="0001-synthetic",
        scenario="synthetic",
        simulation="counter",
        base_directory=".",
        agents=Agents(count=agents, tick_hz=tick_hz),
        time=TimeSettings(duration_s=ticks / tick_hz),
        seed=7,
        **more,
    )


class SyntheticRun:
    """A run whose agents have ticked; parts of it can then be damaged."""

    def __init__(self, root: Path, config: RunConfig | None = None) -> None:
        self.config = config or make_config()
        self.names = self.config.agents.resolved_names()
        self.ticks = round(self.config.time.duration_s * self.config.agents.tick_hz)
        self.run: RunDirectory = create_run(root, self.config.scenario)
        self.config = dataclasses.replace(self.config, run=self.run.name)
        self._begin()
        self.expected = ExpectedRecords.of(self.config, (MACHINE,))
        self.records: dict[str, dict] = {}

    def _begin(self) -> None:
        """Write what is known at the start, by the very clock that the synthetic host recorded."""
        begin_run(self.run, self.config, {"machines": {MACHINE: list(self.names)}})
        document = self.run.read_json(self.run.run_json)
        write_json(self.run.run_json, {**document, "started_utc": T0_UTC})

    def write(
        self,
        *,
        with_states: bool = False,
        health_count: int = 5,
        shutdown_s: float | None = None,
    ) -> SyntheticRun:
        if with_states:
            self.config = dataclasses.replace(self.config, simulation="constellation")
            self._begin()
        host = self.recorder("host", "host", EVENTS, LOG)
        host.record(
            "events", {"t_s": 0.0, "utc": T0_UTC, "event": "SIMULATION_START", "why": "all"}
        )
        if shutdown_s is not None:
            ended = {"t_s": shutdown_s, "utc": T0_UTC, "event": "state"}
            host.record("events", {**ended, "state": "EMERGENCY_SHUTDOWN"})
        self.records["host"] = host.close().to_mapping()
        for name in self.names:
            self.write_agent(name, with_states=with_states)
        self.write_health(health_count)
        self.write_health(health_count, folder="host", source="host")
        return self

    def recorder(self, folder: str, source: str, *schemas: StreamSchema) -> Recorder:
        files = RecordFiles(self.run.path / folder, run=self.run.name, source=source)
        recorder = Recorder(files, RECORDING)
        for schema in schemas:
            recorder.open_stream(schema)
        recorder.set_t0(T0_UTC)
        return recorder

    def write_agent(
        self, name: str, *, first: int = 0, last: int | None = None, with_states: bool = False
    ) -> None:
        random = np.random.default_rng(self.names.index(name) + 1)
        schemas = (TICKS, CLOCK, EVENTS, LOG, PROCESS, ROUND_TRIPS)
        recorder = self.recorder(
            f"agents/{name}", name, *schemas, *((STATE,) if with_states else ())
        )
        tick_hz = self.config.agents.tick_hz
        for tick in range(first, self.ticks if last is None else last):
            lateness_us = int(40 + random.exponential(25))
            recorder.record("ticks", (tick, lateness_us, int(1e6 / tick_hz) - lateness_us - 120, 0))
            round_trip_us = int(220 + random.gamma(2.0, 60.0))
            recorder.record("round_trips", (tick, 2 * tick, round_trip_us))
            if with_states:
                recorder.record("state", _orbit_state(tick, tick / tick_hz, self.names.index(name)))
            if tick % 10 == 0:
                wander_us = float(random.normal(0.0, 4.0))
                recorder.record("clock", (tick / tick_hz, 12.0 + wander_us, 0.3, 20.0, 180.0))
                recorder.record("process", (tick / tick_hz, 3.5, 15_000_000, 0, tick, 1))
        recorder.record("events", {"t_s": 0.0, "utc": T0_UTC, "event": "AGENT_SIMULATION_START"})
        self.records[name] = recorder.close().to_mapping()

    def write_health(
        self,
        count: int,
        temperature_c: float | None = None,
        *,
        folder: str = f"machines/{MACHINE}",
        source: str = MACHINE,
    ) -> None:
        recorder = self.recorder(folder, source, HEALTH)
        for index in range(count):
            values = dict.fromkeys((field.name for field in HEALTH.fields), None)
            values |= {
                "utc": f"2024-05-06T07:08:{10 + index:02d}.000Z",
                "monotonic_s": 1000.0 + 5 * index,
                "cpu_percent": 20.0 + index,
                "core_temperature_c": temperature_c,
                "ram_percent": 31.0,
                "load_1min": 0.4,
            }
            recorder.record("health", values)
        recorder.close()

    def result(self, **changes) -> dict:
        agents = {
            name: {
                "state": "complete",
                "reason": None,
                "incarnations": 1,
                "rtf": 1.00002,
                "ticks": {
                    "due": self.ticks,
                    "run": self.ticks,
                    "missed": 0,
                    "not_run": 0,
                    "overrun_warnings": 0,
                    "overrun_errors": 0,
                },
                "messages": {},
                "records": self.records.get(name, {}),
                "simulation": {
                    "service": "best",
                    "sent": self.ticks,
                    "lost": 0,
                    "duplicated": 0,
                    "out_of_order": 0,
                    "checks": [{"name": "counter.lost", "limit": 0, "got": 0, "passed": True}],
                },
            }
            for name in self.names
        }
        nothing_lost = {"sent": 9, "received": 9, "lost": 0, "deadlines_broken": 0}
        return {
            "status": "complete",
            "who": None,
            "reason": None,
            "t0_utc": T0_UTC,
            "duration_s": self.config.time.duration_s,
            "rtf": 1.00002,
            "agents": agents,
            "lost": [],
            "messages": {name: dict(nothing_lost) for name in ("best", "reliable", "sync")},
            "records": self.records.get("host", {}),
            "simulation": {},
            "scheduling": {"policy": "normal"},
        } | changes

    def stream(self, agent: str, stream: str) -> Path:
        return self.run.path / "agents" / agent / f"{stream}.jsonl"

    def cut(self, path: Path, keep_bytes: int) -> None:
        with path.open("r+b") as file:
            file.truncate(keep_bytes)

    def kill(self, agent: str, *, share: float = 0.5) -> None:
        """Leave every stream of an agent as kill -9 would: some lines, the last one cut."""
        for path in (self.run.path / "agents" / agent).glob("*.jsonl"):
            first_line = len(path.read_bytes().split(b"\n")[0]) + 1
            self.cut(path, max(first_line, int(path.stat().st_size * share)))

    def living_agent(self) -> ProcessEntry:
        """Return the register's entry of a process of it that still lives."""
        return ProcessEntry(
            run=self.run.name,
            role="agent",
            name="agent-02",
            pid=4242,
            start_ticks=1,
            boot_id="x",
            node="n",
            run_directory=str(self.run.path),
            utc="",
        )


def _orbit_state(tick: int, t_s: float, index: int) -> tuple[float, ...]:
    radius_m, inclination, node = 7.158e6, np.radians(86.4), np.radians(36.0 * index)
    rate = np.sqrt(MU_M3_S2 / radius_m**3)
    angle = rate * t_s + 0.6 * index
    in_plane = np.array(
        [np.cos(angle), np.sin(angle) * np.cos(inclination), np.sin(angle) * np.sin(inclination)]
    )
    speed = np.array(
        [-np.sin(angle), np.cos(angle) * np.cos(inclination), np.cos(angle) * np.sin(inclination)]
    )
    turn = np.array([[np.cos(node), -np.sin(node), 0], [np.sin(node), np.cos(node), 0], [0, 0, 1]])
    position, velocity = radius_m * turn @ in_plane, radius_m * rate * turn @ speed
    return (tick, *map(float, position), *map(float, velocity))
