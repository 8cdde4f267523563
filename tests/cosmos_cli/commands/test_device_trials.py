"""`cosmos devices test` and `record`: what is missing in what a device gave is said, and why it failed."""

from typing import Any

import pytest

from cosmos_cli.commands.device_trials import is_bad, shortcomings

SOUND: dict[str, Any] = {
    "samples": 20,
    "errors": 0,
    "error": "",
    "lost": 0,
    "why": "",
    "silent_inputs": [],
    "channels": {"field": {"samples": 20}},
    "report": {"samples": 20, "field_not_finite": 0, "records": {"dropped": 0}},
}


def test_of_a_device_that_gave_all_nothing_is_said():
    assert (shortcomings(SOUND), is_bad(SOUND)) == ([], False)


def test_what_is_missing_is_said():
    report = {"field_not_finite": 1, "gyro_not_finite": 3, "records": {"dropped": 7}}

    assert shortcomings({**SOUND, "silent_inputs": ["level"], "report": report}) == [
        "not on record for want of room: 7 records",
        "no value came of level",
        "1 sample of field held what is no number",
        "3 samples of gyro held what is no number",
    ]


def test_values_that_are_no_numbers_are_bad_and_an_input_of_several_that_is_silent_is_not():
    assert is_bad({**SOUND, "report": {"field_not_finite": 1}})
    assert not is_bad({**SOUND, "silent_inputs": ["level"]})


HANGS = "its driver did not return within 3 s of the run's end"


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ({"errors": 1, "error": "Line.read: no line"}, "Line.read: no line"),
        ({"lost": 1, "why": "killed by SIGKILL"}, "killed by SIGKILL"),
        ({"samples": 0, "channels": {"field": {"samples": 0}}}, "no sample of any input"),
        ({"report": {"unreported": 1}, "error": "Line.read: once", "why": HANGS}, HANGS),
        ({"report": {"unreported": 1}}, "its process ended without its report"),
    ],
)
def test_why_a_device_failed_is_said(told: dict[str, Any], why: str):
    assert (shortcomings({**SOUND, **told}), is_bad({**SOUND, **told})) == ([why], True)
