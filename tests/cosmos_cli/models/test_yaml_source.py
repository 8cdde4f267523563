import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.errors import InputError
from cosmos_cli.models.document import read_document
from cosmos_cli.models.yaml_source import (
    DEPTH_MAX,
    YamlSource,
    compose,
    read_source,
    resolve_scalar,
    yaml_text,
)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("no", "no"),
        ("yes", "yes"),
        ("on", "on"),
        ("true", True),
        ("False", False),
        ("", None),
        ("~", None),
        ("null", None),
        ("nil", "nil"),
        ("12", 12),
        ("-12", -12),
        ("+7", 7),
        ("010", 10),
        ("0o10", 8),
        ("0xff", 255),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("12:30:00", "12:30:00"),
        ("2024-01-01", "2024-01-01"),
        ("1.5", 1.5),
        (".5", 0.5),
        ("1.", 1.0),
        ("1e-3", 1e-3),
        ("1.5E+2", 150.0),
        ("1e", "1e"),
        ("=", "="),
    ],
)
def test_scalars_follow_yaml_1_2(text, value):
    resolved = resolve_scalar(text)

    assert (resolved, type(resolved)) == (value, type(value))


@pytest.mark.parametrize(("text", "value"), [("1e3", 1000), ("4e6", 4_000_000), ("-2E+1", -20)])
def test_power_of_ten_is_a_whole_number(text, value):
    resolved = resolve_scalar(text)

    assert (resolved, type(resolved)) == (value, int)


@pytest.mark.parametrize("text", [".inf", "-.INF", ".nan", "1e999", "9" * 400])
def test_numbers_that_are_not_finite_or_too_long_are_refused(text):
    with pytest.raises(ValueError, match="expected a"):
        resolve_scalar(text)


@given(st.integers(-(2**63), 2**63 - 1))
def test_whole_numbers_come_back_as_they_were_written(number):
    assert resolve_scalar(str(number)) == number


@pytest.mark.parametrize(
    "text",
    [
        str(2**63),
        str(-(2**63) - 1),
        "0xffffffffffffffff",
        f"0o{2**63:o}",
        "9" * 300,
        f"0x{'f' * 298}",
    ],
)
def test_whole_numbers_beyond_64_bits_are_refused(text):
    with pytest.raises(ValueError, match=r"from -2\^63 to 2\^63 - 1, got .* such as 1e20"):
        resolve_scalar(text)


def test_whole_number_beyond_64_bits_is_told_at_its_place():
    document = read_document(YamlSource.of("a.yaml", "a:\n  b: [1, 99999999999999999999]\n"))

    assert [(fault.path, fault.line, fault.column) for fault in document.faults] == [
        ("a.b[1]", 2, 10)
    ]


@pytest.mark.parametrize("text", ["1e20", "100000000000000000000.0", "-3.5e300", "0." + "1" * 400])
def test_numbers_of_many_digits_that_are_not_whole_are_read(text):
    assert resolve_scalar(text) == float(text)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_come_back_as_they_were_written(number):
    assert math.isclose(float(resolve_scalar(repr(number))), number, rel_tol=0, abs_tol=0)


