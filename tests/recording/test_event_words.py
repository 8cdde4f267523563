"""Words of the events that the framework records: all that an expectation or a timeline may wait for."""

import re
from pathlib import Path

import madns_runtime
from madns_runtime.faults.step_faults import HANG, SLOW
from madns_runtime.recording.records import EVENT_WORDS
from madns_runtime.timeline.dispatcher import BEGAN, ENDED, REFUSED, RESUMED


def test_all_words_of_events_are_known_and_no_others():
    folder = Path(madns_runtime.__file__).parent
    written: set[str] = set()
    for path in folder.rglob("*.py"):
        text = path.read_text("utf-8")
        if "hardware" in path.relative_to(folder).parts:
            continue  # devices have events of their own
        written.update(re.findall(r"(?:journal|self)\.event\(\s*\"(\w+)\"", text))
    written.update((BEGAN, ENDED, REFUSED, RESUMED))
    written.update(f"{word}_{what}" for word in (HANG, SLOW) for what in ("begins", "ends"))

    assert set(EVENT_WORDS) == written
