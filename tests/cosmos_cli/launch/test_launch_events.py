from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.launch.events import (
    AgentChanged,
    AgentExited,
    AgentStarted,
    FaultInserted,
    Finished,
    Listening,
    Logged,
    Noise,
    Progress,
    StateChanged,
    parse_event,
)


@pytest.mark.parametrize(
    ("document", "event"),
    [
        (
            {"event": "listening", "address": "127.0.0.1", "port": 40001},
            Listening("127.0.0.1", 40001),
        ),
        ({"event": "state", "state": "SIMULATION_SETUP"}, StateChanged("SIMULATION_SETUP")),
        (
            {"event": "agent", "agent": "a", "state": "lost", "reason": "silent"},
            AgentChanged("a", "lost"),
        ),
        (
            {"event": "progress", "t_s": 1, "rtf": None, "running": 2, "missed": 3},
            Progress(t_s=1.0, running=2, missed=3),
        ),
        (
            {"event": "progress", "columns": ["b.c", "b.d"], "values": {"a": [1.5, {}], "b": 3}},
            Progress(columns=("b.c", "b.d"), values={"a": [1.5, None], "b": [None, None]}),
        ),
        ({"event": "log", "level": "warning", "text": "t"}, Logged("warning", "", "t")),
        ({"event": "finished", "result": {"status": "complete"}}, Finished({"status": "complete"})),
        ({"event": "finished"}, Finished(None)),
        ({"event": "started", "agent": "a", "pid": 7, "incarnation": 2}, AgentStarted("a", 7, 2)),
    ],
)
def test_each_event_is_read(document: dict[str, object], event: object) -> None:
    assert parse_event(json.dumps(document).encode()) == event


@pytest.mark.parametrize(
    ("code", "signal_name", "how", "is_abnormal"),
    [
        (0, None, "exit code 0", False),
        (3, None, "exit code 3", True),
        (None, "SIGKILL", "killed by SIGKILL", True),
    ],
)
def test_exit_is_abnormal_unless_its_code_is_zero(
    code: int | None, signal_name: str | None, how: str, is_abnormal: bool
) -> None:
    document = {"event": "exited", "agent": "a", "pid": 7, "code": code, "signal": signal_name}

    event = parse_event(json.dumps(document).encode())

    assert event == AgentExited("a", 7, how, is_abnormal=is_abnormal)


def test_exit_on_purpose_is_told_as_such() -> None:
    line = (
        b'{"event":"exited","agent":"a","pid":7,"code":null,"signal":"SIGKILL",'
        b'"on_purpose":true,"will_restart":true}'
    )

    expected = AgentExited(
        "a", 7, "killed by SIGKILL", is_abnormal=True, is_on_purpose=True, will_restart=True
    )
    assert parse_event(line) == expected


def test_what_became_of_an_order_bears_its_number() -> None:
    line = b'{"event":"injected","number":9,"order":3,"refusal":null,"target":"pi01/imu","action":"freeze"}'

    assert parse_event(line) == FaultInserted(3, "")


@given(st.binary(max_size=200))
def test_any_other_bytes_are_noise_of_bounded_length(line: bytes) -> None:
    event = parse_event(line)

    assert isinstance(event, Noise)
    assert len(event.text) <= 500


@pytest.mark.parametrize(
    "line",
    [
        b'{"event": "unheard-of"}',
        b'{"event": "state"}',
        b'{"event": ["state"]}',
        b'{"event": "listening", "address": "x", "port": "y"}',
        b'"state"',
        b"[]",
    ],
)
def test_json_that_is_no_event_is_noise(line: bytes) -> None:
    assert parse_event(line) == Noise(line.decode())


@pytest.mark.parametrize(
    "line",
    [
        b'{"event":"log","level":"info","text":%s}',
        b'{"event":"state","state":%s}',
        b'{"event":"device","device":"x","status":"lost","why":%s}',
        b'{"event":"exited","agent":"a","pid":7,"how":%s}',
    ],
)
def test_an_event_that_is_nested_deeper_than_python_goes_is_noise(line: bytes) -> None:
    event = parse_event(line % (b"[" * 1000 + b"]" * 1000))

    assert isinstance(event, Noise)


@pytest.mark.parametrize("number", ["1e20", "-1e20", "1e300", str(2**53 + 1)])
@pytest.mark.parametrize(
    "line",
    [
        '{"event":"started","agent":"a","pid":%s}',
        '{"event":"started","agent":"a","pid":7,"incarnation":%s}',
        '{"event":"exited","agent":"a","pid":%s,"code":1}',
        '{"event":"listening","address":"x","port":%s}',
        '{"event":"injected","order":%s}',
        '{"event":"process","pid":%s}',
        '{"event":"pong","n":%s}',
        '{"event":"progress","ready":%s}',
    ],
)
def test_an_event_with_a_number_that_cannot_be_told_again_is_noise(line: str, number: str) -> None:
    assert parse_event((line % number).encode()) == Noise(line % number)
