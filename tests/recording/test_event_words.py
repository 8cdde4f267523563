"""Words of the events that the framework records: all that an expectation or a timeline may wait for."""

import re
from pathlib import Path

import madns_runtime
from madns_runtime.recording.records import (
    AGENT_EVENT_WORDS,
    DEVICE_EVENT_WORDS,
    EVENT_WORDS,
    HOST_EVENT_WORDS,
)
from madns_runtime.timeline.dispatcher import BEGAN, ENDED, REFUSED, RESUMED
from madns_runtime.timeline.fault_kinds import STEP_FAULTS


def test_all_words_of_events_are_known_and_no_others():
    folder = Path(madns_runtime.__file__).parent
    written: set[str] = set()
    for path in folder.rglob("*.py"):
        text = path.read_text("utf-8")
        if "hardware" in path.relative_to(folder).parts:
            continue  # devices have events of their own
        written.update(re.findall(r"(?:journal|self)\.event\(\s*\"(\w+)\"", text))
    written.update((BEGAN, ENDED, REFUSED, RESUMED))
    written.update(f"{word}_{what}" for word in STEP_FAULTS for what in ("begins", "ends"))

    assert set(EVENT_WORDS) == written
    assert len(EVENT_WORDS) == len(written)
    assert not set(HOST_EVENT_WORDS) & set(AGENT_EVENT_WORDS)


def test_all_words_of_the_events_of_devices_are_known_and_no_others():
    folder = Path(madns_runtime.__file__).parent / "hardware"
    texts = [path.read_text("utf-8") for path in folder.rglob("*.py")]
    written = {
        word for text in texts for word in re.findall(r"(?:event|_tell)\(\s*\"(\w+)\"", text)
    }

    assert set(DEVICE_EVENT_WORDS) == {*written, "end"}  # which closing a journal records
