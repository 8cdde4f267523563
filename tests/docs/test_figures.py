"""Figures in the guides say what they were measured on."""

import re

import pytest
from guides import GUIDES, ROOT

PAGES = [*(page for page in GUIDES if page.name != "CONTRIBUTING.md"), ROOT / "CHANGELOG.md"]
TIMED = re.compile(
    r"\d (?:us|ms)\b|\b(?:milli|micro)seconds\b|\d s\b[^.\n]*\bcores|virtual machine|times real time|2-core|two cores"
)
SAID = re.compile(
    r"(?:No figure|Nothing)[^.:]*\b(?:measured|tried) on a real board", flags=re.DOTALL
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_with_times_says_that_no_board_was_measured(page):
    text = page.read_text("utf-8")

    assert not TIMED.search(text) or SAID.search(text)


def test_times_are_recognised_where_they_stand():
    """Else the test above would pass for want of pages."""
    found = {page.name for page in PAGES if TIMED.search(page.read_text("utf-8"))}

    assert {"README.md", "control.md", "links.md", "lockstep.md"} <= found
