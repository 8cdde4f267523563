"""`cosmos devices test` and `record`: what is missing in what a device gave is said."""

from cosmos_cli.commands.device_trials import shortcomings

SOUND = {
    "samples": 20,
    "silent_inputs": [],
    "report": {"samples": 20, "field_not_finite": 0, "records": {"dropped": 0}},
}


def test_of_a_device_that_gave_all_nothing_is_said():
    assert shortcomings(SOUND) == []
    assert shortcomings({**SOUND, "report": None, "samples": 0, "silent_inputs": ["field"]}) == []


def test_what_is_missing_is_said():
    report = {"field_not_finite": 1, "gyro_not_finite": 3, "records": {"dropped": 7}}

    assert shortcomings({**SOUND, "silent_inputs": ["level"], "report": report}) == [
        "not on record for want of room: 7 records",
        "no value came of level",
        "1 sample of field held what is no number",
        "3 samples of gyro held what is no number",
    ]
