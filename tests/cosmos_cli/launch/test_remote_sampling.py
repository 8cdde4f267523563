"""What another machine tells of its devices is held within bounds, and cleaned."""

import json

import pytest

from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Answer
from cosmos_cli.launch import remote_sampling
from cosmos_cli.launch.remote_sampling import checked_devices, read_answer
from madns_runtime.config import DeviceLaunch

DEVICE = {
    "status": "ok",
    "identity": "g-1",
    "error": "",
    "why": "",
    "errors": 0,
    "lost": 0,
    "channels": {"level": {"samples": 3, "rate_hz": 10.0}},
    "report": {},
}
LAUNCH = DeviceLaunch(
    name="imu", place="pi01", kind="synthetic", base_directory="/", rate_hz=1.0, users=("a",)
)


def parts(**files):
    yield Answer(value={"is_running": True})
    yield Answer(value={"said": "hello"})
    for name, body in files.items():
        for start in range(0, len(body), 5):
            yield Answer(value={"file": name}, body=body[start : start + 5])


def refusal(answers, records=None):
    with pytest.raises(MachineFailure) as caught:
        read_answer(answers, records)
    assert caught.value.kind is FailureKind.DATA
    return caught.value.text


def test_answer_and_records_come_in_pieces(tmp_path):
    files = {"answer.json": b'{"devices": {}}', "devices/pi01/imu/level.jsonl": b"1\n2\n3\n4\n"}

    told, said = read_answer(parts(**files), tmp_path)

    assert (told, said) == ({"devices": {}}, "hello")
    assert (tmp_path / "devices/pi01/imu/level.jsonl").read_bytes() == b"1\n2\n3\n4\n"


@pytest.mark.parametrize(
    "name",
    ["../x.jsonl", "/etc/x.jsonl", "devices/../../x.jsonl", "devices/a/b/x.py", "devices/a/b"],
)
def test_files_that_nobody_asked_for_are_refused(tmp_path, name):
    assert "a file that nobody asked for" in refusal(parts(**{name: b"x"}), tmp_path / "records")
    assert list(tmp_path.rglob("*")) == []


def test_records_that_nobody_asked_for_are_refused():
    assert "nobody asked for" in refusal(parts(**{"devices/a/b/x.jsonl": b"x"}))


def test_more_than_the_bound_and_what_is_no_answer_is_refused(monkeypatch):
    monkeypatch.setattr(remote_sampling, "ANSWER_BYTES_MAX", 8)
    assert "more than was asked for" in refusal(parts(**{"answer.json": b"x" * 10}))
    assert "no JSON" in refusal(parts(**{"answer.json": b"x"}))
    assert "no mapping" in refusal(parts(**{"answer.json": b"[1]"}))


def test_an_answer_that_is_nested_without_end_is_refused():
    assert "no JSON" in refusal(parts(**{"answer.json": b"[" * 5000}))
    deep = json.loads("[" * 600 + "]" * 600)
    with pytest.raises(MachineFailure, match="nested without end"):
        checked_devices({"devices": deep}, ())


def test_texts_are_cleaned_and_numbers_finite():
    device = {**DEVICE, "identity": "g\x1b[2J1", "errors": 1, "why": "x" * 5000}
    told = json.loads(json.dumps({"devices": {"pi01/imu": device, "pi01/other": 1}}))
    told["devices"]["pi01/imu"]["channels"]["level"]["rate_hz"] = float("inf")

    found = checked_devices(told, [LAUNCH])

    assert list(found) == ["pi01/imu"]
    assert "\x1b" not in found["pi01/imu"]["identity"]
    assert len(found["pi01/imu"]["why"]) == 2000
    assert found["pi01/imu"]["channels"]["level"]["rate_hz"] is None


@pytest.mark.parametrize(
    "told",
    [
        {},
        {"devices": []},
        {"devices": {"pi01/imu": 3}},
        {"devices": {"pi01/imu": {**DEVICE, "errors": "no"}}},
        {"devices": {"pi01/imu": {**DEVICE, "channels": {"level": 3}}}},
    ],
)
def test_what_is_missing_is_refused(told):
    with pytest.raises(MachineFailure, match="pi01/imu"):
        checked_devices(told, [LAUNCH])
