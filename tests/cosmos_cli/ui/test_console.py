"""Tables on terminals of any width: nothing of a cell is lost."""

import io
import sys

import pytest

from cosmos_cli.ui.console import Column, Console, stacked

COLUMNS = (Column("level"), Column("machines", is_number=True), Column("found"), Column("cure"))
ROWS = (
    ("warning", "3", "CPU governor is ondemand", "`cosmos_cpu_governor: performance`, then up"),
    ("note", "24", "was started just now", ""),
)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(monkeypatch, width, stream):
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setattr(sys, "stdout", stream)
    Console().table(COLUMNS, ROWS)
    return stream.getvalue()


@pytest.mark.parametrize("width", [200, 89, 88, 80, 40, 20, 1])
def test_no_word_of_a_table_is_cut_on_any_terminal(monkeypatch, width):
    text = shown(monkeypatch, width, Terminal())

    assert [word for row in ROWS for cell in row for word in cell.split() if word not in text] == []
    if width >= 40:
        assert max(map(len, text.splitlines())) <= width


def test_table_is_framed_where_it_fits(monkeypatch):
    assert "┃" in shown(monkeypatch, 200, Terminal())
    assert "┃" not in shown(monkeypatch, 60, Terminal())
    assert "┃" not in shown(monkeypatch, 200, io.StringIO())


def test_what_does_not_fit_stands_below_its_row():
    assert stacked(COLUMNS, ROWS, 48) == [
        "level    machines  found",
        "warning         3  CPU governor is ondemand",
        "  cure: `cosmos_cpu_governor: performance`, then",
        "    up",
        "note           24  was started just now",
    ]
