import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosmos_cli.errors import InputError
from cosmos_cli.models.document import dotted, read_document
from cosmos_cli.models.overrides import apply_overrides, parse_override
from cosmos_cli.models.yaml_source import YamlSource


def read(text):
    return read_document(YamlSource.of("a.yaml", text))


def faults_of(text):
    with pytest.raises(InputError) as caught:
        read(text)
    return [(fault.line, fault.column, fault.path, fault.text) for fault in caught.value.faults]


def test_duplicate_keys_are_all_named_with_their_first():
    text = "a: 1\nb: {c: 1, c: 2}\na: 3\n"

    assert faults_of(text) == [
        (2, 11, "b.c", "duplicate key; the first stands in line 2"),
        (3, 1, "a", "duplicate key; the first stands in line 1"),
    ]


def test_keys_that_are_no_text_are_refused():
    assert faults_of("1: a\n? [x]\n: b\n") == [
        (1, 1, "", "expected a text as key, got 1: put it in quotes"),
        (2, 3, "", "expected a text as key, got a list"),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a.yaml: expected a mapping, got an empty file"),
        ("# only a comment\n", "a.yaml: expected a mapping, got an empty file"),
        ("- a\n", "a.yaml:1:1: expected a mapping (key: value), got a list\n    - a\n    ^"),
        ("text\n", "a.yaml:1:1: expected a mapping (key: value), got 'text'\n    text\n    ^"),
    ],
)
def test_top_level_must_be_a_mapping(text, message):
    with pytest.raises(InputError) as caught:
        read(text)

    assert str(caught.value) == message


def test_aliases_and_merge_keys_are_unfolded_and_own_keys_win():
    document = read(
        "base: &base {x: 1, y: 2}\nmore: &more {y: 3, z: 4}\n"
        "use:\n  <<: [*base, *more]\n  x: 5\nagain: *base\n"
    )

    assert document.value["use"] == {"y": 2, "z": 4, "x": 5}
    assert document.value["again"] == {"x": 1, "y": 2}
    assert document.fault(("use", "x"), "").line == 5
    assert document.fault(("use", "z"), "").line == 2


def test_merge_of_something_else_is_refused():
    assert faults_of("a:\n  <<: 3\n") == [
        (2, 7, "a", "expected a mapping or a list of mappings after <<")
    ]


@pytest.mark.slow
def test_alias_bomb_is_refused():
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]

    ((_, _, _, text),) = faults_of("\n".join(lines))

    assert text == "expected at most 200000 values, aliases unfolded"


def test_missing_path_is_placed_at_the_key_above():
    fault = read("x: 1\nagents:\n  tick_hz: 3\n").fault(("agents", "count"), "missing")

    assert (fault.line, fault.column, fault.path) == (2, 1, "agents.count")


def apply(text, *overrides):
    document = read(text)
    faults = apply_overrides(document, overrides)
    return document, [fault.render() for fault in faults]


def test_overrides_replace_make_and_append():
    document, faults = apply(
        "a: {b: 1}\nl: [1, 2]\nn:\n",
        "a.b=2", "a.c.d=x", "l[0]=7", "l.2=8", "n.k=true", "m=[1, {z: 2}]", "m[1].z=3", "e=",
    )  # fmt: skip

    assert faults == []
    assert document.value == {
        "a": {"b": 2, "c": {"d": "x"}},
        "l": [7, 2, 8],
        "n": {"k": True},
        "m": [1, {"z": 3}],
        "e": None,
    }


def test_faults_below_an_override_name_the_option():
    document, _ = apply("a: {b: {c: 1}}\n", "a.b={c: 2}")

    assert document.fault(("a", "b", "c"), "wrong").render() == "--set a.b: a.b.c: wrong"
    assert document.fault(("a", "b"), "wrong").render() == "--set a.b: wrong"
    assert document.fault(("a",), "wrong").render().startswith("a.yaml:1:4: a: wrong")


@pytest.mark.parametrize(
    ("override", "path"),
    [
        ("x.b=1", ("x",)),
        ("a.y.z=1", ("a", "y")),
        ("l.0.k=1", ("l", 0)),
        ("a.m[0].k=1", ("a", "m")),
        ("a.m[0].k=1", ("a", "m", 0)),
    ],
)
def test_what_an_override_makes_on_its_way_has_its_place_there(override, path):
    """A section that --set misspells was blamed on the first line of a file that does not have it."""
    document, faults = apply("a: {b: 1}\nl: []\nn:\n", override, "n.k=1")

    assert faults == []
    for at_key in (True, False):
        assert document.fault(path, "", at_key=at_key).override == override.partition("=")[0]
    assert document.fault(("n",), "").line == 3


def test_override_that_would_be_dropped_is_refused():
    document, faults = apply("a: 1\n", "a=2", "a=3")

    assert document.value == {"a": 2}
    assert faults == ["--set a: is given twice, and only one could count"]


@pytest.mark.parametrize("text", [":", "@home", "a: b: c", "% done", "it's: x: y"])
def test_a_text_that_is_no_yaml_is_told_with_how_it_is_written(text):
    _, (fault,) = apply("d: x\n", f"d={text}")

    assert fault.startswith(f"--set d: expected a value, got {text!r}; write a text in quotes: ")
    (written,) = shlex.split(fault.partition("quotes: --set ")[2])
    assert apply("d: x\n", written)[0].value == {"d": text}


def test_all_bad_overrides_are_named():
    _, faults = apply(
        "l: [1]\ns: x\n",
        "novalue",
        "a..b=1",
        "=1",
        "l[5]=1",
        f"l[{'9' * 5000}]=1",
        "l.x=1",
        "l.²=1",
        "s.t=1",
        "q=[1",
        "q={a: 1, a: 2}",
    )

    assert faults == [
        "--set novalue: expected KEY=VALUE, such as agents.count=5",
        "--set a..b: expected a dotted path, such as agents.names[0]",
        "--set =1: expected a dotted path, such as agents.names[0]",
        "--set l[5]: l has 1 items: got the index 5",
        f"--set l[{'9' * 5000}]: expected a dotted path, such as agents.names[0]",
        "--set l.x: l is a list: expected an index, got x",
        "--set l.²: l is a list: expected an index, got ²",
        "--set s.t: s is 'x' and has nothing inside",
        "--set q: this list is never closed: expected ',' or ']'",
        "--set q: duplicate key; the first stands in line 1",
    ]


STEP = st.from_regex(r"[a-z_][a-z0-9_-]{0,8}", fullmatch=True) | st.integers(0, 50)


@given(head=st.from_regex(r"[a-z_]{1,8}", fullmatch=True), tail=st.lists(STEP, max_size=5))
def test_dotted_paths_are_read_back(head, tail):
    path = (head, *tail)

    assert parse_override(f"{dotted(path)}=1") == (dotted(path), path, 1)


@given(
    st.integers(-(2**63), 2**63 - 1)
    | st.booleans()
    | st.text("abcxyz -", min_size=1).map(lambda t: f'"{t}"')
)
def test_override_values_are_typed_as_in_the_file(value):
    text = str(value).lower() if isinstance(value, bool) else str(value)

    assert parse_override(f"k={text}")[2] == read(f"k: {text}").value["k"]
