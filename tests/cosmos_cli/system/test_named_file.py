"""Files that a person named for what a command has to tell: none of another kind is lost."""

from pathlib import Path

import pytest

from cosmos_cli import app
from cosmos_cli.errors import InputError
from cosmos_cli.system.named_file import HTML, JSON_SCHEMA, JUNIT, check_writable

SCENARIO = "name: a\nsimulation: counter\n"


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (HTML, "<!DOCTYPE html>\n<html>"),
        (HTML, "\ufeff\n<html lang='en'>"),
        (JSON_SCHEMA, '{\n  "$defs": {}}'),
        (JSON_SCHEMA, '{"$schema": ""}'),
        (JUNIT, "<?xml version='1.0'?>\n<testsuites>"),
        (JUNIT, "<testsuite/>"),
        (HTML, ""),
        (JSON_SCHEMA, " \n"),
    ],
)
def test_a_file_of_its_kind_and_an_empty_one_may_be_replaced(tmp_path, kind, text):
    path = tmp_path / "file"
    path.write_text(text, "utf-8")

    check_writable(path, kind)
    check_writable(tmp_path / "new", kind)


@pytest.mark.parametrize("kind", [HTML, JSON_SCHEMA, JUNIT])
@pytest.mark.parametrize(
    "text", [SCENARIO, "<SpaceSystem/>", '{"name": "a"}', "# <html> <testsuite>", "\0\1"]
)
def test_a_file_of_another_kind_is_refused(tmp_path, kind, text):
    path = tmp_path / "file"
    path.write_text(text)

    with pytest.raises(
        InputError, match=f"file: cannot be written: what is there is no {kind.name}"
    ):
        check_writable(path, kind)


@pytest.mark.usefixtures("own_places")
@pytest.mark.parametrize(
    "words",
    [
        ["diff", "1", "2", "--html"],
        ["report", "1", "--html"],
        ["schema", "--output"],
    ],
)
def test_a_scenario_that_is_taken_for_the_file_is_kept(tmp_path, capsys, words):
    scenario = tmp_path / "a.yaml"
    scenario.write_text(SCENARIO)

    assert app.run([*words, str(scenario)]) == 2

    assert "a.yaml: " in (err := capsys.readouterr().err)
    assert "and would be lost; name another file" in err
    assert scenario.read_text() == SCENARIO


def test_the_schema_of_this_repository_may_be_written_anew():
    kept = Path(__file__).parents[3] / "scenarios" / "scenario.schema.json"

    check_writable(kept, JSON_SCHEMA)
