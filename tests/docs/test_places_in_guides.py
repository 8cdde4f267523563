"""The files of the project that the guides name are there, by their whole path or the end of it."""

import re
import tomllib

import pytest
from guides import ROOT, spans

PAGES = [ROOT / "CONTRIBUTING.md", ROOT / "docs/thesis-map.md"]
NAMED = re.compile(r"[a-z_][a-z0-9_/]*\.py")
FOLDERS = ("benchmarks", "cosmos_cli", "docs", "madns_runtime", "scenarios", "tests")


def named_files(page):
    """Return the Python files that a page names; of the thesis's map only in its column of here."""
    text = page.read_text("utf-8")
    if page.name == "thesis-map.md":
        text = re.sub(r"^\|[^|]*\|", "|", text, flags=re.MULTILINE)
    return {name for span in spans(text) for name in NAMED.findall(span) if span == name}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_guide_names_is_there(page):
    files = [
        f"/{path.relative_to(ROOT)}" for name in FOLDERS for path in (ROOT / name).rglob("*.py")
    ]
    named = named_files(page)

    assert named
    assert {name for name in named if not any(file.endswith(f"/{name}") for file in files)} == set()


@pytest.mark.parametrize("package", ["cosmos_cli", "madns_runtime"])
def test_the_house_is_told_from_the_top_floor_down(package):
    """As its import contracts have it: whoever reads the table knows what may import what."""
    contributing = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    table = contributing.split(f"| room of `{package}/` | holds |", 1)[1].split("\n\n", 1)[0]
    rooms = [
        room.removesuffix(".py").removesuffix("/")
        for row in re.findall(r"^\| (`[^|]*) \|", table, flags=re.MULTILINE)
        for room in re.findall(r"`([^`]+)`", row)
    ]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    (contract,) = (each for each in contracts["contracts"] if each.get("containers") == [package])
    floors = [floor.split(" | ") for floor in contract["layers"]]

    floor_of = {room: number for number, floor in enumerate(floors) for room in floor}
    assert set(rooms) == set(floor_of)
    assert [floor_of[room] for room in rooms] == sorted(floor_of.values())
