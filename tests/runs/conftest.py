"""What holds of every run here: the shipped simulations declare all that they record, and their figures are drawn."""

import json
import re

import pytest

from cosmos_cli.evidence.remarks import NOT_DECLARED


@pytest.fixture(autouse=True)
def nothing_undeclared(tmp_path):
    """Fail a test one of whose runs recorded what its simulation does not declare, or has figures that raised."""
    yield
    check_declared(tmp_path)
    check_figures(tmp_path)


@pytest.fixture(scope="module")
def runs_folder(tmp_path_factory):
    """Return a folder for runs that several tests of a module read; the same holds of them."""
    folder = tmp_path_factory.mktemp("runs")
    yield folder
    check_declared(folder)
    check_figures(folder)


def check_declared(folder):
    for path in folder.rglob("run.json"):
        remarks = json.loads(path.read_bytes()).get("remarks", ())
        assert not [text for text in remarks if NOT_DECLARED in text or "declared and" in text]
        assert not [text for text in remarks if text.endswith("is declared")]


def check_figures(folder):
    for path in folder.rglob("report.html"):
        page = path.read_text("utf-8")
        assert not re.findall(r"The figures? [^<]* could not be drawn|drew no figures[^<]*", page)
