"""Firmware in an emulator that floods its line or faults: named, no tick lost, its vehicle safe, the others untouched."""

import copy
import json
import math
import shutil
from pathlib import Path

import pytest
import yaml
from harness.cosmos_command import LOOSE, SCENARIOS, CosmosCommand
from harness.firmware import FOLDER, build_firmware, needs_emulator

pytestmark = [pytest.mark.process, needs_emulator]
TROUBLE = Path(__file__).parents[1] / "hardware" / "firmware" / "trouble.c"
TROUBLED, SOUND = "agent-01", ("agent-02", "agent-03")
HZ = 10
DURATION_S = 14
BEGINS_S, FLOOD_S = 4, 4
BYTES_S = 8_192
"""Of the line: `line_bytes_s` of emulated_mcu. An emulator that waits for a processor writes more than that, too."""
ANSWER_BYTES_MAX = 400
ANSWERS_LATE = "constellation.flight_answers_late"
"""Broken by a flight computer that falls silent for a time; that of a sound one has a minute."""
BUSY = {
    *("constellation.maneuver_deadlines_broken", "messages.sync.deadlines_broken"),
    *("hardware.stale_ratio", "hardware.stimulus_underruns"),
}
"""Also broken where a command, or an emulator, waits for a processor: on a busy machine by any vehicle."""


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    folder = tmp_path_factory.mktemp("firmware")
    build_firmware(folder, "trouble", TROUBLE, FOLDER / "control.c")
    return build_firmware(folder).parent


@pytest.fixture
def fly(tmp_path, images):
    """Fly three vehicles with firmware, of which the first is in trouble, and return the run's folder and run.json."""
    shutil.copytree(SCENARIOS / "flight", tmp_path / "flight")
    shutil.copytree(images, tmp_path / "firmware")
    cosmos = CosmosCommand(tmp_path)

    def run(**trouble):
        path = tmp_path / "trouble.yaml"
        path.write_text(yaml.safe_dump(scenario(trouble)))
        code, document = cosmos.run(path, *LOOSE, "hardware.stimulus_late=1")
        return code, cosmos.directory(document), document

    return run


def scenario(trouble):
    """Return the detumbling scenario with three vehicles, the first with the firmware that is in trouble."""
    told = yaml.safe_load((SCENARIOS / "hwil_detumble.yaml").read_text())
    told["agents"]["count"] = 3
    told["time"]["duration_s"] = DURATION_S
    told["parameters"]["satellites"]["walker"] = "86.4:3/3/0"
    told["parameters"]["vehicles"] = told["parameters"]["vehicles"][:1]
    told["parameters"]["maneuvers"] = {"late": "refuse"}
    (device,) = told["hardware"]["devices"]
    sound = told["parameters"]["flight"][0]
    troubled = copy.deepcopy(sound)
    troubled["settings"] |= trouble
    sound |= {"agents": list(SOUND), "answer_s": 60}
    troubled["agents"] = [TROUBLED]
    told["parameters"]["flight"] = [troubled, sound]
    told["hardware"]["devices"] = [
        {
            **device,
            "agents": agents,
            "rate_hz": 1,  # lost after 10 s without a sample: a busy machine keeps an emulator waiting
            "parameters": {"firmware": f"firmware/{name}.elf", "line_bytes_s": BYTES_S},
        }
        for agents, name in (([TROUBLED], "trouble"), (list(SOUND), "detumble"))
    ]
    return told


def records(folder, stream, agent=TROUBLED, below="agents"):
    lines = (folder / below / agent / f"{stream}.jsonl").read_text().splitlines()
    return [row for row in map(json.loads, lines) if isinstance(row, list)]


def flight_of(document, agent=TROUBLED):
    return document["simulation"]["agents"][agent]["flight"]


def broken(document):
    return {check["name"]: check["worst"] for check in document["checks"] if not check["passed"]}


def assert_nobody_else_noticed(folder, document):
    """Check that no tick is missing, and that the others' computers answered all."""
    assert document["status"] == "complete"
    assert document["agents"]["lost"] == []
    # Missed ones, as on a busy machine, among them.
    assert document["timing"]["ticks"] == 3 * DURATION_S * HZ
    assert document["records"]["dropped"] == 0
    for agent in SOUND:
        flight = flight_of(document, agent)
        assert (flight["answers"], flight["unanswered"]) == (flight["ticks_sent"], 0)
        # Of a tick that a busy machine let the agent miss, its computer hears nothing.
        assert flight["ticks_sent"] >= DURATION_S * HZ - document["timing"]["missed"]
        assert set(flight["interface"]["faults"].values()) == {0}
        device = document["devices"][f"{agent}/mcu"]
        assert (device["errors"], device["restarts"]) == (0, 0)