def fault_of(text):
    with pytest.raises(InputError) as caught:
        compose(YamlSource.of("a.yaml", text))
    (fault,) = caught.value.faults
    return fault


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("a: 'x\nb: 1\n", (1, 4), "this quoted text is never closed"),
        ('a: "x\n', (1, 4), "this quoted text is never closed"),
        ('a: "C:\\data"\n', (1, 7), "write \\\\ for a backslash itself"),
        ('a: "\\x4g"\n', (1, 7), "write \\\\ for a backslash itself"),
        ('a: "\\ud800"\n', (1, 7), "write \\\\ for a backslash itself"),
        ("a: 1\nb: [1,\nc: 2\n", (2, 4), "this list is never closed"),
        ('a: [x, "y" "z"]\n', (1, 12), "expected ',' or ']' before this"),
        ("a: {b: 1 c: 2}\n", (1, 11), "expected ',' or '}' before this"),
        ("a: [\n {b: 1}\n {b: 2}]\n", (1, 4), "never closed, or has no comma before line 3"),
        ("a: 'it's'\n", (1, 8), "behind a quoted text stands nothing more"),
        ("a:\n    b: 1\n  c: 2\n", (3, 3), "expected a key at the indentation of its neighbours"),
        ("a: {b: 1\n", (1, 4), "this mapping is never closed"),
        ("a:\n\tb: 1\n", (2, 1), "expected spaces, got a tab"),
        ("a: b: c\n", (1, 5), "a second ': ' on this line"),
        ("a: 1\n b: 2\n", (2, 3), "this key is indented further than line 1, whose value ends"),
        ("a:\n  b:3\n\n  c: 1\n", (2, 4), "expected a space behind this ':'"),
        ("a:\n  - b:3\n    c: 1\n", (2, 6), "expected a space behind this ':'"),
        ("a: 1\nb:3\nc: 1\n", (2, 2), "expected a space behind this ':'"),
        ("a: 1\nhttp://x\nc: 1\n", (2, 1), "expected `key: value`, got no ':' after the key"),
        ("a\n b: 2\n", (2, 3), "a key within the text above it: check the indentation"),
        ("a: 1\nbc\n", (2, 1), "expected `key: value`, got no ':' after the key"),
        ("a: [\n", (2, 1), "expected a value, or the bracket that closes what was opened before"),
        ("[ok] done\n", (1, 6), "more follows a value in quotes or brackets that ended before"),
        ("a: @x\n", (1, 4), "'@' cannot start a value: put it in quotes"),
        ("a: *x\n", (1, 4), "no anchor &x stands above"),
        ("a: &x [*x]\n", (1, 8), "no anchor &x stands above"),
        ("a: !thing 3\n", (1, 4), "expected a plain value, got the tag !thing"),
        ("a: !!python/object:os.x 3\n", (1, 4), "expected a plain value, got the tag !!python"),
        ("a: 1\n---\nb: 1\n", (2, 1), "expected one document, a second one starts here"),
        ("a: 1\nb: \x07\n", (2, 4), "got the control character U+0007"),
    ],
)
def test_faults_of_syntax_have_a_place_and_plain_words(text, place, message):
    fault = fault_of(text)

    assert (fault.line, fault.column) == place
    assert message in fault.text
    assert fault.file == "a.yaml"


@pytest.mark.parametrize(
    ("line", "column"),
    [
        ("{a: ${b}}", 5),
        ("[a, x${b}}", 6),
        ("{a: 'x ${b}', c: [1}", None),
        ("[x: y ${b}}", 7),
        ("[${b}}", 2),
        ("['a' ${b}}", None),
    ],
)
def test_a_variable_is_told_where_a_plain_text_of_a_flow_ends_at_its_brace(line, column):
    fault = fault_of(line)

    assert ("put ${...} in quotes" in fault.text) == (column is not None)
    assert column in (None, fault.column)


