"""Accounts of devices: what they are joined to, and how they are judged."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from cosmos_cli.collect.machine_sources import RecordingMachines
from cosmos_cli.evidence.devices import (
    LOSSES_TOLD_MAX,
    NO_REPORT,
    device_checks,
    device_loss_remarks,
    read_devices,
    refusal_remarks,
    silent_input_remarks,
    spoiled_data_remarks,
    stale_sample_remarks,
)
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.streams import find_streams
from madns_runtime.config import HardwareSettings

PLAN = {"devices": {"pi22": ["pi22/imu", "pi22/gps"]}}
SOUND = {
    "status": "ok",
    "samples": 100,
    "errors": 0,
    "stale_ratio": 0.0,
    "lost": 0,
    "restarts": 0,
    "why": "",
    "report": {"frozen": {"gyro": 0}, "dropped": 3, "refused": 1, "samples": 7},
}


def write(folder: Path, name: str, **devices: Any) -> None:
    there = folder / "machines" / "pi22"
    there.mkdir(parents=True, exist_ok=True)
    told = {key.replace("_", "/"): value for key, value in devices.items()}
    (there / name).write_text(json.dumps(told))


def judged(devices: Any) -> dict[str, tuple[float | None, bool, str | None]]:
    return {c.name: (c.got, c.passed, c.worst) for c in device_checks(devices, HardwareSettings())}


def test_accounts_of_sound_devices_hold_every_check(tmp_path: Path) -> None:
    write(tmp_path, "devices.json", pi22_imu=SOUND, pi22_gps=SOUND)

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    assert set(devices) == {"pi22/imu", "pi22/gps"}
    assert devices["pi22/imu"]["samples"] == 100
    assert devices["pi22/imu"]["counts"] == {"dropped": 3, "refused": 1}
    assert all(passed and worst is None for _, passed, worst in judged(devices).values())


@pytest.mark.parametrize(
    ("key", "value", "check", "got"),
    [
        ("stale_ratio", 0.5, "hardware.stale_ratio", 0.5),
        ("lost", 2, "hardware.lost", 2),
        ("report", {"frozen": {"gyro": 1}}, "hardware.frozen", 1),
        ("report", None, "hardware.frozen", None),
        ("stale_ratio", None, "hardware.stale_ratio", None),
        ("lost", "\x1b[2J", "hardware.lost", None),
    ],
)
def test_a_check_that_a_device_breaks_bears_its_name(
    tmp_path: Path, key: str, value: object, check: str, got: float | None
) -> None:
    write(tmp_path, "devices.json", pi22_imu={**SOUND, key: value}, pi22_gps=SOUND)

    found = judged(read_devices(RunDirectory(tmp_path), PLAN, None))

    assert found.pop(check) == (got, False, "pi22/imu")
    assert all(passed for _, passed, _ in found.values())


def test_bytes_that_a_line_lost_are_judged_where_there_were_any(tmp_path: Path) -> None:
    flooded = {**SOUND, "report": {**SOUND["report"], "lost_bytes": 700}}
    write(tmp_path, "devices.json", pi22_imu=flooded, pi22_gps=SOUND)

    found = judged(read_devices(RunDirectory(tmp_path), PLAN, None))

    assert found.pop("hardware.lost_bytes") == (700, False, "pi22/imu")
    assert all(passed for _, passed, _ in found.values())


@pytest.mark.parametrize("content", [None, "[]", "{", '{"pi22/gps": 3}'])
def test_a_device_without_an_account_is_not_taken_for_sound(
    tmp_path: Path, content: str | None
) -> None:
    (tmp_path / "machines" / "pi22").mkdir(parents=True)
    if content is not None:
        (tmp_path / "machines" / "pi22" / "devices.json").write_text(content)

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    assert devices["pi22/imu"]["status"] == NO_REPORT
    assert not any(passed for _, passed, _ in judged(devices).values())


def test_a_incarnation_of_a_supervisor_without_account_is_a_loss(tmp_path: Path) -> None:
    write(tmp_path, "devices.2.json", pi22_imu=SOUND, pi22_gps=SOUND)

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    assert judged(devices)["hardware.lost"] == (2, False, "pi22/gps")


def test_in_lockstep_the_host_tells_of_the_agents_devices() -> None:
    told = {"status": "ok", "stale_ratio": 0.0, "lost": 0, "restarts": 0, "frozen": {}}
    result = {"agents": {"agent-01": {"records": {"devices": {"gps": {**told, "samples": 5}}}}}}
    plan = {"devices": {"loopback": ["agent-01/gps"]}}

    devices = read_devices(RunDirectory(Path("/nowhere")), plan, result)

    assert devices["agent-01/gps"]["samples"] == 5
    assert devices["agent-01/gps"]["lost"] == 0


def test_a_run_without_devices_has_no_checks_of_them() -> None:
    assert device_checks({}, HardwareSettings()) == []


def test_records_of_devices_are_found_by_their_full_name_and_never_through_links(
    tmp_path: Path,
) -> None:
    there = tmp_path / "devices" / "pi22" / "imu"
    there.mkdir(parents=True)
    (there / "gyro.jsonl").write_text("")
    (tmp_path / "devices" / "linked").symlink_to(tmp_path / "devices" / "pi22")

    (file,) = find_streams(tmp_path)

    assert (file.role, file.source, file.stream) == ("device", "pi22/imu", "gyro")
    assert file.table == "device_imu.gyro"
    assert file.label == "pi22/imu/gyro"


def test_records_of_devices_are_of_their_machine_or_of_their_agents() -> None:
    sources = RecordingMachines(machine_of_agent={"agent-07": "pi23"})

    assert sources.owner_of("devices/pi22/imu/gyro.jsonl") == "pi22"
    assert sources.owner_of("devices/agent-07/gps/fix.jsonl") == "pi23"


def test_records_of_a_machines_device_are_its_own_though_an_agent_elsewhere_is_called_alike(
    tmp_path: Path,
) -> None:
    run = RunDirectory(tmp_path)
    machines = {"pi01": {"agents": ["pi02"]}, "pi02": {"agents": ["pi01"]}}
    devices = {"pi01": ["pi01/imu", "pi02/gps"], "pi02": []}
    run.plan_json.write_text(json.dumps({"machines": machines, "devices": devices}))

    sources = RecordingMachines.read(run)

    assert sources.owner_of("devices/pi01/imu/gyro.jsonl") == "pi01"
    assert sources.owner_of("devices/pi02/gps/fix.jsonl") == "pi01"
    assert sources.owner_of("devices/pi02/other/fix.jsonl") == "pi01"


PLAYED = {
    "points": 100,
    "played": 90,
    "late": 3,
    "skipped": 4,
    "lost": 6,
    "refused": 0,
    "underruns": 2,
    "lateness_us": {"p50": 80, "p99": 900, "max": 12_000},
}


def test_a_stimulus_is_judged_by_its_worst_output_over_all_incarnations(tmp_path: Path) -> None:
    stimulus = {"coil": PLAYED, "line": {**PLAYED, "late": 0, "skipped": 0, "lost": 0}}
    first = {**SOUND, "report": {**SOUND["report"], "stimulus": stimulus}}
    slower = {**PLAYED, "underruns": 0, "lateness_us": {"p50": 90, "p99": "\x1b", "max": 7}}
    second = {**SOUND, "report": {**SOUND["report"], "stimulus": {"coil": slower}}}
    write(tmp_path, "devices.json", pi22_imu=first, pi22_gps=SOUND)
    write(tmp_path, "devices.2.json", pi22_imu=second, pi22_gps=SOUND)

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    told = devices["pi22/imu"]["stimulus"]["coil"]
    assert (told["points"], told["played"], told["underruns"]) == (200, 180, 2)
    assert told["lateness_us"] == {"p50": 90, "p99": 900, "max": 12_000}
    assert "stimulus" not in devices["pi22/gps"]
    found = judged(devices)
    assert found["hardware.stimulus_late"] == (26 / 200, False, "pi22/imu.coil")
    assert found["hardware.stimulus_underruns"] == (4, False, "pi22/imu.coil")


def test_without_a_stimulus_there_is_no_check_of_one(tmp_path: Path) -> None:
    write(tmp_path, "devices.json", pi22_imu=SOUND, pi22_gps=SOUND)

    assert not [
        name
        for name in judged(read_devices(RunDirectory(tmp_path), PLAN, None))
        if "stimulus" in name
    ]


def test_what_found_no_room_between_devices_and_agents_is_remarked_once() -> None:
    agents = {
        "agent-01": {"records": {"device_losses": {"pi22/imu": {"frames_missed": 7}}}},
        "agent-02": {"records": {"device_losses": {"line": {"frames_dropped": 3}}}},
        "agent-03": {"records": "?"},
    }
    devices = {
        "pi22/imu": {"counts": {"frames_missed": 7}},
        "agent-02/line": {"counts": {"frames_missed": 2}},
        "pi22/gps": {"counts": {"frames_missed": 5, "writes_lost": 1}},
        "pi22/can": {"counts": {"writes_lost": 1}},
    }

    assert device_loss_remarks(agents, devices) == (
        "agent-01: device pi22/imu: there was no room for all: frames_missed 7",
        "agent-02: device line: there was no room for all: frames_dropped 3",
        "device pi22/gps: agents did not take all in time: frames_missed 5",
    )


def test_an_input_that_gave_nothing_in_any_incarnation_is_remarked_where_its_device_gave_samples(
    tmp_path: Path,
) -> None:
    first = {**SOUND, "silent_inputs": ["field", "gyro"]}
    second = {**SOUND, "silent_inputs": ["field"]}
    dead = {**SOUND, "samples": 0, "silent_inputs": ["position"]}
    dead["report"] = {**SOUND["report"], "samples": 0}
    write(tmp_path, "devices.json", pi22_imu=first, pi22_gps=dead)
    write(tmp_path, "devices.2.json", pi22_imu=second, pi22_gps=dead)

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    assert silent_input_remarks(devices) == ("device pi22/imu: no value ever came of field",)
    assert devices["pi22/imu"]["silent_inputs"] == ["field"]
    assert silent_input_remarks({f"pi{n}/a": {"silent_inputs": ["x"]} for n in range(25)})[-1] == (
        "5 more devices with an input of which no value ever came"
    )


def test_a_device_of_which_each_sample_was_stale_as_it_came_is_remarked(tmp_path: Path) -> None:
    old, older = {**SOUND, "least_stale_age_s": 59.0}, {**SOUND, "least_stale_age_s": 99.0}
    write(tmp_path, "devices.json", pi22_imu=older, pi22_gps=old)
    write(tmp_path, "devices.2.json", pi22_imu=old, pi22_gps={**SOUND, "least_stale_age_s": None})

    devices = read_devices(RunDirectory(tmp_path), PLAN, None)

    (told,) = stale_sample_remarks(devices)
    assert told.startswith("device pi22/imu: ")
    assert told.endswith(
        "came, the youngest 59 s old when it came: is taken_s time.monotonic() at the read?"
    )


def test_what_devices_refused_is_told_by_device_and_bounded() -> None:
    refused = {f"pi{n}/a": {"counts": {"refused": n}} for n in range(25)}

    first, *_, last = refusal_remarks(refused)

    assert first == "device pi1/a: 1 time something was refused; its events.jsonl says what and why"
    assert last == "4 more devices that refused something"
    assert refusal_remarks({"pi1/a": {"counts": {}}, "pi2/a": {}}) == ()


def test_what_is_lost_spoiled_or_beyond_its_limits_is_told_by_device_and_bounded() -> None:
    bad = {"garbage_bytes": 17353, "received_bytes": 18703, "bad_checksums": 67, "samples": 23}
    line = {"garbage_bytes": 40, "received_bytes": 4000, "bad_checksums": 0}  # opened in mid-frame
    imu = {"rate_beyond_limits": 77}

    told = {name: {"counts": c} for name, c in {"pi/a": bad, "pi/b": line, "pi/c": imu}.items()}
    told["pi/d"] = {}

    assert spoiled_data_remarks(told) == (
        "device pi/a: lost, spoiled or beyond limits: bad_checksums 67, garbage_bytes 17353 of 18703",
        "device pi/c: lost, spoiled or beyond limits: rate_beyond_limits 77",
    )
    *_, last = spoiled_data_remarks({f"pi/{n}": {"counts": imu} for n in range(25)})
    assert last == "5 more devices with something lost, spoiled or beyond limits"


def test_remarks_on_losses_are_bounded() -> None:
    lost = {"device_losses": {"line": {"writes_lost": 1}}}
    remarks = device_loss_remarks({f"agent-{n}": {"records": lost} for n in range(50)}, {})

    assert len(remarks) == LOSSES_TOLD_MAX + 1
    assert remarks[-1] == "30 more losses between devices and agents"
