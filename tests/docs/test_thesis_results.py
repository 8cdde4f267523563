"""The page of the thesis's results names every experiment, and is found from where others are listed."""

import re

import pytest
from guides import ROOT

PAGE = (ROOT / "docs/thesis-results.md").read_text("utf-8")
RUN = PAGE.split("\n## What was run\n", 1)[1]
FILES = sorted(path.name for path in (ROOT / "scenarios/thesis").glob("*.yaml"))


def test_the_page_says_of_each_experiment_what_was_run():
    assert sorted(set(re.findall(r"`(\w+\.yaml)`", RUN))) == FILES
    assert "None of these was ever run on real boards." in RUN


def test_each_goal_of_the_thesis_has_its_row():
    rows = {
        heading: len(re.findall(r"^\| \d\. ", section, flags=re.M))
        for heading, section in re.findall(
            r"^### ([\d.]+): [^\n]*\n(.*?)(?=^##)", PAGE, flags=re.M | re.S
        )
    }

    assert rows == {"1.3.1": 3, "1.3.2": 3, "4.4": 3, "5.4": 2}


@pytest.mark.parametrize(
    "page", ["README.md", "docs/scenarios.md", "docs/thesis-map.md", "docs/bench.md"]
)
def test_the_page_is_found_from_others(page):
    assert "thesis-results.md" in (ROOT / page).read_text("utf-8")
