"""`cosmos devices`: kinds, what hangs where, and devices that are tried and recorded without a run."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from harness.waiting import is_alive, wait_until

from cosmos_cli.app import run as cosmos
from hardware.bench import DRIVER, Terminal
from madns_runtime.errors import ConfigurationError
from madns_runtime.hardware import sampling
from madns_runtime.hardware.kind_registry import prepare, registered_kinds

pytestmark = pytest.mark.process

Told = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Told:
    """Run a command with --json, and return its exit code and what it printed."""

    def ask(*words: object) -> tuple[int, dict[str, Any]]:
        code = cosmos([*map(str, words), "--json"])
        return code, json.loads(capsys.readouterr().out)

    return ask


@pytest.fixture
def terminal() -> Any:
    line = Terminal()
    yield line
    line.close()


def inventory(folder: Path, *devices: str, connection: str = "local") -> Path:
    (folder / "line.py").write_text(DRIVER, encoding="utf-8")
    lines = "".join(f"        - {device}\n" for device in devices)
    head = f"all:\n  hosts:\n    pi22:\n      ansible_connection: {connection}\n"
    path = folder / "inventory.yaml"
    path.write_text(f"{head}      cosmos_devices:\n{lines}", encoding="utf-8")
    return path


def line_device(terminal: Terminal, **parameters: str) -> str:
    values = ", ".join(f"{k}: {v}" for k, v in {"port": terminal.port, **parameters}.items())
    return f"{{name: line, kind: './line.py:Line', rate_hz: {RATE_HZ}, outputs: true, parameters: {{{values}}}}}"


def stream(path: Path, names: str, *lines: str) -> None:
    """Write a stream of arrays without an end, as a process leaves it that is killed."""
    fields = [{"name": name, "unit": "", "kind": "float"} for name in names.split()]
    head = {"schema": 1, "stream": path.name.partition(".")[0], "shape": "array", "fields": fields}
    path.write_text("\n".join([json.dumps(head), *lines, ""]))


def test_figures_are_of_all_processes_that_a_device_had(tmp_path: Path) -> None:
    level, valve = "t_s number age_us level", "t_s lateness_us valve"
    stream(tmp_path / "level.jsonl", level, "[0.0,1,100,5.0]", "[0.1,2,100,5.0]")
    stream(tmp_path / "level.2.jsonl", level, "[0.5,3,900,5.0]")
    stream(tmp_path / "level.10.jsonl", level, "[0.8,4,100,5.0]")
    stream(tmp_path / "valve.jsonl", valve, "[0.0,40,1.0]")
    stream(tmp_path / "valve.2.jsonl", valve, "[0.5,50,1.0]")
    for number, why in ((".2", "no line"), ("", "no chip")):
        (tmp_path / f"events{number}.jsonl").write_text(
            '{"schema":1,"stream":"events","shape":"object","fields":[]}\n'
            f'{{"t_s":0.1,"event":"error","why":"{why}"}}\n'
        )

    found = sampling.figures_of(tmp_path)

    assert found["error"] == "no line", "the last one"
    assert found["channels"].keys() == {"level", "valve"}
    got = found["channels"]["level"]
    assert (got["samples"], got["rate_hz"], got["age_us_max"]) == (4, pytest.approx(3.75), 900)
    assert found["channels"]["valve"] == {"written": 2, "lateness_us": 50}


GAUGE = """
import os, time
from pathlib import Path
from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Sample

class Gauge(Device):
    kind = DeviceKind(name="gauge", summary="a gauge", channels=(Channel(name="level"),))
    def read(self):
        Path(__file__).with_name("pids").write_text(f"{os.getppid()} {os.getpid()}\\n")
        return Sample(values={"level": 1.0}, taken_s=time.monotonic())
