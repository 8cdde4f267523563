"""Chapters of the shipped simulations and of the framework: each is of a stream that there is, and fits it."""

from types import SimpleNamespace

import pytest

from cosmos_cli.report.build import MACHINE_CHAPTERS, TIME_CHAPTERS
from madns_runtime.recording.records import FRAMEWORK_SCHEMAS
from madns_runtime.simulations.constellation import streams
from madns_runtime.simulations.constellation.analysis.chapters import CHAPTERS as OF_CONSTELLATION
from madns_runtime.simulations.counter import parameters
from madns_runtime.simulations.counter.analysis import CHAPTERS as OF_COUNTER

FRAMEWORK = {name: schema.fields for name, schema in FRAMEWORK_SCHEMAS.items()}
CONSTELLATION = {
    **{f"host_{name}": fields for name, fields in streams.OF_HOST.items()},
    **streams.OF_AGENTS,
    "estimates": streams.ESTIMATES,
}
COUNTER = {
    f"host_{stream.name}" if stream.role == "host" else stream.name: stream.fields
    for stream in parameters.declared_streams(
        parameters.CounterParameters(send_device="gyro"), ("agent-01",)
    )
}


@pytest.mark.parametrize(
    ("chapters", "declared"),
    [
        (OF_CONSTELLATION, CONSTELLATION),
        (OF_COUNTER, COUNTER),
        (
            TIME_CHAPTERS | MACHINE_CHAPTERS,
            FRAMEWORK | {f"{who}_health": FRAMEWORK["health"] for who in ("host", "machine")},
        ),
    ],
    ids=["constellation", "counter", "framework"],
)
def test_each_chapter_is_of_a_stream_that_there_is_and_fits_it(chapters, declared):
    assert set(chapters) - set(declared) == set()
    assert [
        name
        for name, chapter in chapters.items()
        if not chapter.fits(SimpleNamespace(fields=declared[name]))
    ] == []


def test_each_sensor_of_a_constellation_has_its_chapters():
    names = {
        f"{name}{beside}" for name in streams.SENSOR_STREAMS for beside in ("", "_truth", "_model")
    }

    assert names - set(OF_CONSTELLATION) == set()
