"""The report on a terminal tells what its page tells beside the figures."""

from cosmos_cli.report.terminal import print_report
from cosmos_cli.ui.console import Console
from madns_runtime.analysis.values import Section, TableBlock, headings


def test_what_a_table_leaves_out_is_told_below_its_title(capsys):
    cut = TableBlock(
        title="Warnings and errors",
        headings=headings("who", "lines"),
        rows=[["agent-01", 1]],
        note="The first 60 of 500.",
    )

    print_report(Console(), {"run": "0001-a"}, [Section(title="What was said", blocks=[cut])])

    lines = capsys.readouterr().out.splitlines()
    assert lines[lines.index("Warnings and errors") + 1] == "The first 60 of 500."


def test_what_a_chapter_says_before_its_tables_is_told(capsys):
    table = TableBlock(title="Slots", headings=headings("who", "error"), rows=[["agent-01", 1]])
    section = Section(title="Control", intro="Slots by truth.", blocks=[table])

    print_report(Console(), {"run": "0001-a"}, [section])

    lines = capsys.readouterr().out.splitlines()
    assert lines[lines.index("Control") + 1] == "Slots by truth."


def test_a_verdict_that_somebody_wrote_several_lines_into_is_one_line(capsys):
    print_report(Console(), {"run": "0001-a", "verdict": "FAILED\nPASSED\r\x1b[2J"}, [])

    assert capsys.readouterr().out.splitlines()[0] == r"0001-a: FAILED\nPASSED\r\x1b[2J"
