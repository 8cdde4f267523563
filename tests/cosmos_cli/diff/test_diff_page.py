"""A comparison as a page: the terminal's tables and words, and nothing of a run's text does anything there."""

import dataclasses

import pytest
from harness.synthetic_run import SyntheticRun, make_config

from cosmos_cli import app
from cosmos_cli.collect.finish import finish_run

HOSTILE = "</script><script>alert(1)</script>{{ css }}\x1b[31m"

pytestmark = pytest.mark.usefixtures("own_places")


@pytest.fixture
def runs(tmp_path):
    for number, seed in enumerate((1, 2)):
        config = dataclasses.replace(make_config(2, ticks=50), seed=seed)
        made = SyntheticRun(tmp_path / "runs", config).write(with_states=True)
        more = {"simulation": {HOSTILE: number}}
        finish_run(made.run, made.result(**more), made.expected, has_report=False)


def test_it_holds_what_the_terminal_tells(runs, capsys, tmp_path):
    page = tmp_path / "page.html"

    assert app.run(["diff", "1", "2", "--html", str(page)]) == 0

    told, text = capsys.readouterr().out, page.read_text()
    words = ("Settings that differ", "seed", "Timing", "Records", "state", "IDENTICAL: ", "PASSED")
    for word in words:
        assert word in told
        assert word in text
    assert "0001-synthetic and 0002-synthetic" in text
    assert "plotly" not in text, "no figure, and yet 4 MB of a library"


def test_it_takes_json_and_several_runs_beside(runs, capsys, tmp_path):
    page = tmp_path / "page.html"

    assert app.run(["diff", "1", "2", "1", "--html", str(page), "--json", "--quiet"]) == 0

    assert capsys.readouterr().err == ""
    assert page.read_text().count("<h2>A 0001-synthetic, B ") == 2


def test_texts_of_a_run_do_nothing_there(runs, tmp_path, monkeypatch):
    page = tmp_path / "page.html"
    monkeypatch.setattr("cosmos_cli.diff.page.verdict_of", lambda found: HOSTILE)

    assert app.run(["diff", "1", "2", "--html", str(page)]) == 0

    text = page.read_text()
    assert "&lt;script&gt;alert(1)" in text
    assert "<script>alert" not in text
    assert "{{ css }}" in text
    assert "\x1b" not in text


@pytest.mark.parametrize("place", ["/dev/null", "-", ".", "nowhere/page.html"])
def test_a_place_that_takes_no_file_is_refused_before_anything_is_read(place, capsys):
    assert app.run(["diff", "1", "2", "--html", place]) == 2

    assert f"{place}: cannot be written" in capsys.readouterr().err
