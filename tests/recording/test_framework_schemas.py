"""A stream of the framework's own is in all tables of such streams once its schema is."""

from cosmos_cli.models.known_streams import FRAMEWORK
from madns_runtime.recording import records
from madns_runtime.recording.records import FRAMEWORK_SCHEMAS, FrameworkSchema


def test_every_schema_is_in_the_table():
    schemas = [each for each in vars(records).values() if isinstance(each, FrameworkSchema)]

    assert list(FRAMEWORK_SCHEMAS.values()) == schemas


def test_rules_of_scenarios_may_name_every_stream_of_the_framework():
    assert {each.name for each in FRAMEWORK} == set(FRAMEWORK_SCHEMAS)
