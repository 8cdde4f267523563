"""
Results as JUnit XML, the form that CI services read: one `testsuite`, one `testcase` per run.

What boards, programs and exceptions said goes into it: cleaned, because XML has no place for most control characters,
and bounded.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final
from xml.etree import ElementTree

import typer

from cosmos_cli.errors import ExitCode, InputError
from cosmos_cli.system.named_file import JUNIT, check_no_other
from cosmos_cli.testing.check_lines import broken_checks, check_line
from cosmos_cli.ui.foreign_text import clean_line, clean_text
from madns_runtime.partial_file import check_replaceable, write_whole

SUITE: Final = "cosmos"
TEXT_CHARACTERS_MAX: Final = 20_000
MESSAGE_CHARACTERS_MAX: Final = 1000


JunitOption = Annotated[
    Path | None,
    typer.Option("--junit", metavar="FILE", help="Write the results as JUnit XML."),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class JunitCase:
    """One test as the file holds it."""

    classname: str
    """The scenario's file."""
    name: str
    seconds: float
    failure: str = ""
    """Why it failed, in a line; empty if it did not."""
    details: str = ""
    """All that is told of the failure."""
    skipped: str = ""
    """Why it has no result; empty if it has one."""
    properties: tuple[tuple[str, str], ...] = ()
    """Names and values, such as the run's folder."""


def junit_text(cases: Sequence[JunitCase], *, seconds: float, started_utc: str) -> bytes:
    """
    Return the file.

    Args:
        cases: The tests, in their order.
        seconds: Time of all together.
        started_utc: Wall time at the beginning, ISO 8601.
    """
    root = ElementTree.Element("testsuites")
    suite = ElementTree.SubElement(
        root,
        "testsuite",
        {
            "name": SUITE,
            "tests": str(len(cases)),
            "failures": str(sum(bool(case.failure) for case in cases)),
            "errors": "0",
            "skipped": str(sum(bool(case.skipped) for case in cases)),
            "time": f"{seconds:.3f}",
            "timestamp": started_utc.removesuffix("Z").partition(".")[0],
        },
    )
    for case in cases:
        _add(suite, case)
    ElementTree.indent(root)
    text: bytes = ElementTree.tostring(root, "utf-8", xml_declaration=True)
    return text + b"\n"


def _add(suite: ElementTree.Element, case: JunitCase) -> None:
    element = ElementTree.SubElement(
        suite,
        "testcase",
        {
            "classname": clean_line(case.classname),
            "name": clean_line(case.name),
            "time": f"{case.seconds:.3f}",
        },
    )
    if case.properties:
        listed = ElementTree.SubElement(element, "properties")
        for name, value in case.properties:
            # A command with many settings is long, and no use when it is cut.
            told = clean_line(value, length_max=TEXT_CHARACTERS_MAX)
            ElementTree.SubElement(listed, "property", {"name": clean_line(name), "value": told})
    if case.failure:
        message = clean_line(case.failure, length_max=MESSAGE_CHARACTERS_MAX)
        failure = ElementTree.SubElement(element, "failure", {"message": message})
        failure.text = clean_text(case.details or case.failure, length_max=TEXT_CHARACTERS_MAX)
    elif case.skipped:
        ElementTree.SubElement(element, "skipped", {"message": clean_line(case.skipped)})


def prepare_junit(path: Path | None) -> None:
    """
    Make the folders above the file and remove an earlier one, whose results would be taken for those that are to come.

    Raises:
        InputError: It could not be written, or what is there is no JUnit XML, such as the scenario of who left FILE out.
    """
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(path)
    except OSError as error:
        raise _unwritable(path, error.strerror) from error
    if not os.access(path.parent, os.W_OK):
        raise _unwritable(path, f"no right to write in {path.parent}")
    try:
        check_no_other(path, JUNIT)
        path.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(path, error.strerror) from error


def _unwritable(path: Path, why: str | None) -> InputError:
    return InputError(f"--junit {path}: cannot be written: {why}")


def write_junit(
    path: Path, cases: Sequence[JunitCase], *, seconds: float, started_utc: str
) -> None:
    """
    Write the file; folders above it are made.

    Raises:
        InputError: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_replaceable(path)
        write_whole(path, junit_text(cases, seconds=seconds, started_utc=started_utc))
    except OSError as error:
        raise _unwritable(path, error.strerror) from error


def junit_case_of(path: Path, directory: Path, document: Mapping[str, Any]) -> JunitCase:
    """
    Return a run by itself as the file holds it.

    Args:
        path: The scenario.
        directory: The run's.
        document: Its run.json.
    """
    verdict = str(document.get("verdict") or "no verdict")
    code = document.get("exit_code")
    is_cut = code == int(ExitCode.INTERRUPTED)
    is_failed = code != 0 and not is_cut
    broken = [check_line(check) for check in broken_checks(document)]
    return JunitCase(
        classname=str(path),
        name=str(document.get("scenario") or path.stem),
        seconds=0.0,
        failure=verdict if is_failed else "",
        details="\n".join([verdict, *broken, f"its run: {directory}"]),
        skipped="interrupted" if is_cut else "",
        properties=(("seed", str(document.get("seed"))), ("run", str(directory))),
    )
