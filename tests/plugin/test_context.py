"""How what a plug-in raised is told: which call, what, and the line that its author can mend."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from madns_runtime.config import Agents
from madns_runtime.errors import MadnsError, PluginError
from madns_runtime.plugin.context import JobContext, check_sending, describe_exception
from madns_runtime.plugin.isolation import said
from madns_runtime.plugin.jobs import JobFailed, run_job
from madns_runtime.protocol.messages import Service, Transmission
from madns_runtime.recording.run_journal import RunJournal

PLUGIN = """\
import json


def step(text):
    return parse(text)


def parse(text):
    return json.loads(text)


def check(value):
    if value < 0:
        raise ValueError


def leave():
    raise SystemExit(3)
"""


@pytest.fixture
def plugin(tmp_path: Path) -> dict[str, Any]:
    path = tmp_path / "rover.py"
    path.write_text(PLUGIN)
    names: dict[str, Any] = {}
    exec(compile(PLUGIN, path, "exec"), names)
    return names


def told(method: Any, *arguments: Any) -> str:
    try:
        method(*arguments)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - as the callers do
        return describe_exception(error, "Rover.step")
    raise AssertionError("raised nothing")


def test_place_is_the_plugins_own_line_not_the_librarys(plugin):
    with pytest.raises(json.JSONDecodeError) as raised:
        json.loads("{")

    expected = f"Rover.step raised JSONDecodeError: {raised.value} (rover.py:9)"
    assert told(plugin["step"], "{") == expected


def test_call_that_does_not_fit_is_told_where_the_function_is_written_not_where_it_was_called():
    def step() -> None:
        """Takes no tick."""

    line = step.__code__.co_firstlineno
    try:
        step(1)
    except TypeError as error:
        text = describe_exception(error, "Rover.step", step)

    assert text.endswith(f"takes 0 positional arguments but 1 was given (test_context.py:{line})")


def test_call_that_does_not_fit_what_has_no_file_is_told_without_a_place():
    try:
        len(1, 2)
    except TypeError as error:
        text = describe_exception(error, "Rover.step", len)

    assert text == "Rover.step raised TypeError: len() takes exactly one argument (2 given)"


def test_job_that_takes_other_arguments_is_told_where_it_is_written():
    line = run_nothing.__code__.co_firstlineno

    with pytest.raises(JobFailed, match=rf"\(test_context\.py:{line}\)$"):
        run_job(run_nothing, 3)


def run_nothing() -> None:
    """Do nothing, with nothing."""


def test_exception_without_a_text_is_told_by_its_kind(plugin):
    assert told(plugin["check"], -1) == "Rover.step raised ValueError (rover.py:14)"


def test_exception_that_cannot_say_what_it_is_is_told_all_the_same():
    class OutOfReach(Exception):
        def __str__(self) -> Any:
            return 404

    def step() -> None:
        raise OutOfReach

    assert told(step).startswith("Rover.step raised OutOfReach: (its __str__ raised TypeError) (")
    assert said(OutOfReach()) == "OutOfReach: (its __str__ raised TypeError)"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2 faults\nspeed: -1\nmark: None", "2 faults (rover.py:2)\nspeed: -1\nmark: None"),
        ("\n  speed: -1", "speed: -1 (rover.py:2)"),
        ("x" * 5000, f"{'x' * 1500} [cut] (rover.py:2)"),
        (f"one\n{'x' * 5000}", f"one (rover.py:2)\n{'x' * 1996} [cut]"),
    ],
)
def test_place_stands_in_the_first_line_however_much_an_exception_says(tmp_path, text, expected):
    names: dict[str, Any] = {}
    source = "def step(text):\n    raise RuntimeError(text)\n"
    exec(compile(source, tmp_path / "rover.py", "exec"), names)

    assert told(names["step"], text) == f"Rover.step raised RuntimeError: {expected}"


def test_library_in_an_environment_beside_the_plugin_is_not_the_plugin(tmp_path, plugin):
    folder = tmp_path / ".venv/lib/site-packages"
    folder.mkdir(parents=True)
    library: dict[str, Any] = {}
    exec(compile("def fail():\n    raise KeyError('x')\n", folder / "lib.py", "exec"), library)
    source = "\n\ndef step():\n    fail()\n"
    names: dict[str, Any] = {"fail": library["fail"]}
    exec(compile(source, tmp_path / "rover.py", "exec"), names)

    assert told(names["step"]) == "Rover.step raised KeyError: 'x' (rover.py:4)"


def test_failed_job_is_told_where_it_was_raised(plugin):
    with pytest.raises(JobFailed) as raised:
        run_job(plugin["step"], "{")

    assert str(raised.value).startswith("step raised JSONDecodeError: ")
    assert str(raised.value).endswith(" (rover.py:9)")


def test_job_that_leaves_has_failed(plugin):
    with pytest.raises(JobFailed, match=r"leave raised SystemExit: 3 \(rover.py:18\)"):
        run_job(plugin["leave"])


def test_job_that_succeeds_returns_its_value():
    assert run_job(max, 1, 2) == 2


def test_thousands_of_agents_share_one_list_of_all_names():
    first, second = (Agents(count=5000, tick_hz=hz).resolved_names() for hz in (1.0, 2.0))

    assert first is second
    assert (first[0], first[-1]) == ("agent-0001", "agent-5000")


def entered(transmission, sender="kiosk"):
    """Enter a message of a place by the host's context; return what the carrier got."""
    got = []
    context = SimpleNamespace(
        _half=SimpleNamespace(carrier=SimpleNamespace(enter=lambda *taken: got.append(taken)))
    )
    JobContext.enter(context, sender, transmission, ())
    return got[0][1]


def test_a_message_of_a_place_is_the_one_that_was_entered_whatever_becomes_of_its_payload():
    payload = {"x_m": np.arange(3.0)}

    kept = entered(Transmission("car-1", 1, 0.5, payload))
    payload["x_m"] += 1.0

    assert kept.payload["x_m"].tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("transmission", "sender", "told"),
    [
        (Transmission("car-1", 1, 0.5, {1, 2}), "kiosk", "a message cannot carry a set"),
        (Transmission("car-1", 1, 0.5, 1), 7, "expected a place's name and a Transmission"),
        ({"to": "car-1"}, "kiosk", "expected a place's name and a Transmission"),
    ],
)
def test_a_message_of_a_place_that_cannot_be_is_told_in_the_line_that_enters_it(
    transmission, sender, told
):
    with pytest.raises(MadnsError, match=told):
        entered(transmission, sender)


@pytest.mark.parametrize("deadline_s", ["5", True, float("nan"), [5.0]])
def test_a_deadline_that_is_no_time_is_told_as_such(deadline_s):
    with pytest.raises(PluginError, match="deadline_s: expected a simulated time in seconds"):
        check_sending("host", ("host",), Service.SYNC, deadline_s, is_running=True)


def test_a_log_of_what_is_no_text_is_told_as_such():
    journal = RunJournal(SimpleNamespace(open_stream=lambda schema: None), 1, t_s=lambda: 0.0)

    with pytest.raises(PluginError, match=r"log: expected a text, got ValueError; str\(\) it"):
        journal.log("error", ValueError("x"))