@pytest.mark.parametrize("filling", [" ", ":", "${", "a"])
def test_a_line_of_a_million_characters_with_a_fault_does_not_hang(filling):
    assert fault_of("a: [" + "," + filling * (1_000_000 // len(filling)) + "}\n").line == 1


@pytest.mark.parametrize("text", ["[" * 200_000, "- " * 5000, "{a: " * 3000])
def test_deep_nesting_is_refused_and_does_not_end_the_process(text):
    assert f"at most {DEPTH_MAX} levels" in fault_of(text).text


def test_explicit_tags_of_the_core_schema_are_understood():
    node = compose(YamlSource.of("a", "[!!str 3, !!int 3, !!float 3, ! 3]"))

    assert [item.value for item in node.value] == ["3", 3, 3.0, "3"]
    assert isinstance(node.value[2].value, float)


def test_empty_text_has_no_document():
    assert compose(YamlSource.of("a", "# nothing\n")) is None


@pytest.mark.parametrize("separator", ["\x85", "\u2028", "\u2029"])
def test_separators_of_yaml_1_1_end_no_line(separator):
    text = (
        f"a: 1  # one{separator}b: 2\nplain: x{separator}y\nquoted: 'x{separator} y'\nlast: .nan\n"
    )
    document = read_document(YamlSource.of("f", text))

    assert list(document.value) == ["a", "plain", "quoted", "last"]
    assert document.value["plain"] == f"x{separator}y"
    assert document.value["quoted"] == f"x{separator} y"
    assert [(each.line, each.source) for each in document.faults] == [(4, "last: .nan")]


def test_separators_are_read_beside_what_stands_for_them():
    text = "a: \ue000\u2028\ue001\x85\ue002\n"

    assert read_document(YamlSource.of("f", text)).value == {"a": text[3:-1]}


@pytest.mark.parametrize(
    ("text", "place"),
    [("[", (1, 2)), ("[\n", (2, 1)), ("a: 1\rb: \x07", (2, 4)), ("a\r\n\x07", (2, 1))],
)
def test_places_lie_within_the_text(text, place):
    fault = fault_of(text)

    assert (fault.line, fault.column) == place


@given(st.text(max_size=200) | st.text("[]{}:,-?&*!|>'\"%@#a \t\n\r\x07", max_size=30))
def test_any_text_is_read_or_refused_with_a_place(text):
    source = YamlSource.of("a.yaml", text)
    try:
        compose(source)
    except InputError as error:
        (fault,) = error.faults
        line = source.lines[fault.line - 1]
        assert (fault.file, fault.source) == ("a.yaml", line)
        assert 1 <= fault.column <= len(line) + 1


def whole_fault(path):
    with pytest.raises(InputError) as caught:
        read_source(path)
    return str(caught.value)


def test_missing_file_suggests_a_similar_one(tmp_path):
    (tmp_path / "iridium10.yaml").write_text("a: 1\n")

    message = whole_fault(tmp_path / "iridum10.yaml")

    assert message == (
        f"{tmp_path}/iridum10.yaml: no such file, did you mean {tmp_path}/iridium10.yaml?"
    )


def test_missing_folder_is_told_apart_from_nothing(tmp_path):
    assert whole_fault(tmp_path / "no" / "a.yaml") == f"{tmp_path}/no/a.yaml: no such file"


def test_folder_is_refused(tmp_path):
    assert whole_fault(tmp_path) == f"{tmp_path}: expected a file, got a folder"


def test_unreadable_file_says_why(tmp_path, monkeypatch):
    path = tmp_path / "a.yaml"
    path.write_text("a: 1\n")
    monkeypatch.setattr(os, "open", _deny)

    assert whole_fault(path) == f"{path}: cannot be read: Permission denied"


def _deny(*_arguments, **_options):
    raise PermissionError(13, "Permission denied")


def test_binary_file_is_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"PK\x03\x04\0\0")

    assert whole_fault(path) == f"{path}: expected UTF-8 text, got binary data"


@pytest.mark.parametrize("coding", ["utf-16", "utf-16-be"])
def test_file_of_another_coding_is_refused_with_its_cure(tmp_path, coding):
    path = tmp_path / "a.yaml"
    path.write_bytes("\ufeffa: 1\n".removeprefix("\ufeff" * (coding == "utf-16")).encode(coding))

    expected = "expected UTF-8 text, got UTF-16: save it as UTF-8 in your editor"
    assert whole_fault(path) == f"{path}: {expected}"


def test_other_encoding_is_refused_with_its_line(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes("a: 1\nb: größe\n".encode("latin-1"))

    assert whole_fault(path) == f"{path}: expected UTF-8 text, got byte 0xf6 in line 2"


def test_byte_order_mark_is_no_text(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")

    assert read_source(path).text == "a: 1\n"


def test_huge_file_is_refused(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_bytes(b"#" * (4 * 1024 * 1024 + 1))

    assert "expected at most 4194304 bytes" in whole_fault(path)


def test_scalar_without_a_value_does_not_stop_the_reading_of_the_rest():
    document = read_document(YamlSource.of("x", "a: &n .inf\nb: *n\nc: 3\n"))

    assert document.value == {"a": None, "b": None, "c": 3}
    assert [(f.line, f.column, f.path, f.text) for f in document.faults] == [
        (1, 4, "a", "expected a finite number, got .inf")
    ]


WRITTEN = (
    "1e5", "-4E+1", "0o17", "0x1f", "010", "12:30", "no", "yes", "null", "~", "", ".5", "5.", "+.inf", "1_000",
    "9" * 30, "a: b", "# a", "two\nlines", " ", "'", "=", "<<", "2026-11-26", "true", "1e400",
)  # fmt: skip


def test_what_is_written_is_read_as_the_same():
    values = {text: text for text in WRITTEN[:-1] if text not in ("", "<<")}
    value = {
        "texts": list(WRITTEN),
        "keys": values,
        "numbers": [0, -3, 1e5, 1e-7, 1e300, 0.1, 2**60, 4e6],
        "others": [True, None, [], {}],
    }

    assert read_document(YamlSource.of("a.yaml", yaml_text(value))).value == value


def test_separators_that_are_written_are_read_as_themselves():
    value = {"a\u2028b": ["x\x85 y", "\u2029", "l\u2028\n  m"]}

    assert read_document(YamlSource.of("f", yaml_text(value))).value == value


@given(st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=12))
def test_any_text_that_is_written_is_read_as_itself(text):
    value = {"text": text}

    assert read_document(YamlSource.of("a.yaml", yaml_text(value))).value == value