"""


@pytest.mark.parametrize("word", [signal.SIGKILL, signal.SIGHUP])
def test_what_drives_a_device_ends_with_its_command_however_that_ends(
    tmp_path: Path, word: signal.Signals
) -> None:
    (tmp_path / "gauge.py").write_text(GAUGE)
    listed = inventory(tmp_path, "{name: gauge, kind: './gauge.py:Gauge'}")
    words = ("devices", "test", "-i", str(listed), "--seconds", "3600")
    command = subprocess.Popen([Path(sys.executable).with_name("cosmos"), *words])
    pids = tmp_path / "pids"
    wait_until(lambda: pids.exists() and pids.read_text().endswith("\n"), process=command)
    supervisor, driver = map(int, pids.read_text().split())

    command.send_signal(word)
    command.wait()

    wait_until(lambda: not (is_alive(supervisor) or is_alive(driver)))


SECONDS = 3
"""For a device to be read and written: a busy machine lets its process wait for a second or two."""
RATE_HZ = 3
"""At which a device is lost, and its test ends with 1, after 3.3 s without a sample."""
WAVE = f"{{name: wave, kind: synthetic, rate_hz: {RATE_HZ}}}"


def test_every_kind_is_listed_with_its_summary_and_parameters(told: Told) -> None:
    code, listed = told("devices")
    kinds = {each["kind"]: each for each in listed["kinds"]}
    assert code == 0
    assert set(kinds) == set(registered_kinds())
    assert all(each["summary"] and not each["fault"] for each in kinds.values())
    playback = {each["name"] for each in kinds["playback"]["parameters"]}
    assert {"directory", "start_s", "ticks", "limits"} <= playback
    assert kinds["playback"]["parameters"][0]["required"] is True


def test_what_hangs_where_is_listed(told: Told, tmp_path: Path) -> None:
    code, listed = told("devices", "-i", inventory(tmp_path, "a_label", WAVE))
    assert (code, listed["devices"]) == (
        0,
        [
            {"machine": "pi22", "device": "a_label", "kind": None},
            {"machine": "pi22", "device": "wave", "kind": "synthetic"},
        ],
    )


def test_a_test_tells_identity_and_figures_and_writes_nothing(
    told: Told, tmp_path: Path, terminal: Terminal
) -> None:
    path = inventory(tmp_path, WAVE, line_device(terminal))
    code, result = told("devices", "test", "-i", path, "--seconds", SECONDS)
    found = result["devices"]["pi22/line"]
    figures = found["channels"]["time"]
    assert (code, found["identity"], found["errors"]) == (0, "line-1", 0)
    assert figures["samples"] > 2
    assert figures["rate_hz"] > 0
    assert 0 <= figures["age_us"] <= figures["age_us_max"]
    assert figures["jitter_us"] >= 0
    assert "pi22/wave" in result["devices"]
    assert set(terminal.heard()) == {"OPEN"}


def test_a_test_with_write_puts_out_the_safe_value_alone(
    told: Told, tmp_path: Path, terminal: Terminal
) -> None:
    path = inventory(tmp_path, line_device(terminal))
    code, result = told("devices", "test", "line", "-i", path, "--seconds", SECONDS, "--write")
    assert code == 0
    assert result["devices"]["pi22/line"]["channels"]["valve"]["written"] >= 1
    heard = terminal.heard()
    assert "VALVE 0" in heard
    assert heard[-1] == "SAFE"
    assert set(heard) == {"OPEN", "VALVE 0", "SAFE"}


def test_outputs_that_the_inventory_does_not_permit_are_not_written(
    told: Told, tmp_path: Path, terminal: Terminal
) -> None:
    device = line_device(terminal).replace(" outputs: true,", "")
    told("devices", "test", "-i", inventory(tmp_path, device), "--seconds", 1, "--write")
    assert set(terminal.heard()) == {"OPEN"}


@pytest.mark.parametrize("method", ["open", "read"])
def test_a_device_that_fails_ends_the_test_with_1_and_says_why(
    told: Told, tmp_path: Path, terminal: Terminal, method: str
) -> None:
    path = inventory(tmp_path, line_device(terminal, raises=method))
    code, result = told("devices", "test", "-i", path, "--seconds", SECONDS)
    found = result["devices"]["pi22/line"]
    assert code == 1
    assert found["errors"] > 0
    assert f"{method} does not work" in found["error"]


def test_a_recording_is_played_back(told: Told, tmp_path: Path) -> None:
    folder = tmp_path / "records" / "wave"
    path = inventory(tmp_path, WAVE)
    code, result = told("devices", "record", "wave", folder, "-i", path, "--seconds", SECONDS)
    assert code == 0
    program = prepare("playback", {"directory": str(folder)}, tmp_path)
    assert [channel.name for channel in program.channels] == ["value"]
    device: Any = program.make()
    device.open()
    samples = []
    while (next_s := device.next_s()) < float("inf"):
        samples.append(device.sample_at(next_s))
    assert len(samples) == result["device"]["channels"]["value"]["samples"] > 2
    again, _ = told("devices", "record", "wave", folder, "-i", path)
    assert again == 2
    assert os.listdir(folder.parent) == ["wave"]


def test_a_device_without_samples_leaves_no_recording(
    told: Told, tmp_path: Path, terminal: Terminal
) -> None:
    path = inventory(tmp_path, line_device(terminal, raises="read"))
    folder = tmp_path / "records" / "line"
    code, result = told("devices", "record", "line", folder, "-i", path, "--seconds", SECONDS)
    assert code == 3
    assert "read does not work" in result["error"]["message"]
    assert os.listdir(folder.parent) == []


@pytest.mark.parametrize("words", [("test", "gauge"), ("record", "gauge", "recorded")])
def test_a_driver_that_never_returns_from_close_ends_a_trial_with_1_and_is_told(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    hanging = f"{GAUGE}    def close(self):\n        time.sleep(1000)\n"
    (tmp_path / "gauge.py").write_text(hanging, encoding="utf-8")
    path = inventory(tmp_path, f"{{name: gauge, kind: './gauge.py:Gauge', rate_hz: {RATE_HZ}}}")

    assert cosmos(["devices", *words, "-i", str(path), "--seconds", str(SECONDS)]) == 1
    told = capsys.readouterr().err
    assert "pi22/gauge: its driver did not return within 3 s of the run's end" in told


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("devices", "test"), "with -i"),
        (("devices", "paint"), "expected test, record, verify, calibrate, or nothing"),
        (("devices", "record", "wave", "-i", "X"), "expected NAME and DIRECTORY"),
        (
            ("devices", "test", "imu", "-i", "X"),
            "no device 'imu' in the inventory; there are pi22/",
        ),
        (("devices", "-i", "X", "--write"), "--write is of test and verify alone"),
    ],
)
def test_wrong_words_are_told(
    told: Told, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    path = str(inventory(tmp_path, WAVE))
    code, result = told(*(path if word == "X" else word for word in words))
    assert code == 2
    assert message in result["error"]["message"]


def test_a_device_of_another_computer_is_not_passed_over(told: Told, tmp_path: Path) -> None:
    path = inventory(tmp_path, WAVE, connection="ssh")
    path.write_text(
        path.read_text().replace(
            "pi22:", "pi22:\n      ansible_host: 127.0.0.1\n      ansible_port: 1"
        )
    )
    code, result = told("devices", "test", "-i", path)
    assert (code, result["not_sampled"]) == (3, ["pi22/wave"])
    assert result["failures"]["pi22"]["kind"] == "refused"


def test_what_a_device_needs_and_is_missing_is_told_with_its_cure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kind = tmp_path / "hat.py"
    kind.write_text(
        "from madns_runtime.hardware.contract import Channel, Device, DeviceKind, Needs\n"
        "class Hat(Device):\n"
        "    kind = DeviceKind(name='hat', summary='x', channels=(Channel(name='t'),), needs=Needs(\n"
        "        packages=('hat-tools',), files=('/dev/no-such-hat*',), boot_lines=('dtparam=hat=on',),\n"
        "        system_modules=('no_such_hat',)))\n",
        encoding="utf-8",
    )
    path = inventory(tmp_path, "{name: hat, kind: './hat.py:Hat'}")
    assert cosmos(["devices", "test", "-i", str(path), "--seconds", "0.5"]) == 1
    told = capsys.readouterr().err
    assert "pi22/hat: no file /dev/no-such-hat*: write dtparam=hat=on into config.txt" in told
    assert "no Python module no_such_hat: sudo apt-get install hat-tools" in told


def test_an_order_to_drive_devices_for_longer_than_an_hour_is_refused():
    with pytest.raises(ConfigurationError, match=r"SamplingOrder\.seconds: expected at most 3600"):
        sampling.order_of({"devices": [], "seconds": 4000.0, "directory": "."})
