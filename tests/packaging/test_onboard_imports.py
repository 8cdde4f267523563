"""What is sent to a machine must run there, where nothing is installed: the standard library and its neighbours."""

import ast
import importlib
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ONBOARD = ROOT / "cosmos_cli" / "onboard"
PACKAGE = "cosmos_cli.onboard"
SENT_TOO = ("madns_runtime.processes",)
"""Modules from elsewhere that are sent by their full name, and bound by the same."""
FILES = sorted(ONBOARD.rglob("*.py"))


def imported(file):
    """Every module that a file imports anywhere, also in functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import is not understood there"
            yield node.module


def is_allowed(name):
    if name in SENT_TOO or name == PACKAGE or name.startswith(f"{PACKAGE}."):
        return True
    return name.split(".")[0] in sys.stdlib_module_names


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_part_imports_the_standard_library_and_its_neighbours_only(file):
    assert [name for name in imported(file) if not is_allowed(name)] == []


@pytest.mark.parametrize("name", SENT_TOO)
def test_module_that_is_sent_from_elsewhere_imports_the_standard_library_only(name):
    file = ROOT.joinpath(*name.split(".")).with_suffix(".py")

    assert [n for n in imported(file) if n.split(".")[0] not in sys.stdlib_module_names] == []


def test_there_are_parts():
    assert ONBOARD / "request_loop.py" in FILES


def sent_parts():
    """Yield every name of a part in the tuples that the operator's side sends parts by."""
    source = ROOT / "cosmos_cli"
    files = (file for file in source.rglob("*.py") if "templates" not in file.parts)
    for file in sorted(files):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and any(
                isinstance(target, ast.Name) and target.id.endswith("PARTS")
                for target in node.targets
            ):
                yield from (
                    each.value
                    for part in ast.walk(node.value)
                    if isinstance(part, ast.Tuple)
                    for each in part.elts
                    if isinstance(each, ast.Constant)
                )


def test_every_part_that_is_sent_is_there():
    parts = set(sent_parts())

    assert len(parts) > 10
    assert parts <= {*SENT_TOO, *(file.stem for file in FILES)}


def lists_of_parts():
    """Yield every list of parts that a helper is started with, with where it stands."""
    for file in sorted((ROOT / "cosmos_cli").rglob("*.py")):
        if "templates" not in file.parts and re.search(
            r"^\w*PARTS\b.*= \(", file.read_text(), re.M
        ):
            module = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            for name, parts in vars(importlib.import_module(module)).items():
                if name.endswith("PARTS"):
                    yield f"{module}.{name}", parts


def needed_at_once(part):
    """Yield the neighbours that a part imports as it is loaded."""
    for node in ast.parse((ONBOARD / f"{part}.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module.startswith(PACKAGE):
            inner = node.module.removeprefix(PACKAGE).removeprefix(".")
            yield from [inner] if inner else (alias.name for alias in node.names)


def test_every_part_is_sent_with_the_parts_that_it_imports():
    missing = {
        (where, part, other)
        for where, parts in lists_of_parts()
        for part in parts
        if part not in SENT_TOO
        for other in needed_at_once(part)
        if other not in (*parts, "request_loop")
    }

    assert missing == set()
