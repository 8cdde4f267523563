"""Results as JUnit XML that other programs read."""

import os
from pathlib import Path

import pytest
from lxml import etree

from cosmos_cli.app import run
from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.testing.junit import (
    JunitCase,
    junit_case_of,
    junit_text,
    prepare_junit,
    write_junit,
)

SCHEMA = etree.XMLSchema(etree.parse(Path(__file__).with_name("junit.xsd")))
FOREIGN = "\x1b[31mred\x00\x07 <&> \ud800 \ufffe \u202e\n\ttab ]]> \U0001f680"


def case(**more):
    return JunitCase(**{"classname": "s.yaml", "name": "s", "seconds": 1.25, **more})


def parsed(*cases):
    text = junit_text(cases, seconds=3.5, started_utc="2026-01-02T03:04:05.678Z")
    root = etree.fromstring(text)
    SCHEMA.assertValid(root)
    return root


def test_is_valid_and_counts_what_it_holds():
    root = parsed(
        case(properties=(("seed", "3"),)),
        case(name="b", failure="broken", details="broken\nat agent-07"),
        case(name="c", skipped="interrupted"),
    )

    (suite,) = root
    assert dict(suite.attrib) == {
        "name": "cosmos",
        "tests": "3",
        "failures": "1",
        "errors": "0",
        "skipped": "1",
        "time": "3.500",
        "timestamp": "2026-01-02T03:04:05",
    }
    assert suite[0].find("properties/property").attrib == {"name": "seed", "value": "3"}
    assert suite[1].find("failure").text == "broken\nat agent-07"
    assert suite[2].find("skipped").get("message") == "interrupted"


def test_what_somebody_else_said_is_cleaned_everywhere():
    root = parsed(
        case(
            classname=FOREIGN,
            name=FOREIGN,
            failure=FOREIGN,
            details=FOREIGN,
            properties=((FOREIGN, FOREIGN),),
        ),
        case(skipped=FOREIGN),
    )

    text = etree.tostring(root, encoding="unicode")
    assert "\\x1b[31mred\\x00\\x07 &lt;&amp;&gt;" in text
    assert not set("\x1b\x00\x07\u202e\ufffe") & set(text)


def test_of_a_megabyte_the_end_is_counted():
    failure = parsed(case(failure="x" * 10**6, details="y" * 10**6)).find(
        "testsuite/testcase/failure"
    )

    assert len(failure.text) <= 20_000
    assert "characters more" in failure.text and "characters more" in failure.get("message")


def test_a_command_of_many_settings_stands_there_in_whole():
    command = "cosmos run s.yaml" + "".join(f" --set vars.number_{n}={n}" for n in range(100))

    (listed,) = parsed(case(properties=(("repeat", command),))).iter("property")
    assert listed.get("value") == command


def test_of_no_test_it_is_valid_too():
    assert parsed()[0].get("tests") == "0"


def test_a_run_by_itself_is_a_test_too():
    check = {"name": "drift", "limit": 1, "got": 2, "passed": False, "worst": "agent-07"}
    document = {"scenario": "s", "exit_code": 4, "verdict": "CHECK BROKEN", "checks": [check]}
    failure = parsed(junit_case_of(Path("s.yaml"), Path("/runs/1"), document))[0][0].find("failure")

    assert failure.get("message") == "CHECK BROKEN"
    assert "drift: got 2, limit 1, worst: agent-07" in failure.text
    assert parsed(junit_case_of(Path("s"), Path("r"), {"exit_code": 0}))[0].get("failures") == "0"


def test_folders_are_made_and_what_cannot_be_written_is_told(tmp_path):
    write_junit(tmp_path / "a/b.xml", [case()], seconds=1.0, started_utc="2026-01-02T03:04:05Z")
    SCHEMA.assertValid(etree.parse(tmp_path / "a/b.xml"))

    with pytest.raises(InputError, match="--junit .*b.xml/c.xml: cannot be written"):
        write_junit(tmp_path / "a/b.xml/c.xml", [], seconds=0.0, started_utc="")


def test_what_could_not_be_written_is_told_before_anything_runs(tmp_path):
    (tmp_path / "file").touch()

    prepare_junit(None)
    prepare_junit(tmp_path / "new/j.xml")
    with pytest.raises(InputError, match="file/j.xml: cannot be written: "):
        prepare_junit(tmp_path / "file/j.xml")
    with pytest.raises(InputError, match="cannot be written: it is a folder; name a file"):
        prepare_junit(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="cannot be written: it is a device, a pipe or a stream"):
        prepare_junit(tmp_path / "pipe")


def test_an_earlier_file_is_gone_before_what_it_would_be_taken_for(tmp_path, capsys):
    earlier = tmp_path / "j.xml"
    missing = tmp_path / "missing.yaml"

    for command in (["run"], ["test"], ["run", "-i", str(tmp_path / "missing.ini")]):
        earlier.write_text("<testsuites/>")
        assert run([*command, str(missing), "--junit", str(earlier)]) == ExitCode.BAD_INPUT
        assert "missing." in capsys.readouterr().err
        assert not earlier.exists()


@pytest.mark.parametrize(
    "text",
    [
        "name: a\nsimulation: counter\n",
        "# of <testsuites/>\nname: a\n",
        "<?xml version='1.0'?>\n<SpaceSystem/>\n",
    ],
)
def test_another_file_that_is_taken_for_it_is_kept(tmp_path, capsys, text):
    other = tmp_path / "a.yaml"
    other.write_text(text)

    assert run(["test", "--junit", str(other)]) == ExitCode.BAD_INPUT
    assert "a.yaml: cannot be written: what is there is no JUnit XML" in capsys.readouterr().err
    assert other.read_text() == text


def test_an_empty_file_and_one_of_anybody_elses_tests_is_replaced(tmp_path):
    theirs = tmp_path / "theirs.xml"
    theirs.write_text('\ufeff<?xml version="1.0"?>\n<testsuite name="pytest"/>', "utf-8")
    prepare_junit(theirs)
    assert not theirs.exists()

    (tmp_path / "empty.xml").touch()
    prepare_junit(tmp_path / "empty.xml")
    assert not (tmp_path / "empty.xml").exists()
