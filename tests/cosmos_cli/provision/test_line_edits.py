"""A line in a file: there or not, and everything else byte for byte as it was."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.onboard.files import edited


@pytest.mark.parametrize(
    ("before", "line", "regexp", "after"),
    [
        ("", "x=1", None, "x=1\n"),
        ("a\n", "x=1", None, "a\nx=1\n"),
        ("a", "x=1", None, "a\nx=1\n"),
        ("a\n\n", "x=1", None, "a\n\nx=1\n"),
        ("a\nx=1\nb\n", "x=1", None, "a\nx=1\nb\n"),
        ("a\nx=1", "x=1", None, "a\nx=1"),
        (" x=1\n", "x=1", None, " x=1\nx=1\n"),
        ("a\r\nb\r\n", "x=1", None, "a\r\nb\r\nx=1\r\n"),
        ("a\r\nb", "x=1", None, "a\r\nb\r\nx=1\r\n"),
        ("a\r\nx=1\r\n", "x=1", None, "a\r\nx=1\r\n"),
        ("#x=0\nb\n", "x=1", "^#?x=", "x=1\nb\n"),
        ("x=0\nx=2\nb\n", "x=1", "^x=", "x=0\nx=1\nb\n"),
        ("x=0\r\nb\r\n", "x=1", "^x=", "x=1\r\nb\r\n"),
        ("x=0", "x=1", "^x=", "x=1"),
        ("b\n", "x=1", "^x=", "b\nx=1\n"),
        ("caf\udce9\n", "x=1", None, "caf\udce9\nx=1\n"),
        ("a\x0bb\x85c\n", "c", None, "a\x0bb\x85c\nc\n"),
    ],
)
def test_line_is_there(before, line, regexp, after):
    assert edited(before, line=line, regexp=regexp, is_present=True) == after


@pytest.mark.parametrize(
    ("before", "line", "regexp", "after"),
    [
        ("", "x=1", None, ""),
        ("a\nx=1\nb\nx=1\n", "x=1", None, "a\nb\n"),
        ("a\nx=1", "x=1", None, "a\n"),
        ("x=1", "x=1", None, ""),
        ("a\r\nx=1\r\n", "x=1", None, "a\r\n"),
        ("#x=0\nx=1\nb\n", None, "^#?x=", "b\n"),
        ("a\n\nb\n", None, "^$", "a\nb\n"),
        ("a\n", None, "^$", "a\n"),
    ],
)
def test_line_is_not_there(before, line, regexp, after):
    assert edited(before, line=line, regexp=regexp, is_present=False) == after


contents = st.text(alphabet="ab=#\r\n", max_size=30)


@given(contents, st.sampled_from(["a=1", "b"]), st.sampled_from([None, "^#?[ab]"]), st.booleans())
def test_second_edit_changes_nothing(content, line, regexp, is_present):
    wanted = {"line": line, "regexp": regexp, "is_present": is_present}
    if not is_present and regexp is not None:
        wanted["line"] = None

    once = edited(content, **wanted)

    assert edited(once, **wanted) == once


@given(contents, st.sampled_from(["a=1", "b"]))
def test_line_that_was_added_can_be_removed_again(content, line):
    lines = content.split("\n")
    if line in [each.rstrip("\r") for each in lines] or "\r" in content:
        return
    with_line = edited(content, line=line, regexp=None, is_present=True)

    without = edited(with_line, line=line, regexp=None, is_present=False)

    assert without in (content, content + "\n")