def commanded_s(folder):
    """Return from when until when each of the vehicle's commands really acts, s."""
    rows = [row for row in records(folder, "maneuvers", "", "host") if row[1] == TROUBLED]
    durations_s = {row[1]: row[-1] for row in records(folder, "commands")}
    return [(row[7], row[7] + durations_s[row[2]]) for row in rows if row[7] is not None]


def assert_coasts(folder, from_s, until_s):
    """Check that no command is in force in between: all have ended, and none of a time that has passed is taken."""
    assert [span for span in commanded_s(folder) if span[1] > from_s and span[0] < until_s] == []
    inertia_kg_m2 = (0.0020, 0.0022, 0.0025)
    momenta = [
        math.hypot(*(i * rate for i, rate in zip(inertia_kg_m2, row[5:8], strict=True)))
        for row in records(folder, "attitude")
        if from_s < row[0] / HZ < until_s
    ]
    assert len(momenta) >= 0.5 * HZ * (until_s - from_s)
    # Interpolation and integration err by 1e-6; the coils take 1 % per second.
    assert max(momenta) - min(momenta) < 1e-4 * max(momenta)


@pytest.mark.parametrize("frames", [0, pytest.param(1, marks=pytest.mark.nightly)])
def test_flood_is_held_to_the_lines_rate_and_the_vehicle_flies_on(fly, frames):
    code, folder, document = fly(flood_at_s=BEGINS_S, flood_s=FLOOD_S, flood_frames=frames)

    assert code == 4
    assert_nobody_else_noticed(folder, document)
    found = broken(document)
    assert found.pop("hardware.lost_bytes") == f"{TROUBLED}/mcu"
    assert {name: found[name] for name in set(found) - BUSY} == {ANSWERS_LATE: TROUBLED}, found
    assert f"worst: {TROUBLED}/mcu" in document["verdict"]

    device, interface = document["devices"][f"{TROUBLED}/mcu"], flight_of(document)["interface"]
    bound = BYTES_S * (FLOOD_S + 2) + ANSWER_BYTES_MAX * DURATION_S * HZ
    assert device["counts"]["lost_bytes"] > 0
    assert interface["bytes_received"] <= bound
    # Each byte is recorded as two digits.
    size = (folder / "devices" / TROUBLED / "mcu" / "received.jsonl").stat().st_size
    assert size <= 2.5 * bound
    assert (device["errors"], device["restarts"]) == (0, 0)
    damaged = interface["answers_unasked"] if frames else interface["faults"]["corrupt"]
    assert damaged > 100

    # The last command before the flood ends by itself 1.1 s after it was given; until the firmware is back none is taken.
    assert_coasts(folder, BEGINS_S + 1.2, BEGINS_S + FLOOD_S - 0.5)
    assert any(begins_s > BEGINS_S + FLOOD_S for begins_s, _ in commanded_s(folder))


@pytest.mark.nightly
def test_firmware_that_stops_in_its_fault_handler_is_named_and_commands_no_more(fly):
    code, folder, document = fly(fault_at_s=BEGINS_S)

    assert code == 4
    assert_nobody_else_noticed(folder, document)
    found = broken(document)
    assert {name: found[name] for name in set(found) - BUSY} == {ANSWERS_LATE: TROUBLED}, found
    flight = flight_of(document)
    assert flight["answers"] < BEGINS_S * HZ + 5
    assert flight["ticks_skipped"] > 0
    log = (folder / "agents" / TROUBLED / "log.jsonl").read_text()
    assert log.count("device mcu has answered nothing since the tick at") == 1
    assert_coasts(folder, BEGINS_S + 1.2, DURATION_S)


@pytest.mark.nightly
def test_emulator_that_gives_up_is_named_in_its_own_words(fly):
    code, folder, document = fly(lockup_at_s=BEGINS_S)

    assert code == 4
    assert_nobody_else_noticed(folder, document)
    found = broken(document)
    assert found["hardware.lost"] == f"{TROUBLED}/mcu"
    named = {worst for name, worst in found.items() if name not in BUSY}
    assert named <= {TROUBLED, f"{TROUBLED}/mcu", f"{TROUBLED}/mcu.magnetometer"}, found
    device = document["devices"][f"{TROUBLED}/mcu"]
    assert device["why"].startswith("the emulator is gone: ")
    assert 'it said: "qemu: fatal: Lockup' in device["why"]
    assert "\n" not in device["why"] and "R00=" not in device["why"]
    talk = "".join(path.read_text() for path in folder.rglob("*.txt"))
    assert "Traceback" not in talk + json.dumps(document)
    assert_coasts(folder, BEGINS_S + 1.2, DURATION_S)
