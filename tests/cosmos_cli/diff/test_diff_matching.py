import json
from dataclasses import replace

import numpy as np
import pytest

from cosmos_cli.diff.compare import differing_keys
from cosmos_cli.diff.fields import FieldDifference
from cosmos_cli.diff.stream import choose_pairing
from madns_runtime.analysis.matching import Rows, match, pair_up
from madns_runtime.recording.reader import read_columns
from madns_runtime.recording.records import Field

TICK = Field("tick", "", "int")
TIME = Field("t_s", "s")
AGENT = Field("agent", "", "str")


def rows(keys, who=None, **columns):
    keys = np.array(keys, dtype=np.float64)
    who = np.zeros(len(keys), np.int8) if who is None else np.array(who, dtype=object)
    return Rows(keys=keys, who=who, columns={n: np.array(v) for n, v in columns.items()})


def batches(keys, size):
    keys = list(keys)
    for start in range(0, len(keys), size):
        part = keys[start : start + size]
        yield rows(part, value=part)


def settled(pieces):
    pieces = list(pieces)
    joined = {}
    for name in ("a", "b", "only_a", "only_b"):
        joined[name] = np.concatenate([getattr(piece, name).keys for piece in pieces]).tolist()
    return joined


def test_records_of_one_tick_are_pairs_and_the_others_are_alone():
    found = settled(match([rows([0, 1, 2, 4])], [rows([1, 2, 3, 4])], tolerance=0.25))

    assert found == {"a": [1, 2, 4], "b": [1, 2, 4], "only_a": [0], "only_b": [3]}


def test_nearest_in_time_are_pairs_within_the_tolerance():
    found = settled(match([rows([0.0, 1.0, 2.0])], [rows([0.04, 0.96, 1.01, 2.2])], tolerance=0.05))

    assert (found["a"], found["b"]) == ([0.0, 1.0], [0.04, 1.01])
    assert (found["only_a"], found["only_b"]) == ([2.0], [0.96, 2.2])


def test_records_about_others_are_never_pairs():
    a, b = rows([5, 5], who=["x", "y"]), rows([5, 5, 5], who=["z", "y", "x"])

    assert [index.tolist() for index in pair_up(a, b, 0.25)] == [[0, 1], [2, 1]]


def test_several_records_of_one_tick_are_paired_in_their_order():
    assert [i.tolist() for i in pair_up(rows([7, 7, 7]), rows([7, 7]), 0.25)] == [[0, 1], [0, 1]]


def test_records_of_one_time_are_paired_by_their_numbers_in_whatever_order_they_were_recorded():
    number, commanded = Field("number", "", "int"), Field("commanded_s", "s")
    pairing = choose_pairing([commanded, AGENT, number], [commanded, AGENT, number], (10.0, 10.0))
    early, late = rows([7, 7, 8, 7]), rows([7, 7, 7, 8])
    a = replace(early, ranks=np.array([1.0, 3.0, 4.0, 2.0]))
    b = replace(late, ranks=np.array([1.0, 2.0, 3.0, 4.0]))

    [found] = match([a.take(np.array([0, 1])), a.take(np.array([2, 3]))], [b], tolerance=0.05)

    assert pairing.rank == "number"
    assert found.a.ranks.tolist() == found.b.ranks.tolist()
    assert sorted(found.a.ranks.tolist()) == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("far", [1e18, 1e300, 1.7e308, -1.7e308])
@pytest.mark.parametrize("count", [1, 4])
def test_one_key_that_is_far_away_costs_no_other_its_partner(far, count):
    """A time that diverged, or that stands for never, leaves the others no room on one line."""
    keys = [*np.linspace(0.0, 9.0, 91), far]
    who = ["abcd"[place % count] for place in range(len(keys))]

    same = [index.tolist() for index in pair_up(rows(keys, who), rows(keys, who), 0.05)]
    others = pair_up(rows([0.0, far, 0.0, far], [*"aabb"]), rows([5.0, 50.0], [*"ab"]), 0.05)

    assert same == [list(range(len(keys)))] * 2
    assert [index.tolist() for index in others] == [[], []]


def test_key_that_is_no_number_has_no_partner():
    found = settled(match([rows([0, np.nan, 2])], [rows([0, np.nan, 2])], tolerance=0.25))

    assert found["a"] == [0, 2]
    assert len(found["only_a"]) == len(found["only_b"]) == 1


@pytest.mark.parametrize(("size_a", "size_b"), [(7, 7), (1, 50), (50, 3), (1000, 1000)])
def test_how_records_come_in_batches_changes_nothing(size_a, size_b):
    random = np.random.default_rng(3)
    a = np.flatnonzero(random.random(600) < 0.8)
    b = np.flatnonzero(random.random(600) < 0.8) + random.uniform(-0.1, 0.1)

    found = settled(match(batches(a, size_a), batches(b, size_b), tolerance=0.25))

    common = sorted(set(a) & set(np.round(b).astype(int)))
    assert found["a"] == common
    assert sorted(found["only_a"]) == sorted(set(a) - set(common))
    assert len(found["b"]) + len(found["only_b"]) == len(b)


def test_a_nearer_record_of_a_later_batch_is_waited_for():
    a = [rows([1.0]), rows([2.0])]
    b = [rows([0.6]), rows([1.1]), rows([2.0])]

    found = settled(match(a, b, tolerance=0.5))

    assert (found["a"], found["b"], found["only_b"]) == ([1.0, 2.0], [1.1, 2.0], [0.6])


def test_a_record_waits_with_the_partner_that_it_has_found():
    a = [rows([1.0]), rows([1.7]), rows([9.0])]
    b = [rows([1.3]), rows([3.0]), rows([9.0])]

    found = settled(match(a, b, tolerance=0.5))

    assert (found["a"], found["b"]) == ([1.0, 9.0], [1.3, 9.0])
    assert (found["only_a"], found["only_b"]) == ([1.7], [3.0])


def test_huge_streams_are_held_in_small_part():
    count, size, read, done, held = 200_000, 1000, 0, 0, []

    def counted(keys):
        nonlocal read
        for batch in batches(keys, size):
            read += len(batch)
            yield batch

    # Twice as many in the second: it must wait for the first, not run ahead of it.
    for piece in match(counted(range(0, 2 * count, 2)), counted(range(2 * count)), tolerance=0.25):
        done += sum(map(len, (piece.a, piece.b, piece.only_a, piece.only_b)))
        held.append(read - done)

    assert done == read == 3 * count
    assert max(held) <= 6 * size


def test_a_stream_that_starts_late_does_not_pile_up_the_other():
    read, done, held = 0, 0, []

    def counted(keys):
        nonlocal read
        for batch in batches(keys, 100):
            read += len(batch)
            yield batch

    for piece in match(counted(range(20_000)), counted(range(19_900, 20_000)), tolerance=0.25):
        done += sum(map(len, (piece.a, piece.b, piece.only_a, piece.only_b)))
        held.append(read - done)

    assert done == 20_100
    assert max(held) <= 400


def test_angles_differ_by_the_shorter_way_round():
    found = FieldDifference(Field("raan_deg", "deg"))

    found.add(rows([0, 1], raan_deg=[359.9, 10.0]), rows([0, 1], raan_deg=[0.1, 10.0]))

    assert found.max == pytest.approx(0.2)
    assert found.rms == pytest.approx(0.2 / np.sqrt(2))
    assert found.different == 1


def test_a_value_that_one_lacks_is_a_difference_without_a_size():
    found = FieldDifference(Field("x_m", "m"))

    found.add(rows([0, 1, 2], x_m=[1.0, np.nan, np.nan]), rows([0, 1, 2], x_m=[1.0, 5.0, np.nan]))

    assert (found.different, found.null_in_one, found.max, found.compared) == (1, 1, 0.0, 1)
    assert found.first.key == 1


@pytest.mark.parametrize("kind", [np.int64, object])
def test_whole_numbers_that_no_float_can_hold_differ_by_their_last_digit(kind):
    found = FieldDifference(Field("time_ns", "ns", "int"))
    first = np.array([1_764_000_000_000_000_001, 2, 2**63 - 1], dtype=kind)
    second = np.array([1_764_000_000_000_000_002, 2, 2**63 - 1], dtype=kind)

    found.add(rows([0, 1, 2], time_ns=first), rows([0, 1, 2], time_ns=second))

    assert (found.different, found.max, found.at.key) == (1, 1.0, 0.0)
    assert found.values == (1_764_000_000_000_000_001, 1_764_000_000_000_000_002)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_run_that_diverged_differs_without_a_root_mean_square():
    found = FieldDifference(Field("x_m", "m"))

    found.add(rows([0, 1], x_m=[1e300, 1.0]), rows([0, 1], x_m=[1.0, 1.0]))

    assert (found.different, found.max) == (1, 1e300)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_runs_that_diverged_to_either_side_cost_no_warning_of_our_source():
    found = FieldDifference(Field("x_m", "m"))

    found.add(rows([0], x_m=[1.7e308]), rows([0], x_m=[-1.7e308]))

    assert (found.different, found.max) == (1, float("inf"))


def test_an_angle_that_diverged_is_not_the_same_by_whole_turns():
    found = FieldDifference(Field("slot_error_deg", "deg"))

    found.add(rows([0, 1], slot_error_deg=[0.1, 360.1]), rows([0, 1], slot_error_deg=[1e200, 0.1]))

    assert (found.different, found.max) == (1, 1e200)


def test_whole_numbers_far_apart_differ_by_what_lies_between():
    found = FieldDifference(Field("n", "", "int"))

    found.add(rows([0], n=[-(2**63)]), rows([0], n=[2**63 - 1]))

    assert found.max == 2.0**64


@pytest.mark.parametrize(
    ("kind", "left", "right", "expected"),
    [
        ("str", '{"on": 1}', '{"on": true}', 1),
        ("str", "[1]", "[1.0]", 1),
        ("str", '{"a": 1, "b": 2}', '{"b": 2, "a": 1}', 1),
        ("str", "[1]", "[1]", 0),
        ("str", [1, 2], "[1, 2]", 0),  # what is no text is one in a table
        ("json", {"on": 1}, {"on": True}, 1),
        ("json", [0, "a"], [False, "a"], 1),
        ("json", '{"on": 1}', '{"on": true}', 1),
        ("json", {"x": 1, "y": [2.0]}, '{"y": [2], "x": 1.0}', 0),
        ("json", 2**53 + 1, float(2**53), 1),
        ("json", 1.5, "1.5", 0),
        ("json", True, "true", 0),
        ("json", "word", "word", 0),
        ("json", "word", "other", 1),
        ("json", None, "null", 1),
        ("json", None, None, 0),
        ("json", float("inf"), "Infinity", 0),
        ("bool", True, True, 0),
        ("bool", True, False, 1),
        ("bool", True, 1, 1),
        ("bool", None, False, 1),
    ],
)
def test_values_that_are_no_numbers_are_the_same_as_their_kind_says(kind, left, right, expected):
    found = FieldDifference(Field("value", "", kind))
    sides = []
    for value in (left, right):
        column = np.empty(1, dtype=object)
        column[:] = [value]
        sides.append(Rows(keys=np.zeros(1), who=np.zeros(1), columns={"value": column}))

    found.add(*sides)

    assert found.different == expected


@pytest.mark.parametrize("kind", ["str", "json"])
def test_texts_nested_too_deep_to_be_read_differ(kind):
    found = FieldDifference(Field("value", "", kind))

    found.add(rows([0, 1], value=["[" * 5000, "["]), rows([0, 1], value=["[" * 5001, "["]))

    assert found.different == 1


def test_values_of_streams_that_are_nested_deeper_than_python_goes_differ_and_are_not_shown(
    tmp_path,
):
    sides = []
    for name, inner in (("a", "1"), ("b", "2")):
        path = tmp_path / name / "tree.jsonl"
        path.parent.mkdir()
        fields = [{"name": "value", "unit": "", "kind": "json"}]
        header = {"schema": 1, "stream": "tree", "shape": "array", "fields": fields}
        path.write_text(f"{json.dumps(header)}\n[{'[' * 1000}{inner}{']' * 1000}]\n")
        sides.append(read_columns(path))
    found = FieldDifference(Field("value", "", "json"))

    found.add(*(Rows(keys=np.zeros(1), who=np.zeros(1), columns=columns) for columns in sides))

    assert found.different == 1
    assert found.values == ("nested too deep to be shown",) * 2


def test_json_of_a_table_and_of_a_line_is_the_same():
    found = FieldDifference(Field("details", "", "json"))
    line, table = np.empty(2, dtype=object), np.empty(2, dtype=object)
    line[:] = [{"a": [1, 2]}, {"a": 1}]
    table[:] = ['{"a": [1, 2]}', '{"a": 2}']

    found.add(
        Rows(keys=np.arange(2.0), who=np.zeros(2), columns={"details": line}),
        Rows(keys=np.arange(2.0), who=np.zeros(2), columns={"details": table}),
    )

    assert found.different == 1
    assert found.at.key == 1


def test_records_are_paired_by_tick_by_time_or_by_their_order():
    same, other = (10.0, 10.0), (10.0, 5.0)

    by_tick = choose_pairing([TICK, TIME], [TICK, TIME], same)
    by_instant = choose_pairing([TICK], [TICK], other)
    by_time = choose_pairing([TIME, AGENT], [TIME, AGENT], same)
    by_order = choose_pairing([Field("value")], [Field("value")], same)

    assert (by_tick.by, by_tick.column) == ("tick", "tick")
    assert (by_instant.by, by_instant.scales) == ("time", (0.1, 0.2))
    assert (by_time.by, by_time.tolerance, by_time.identity) == ("time", 0.05, ("agent",))
    assert by_order.by == "order"
    words = [Field("tick", "", "str"), Field("t_s", "", "json"), Field("value")]
    assert choose_pairing(words, words, same).by == "order"
    assert choose_pairing([TICK], words, same).by == "tick"


def test_a_packet_counts_as_a_tick_only_where_nothing_tells_the_time():
    packet, sent = Field("packet", "", "int"), Field("sent_s", "s")

    without = choose_pairing([packet], [packet], (10.0, 10.0))
    timed = choose_pairing([packet, sent, AGENT], [packet, sent, AGENT], (10.0, 5.0))
    ticked = choose_pairing([packet, sent, TICK], [packet, sent, TICK], (10.0, 10.0))

    assert (without.by, without.column) == ("tick", "packet")
    assert (timed.by, timed.column, timed.scales) == ("time", "sent_s", (1.0, 1.0))
    assert (ticked.by, ticked.column) == ("tick", "tick")


def test_settings_differ_by_dotted_key():
    a = {"seed": 1, "run": "x", "agents": {"count": 2}, "stations": [{"name": "S", "h": 1}]}
    b = {"seed": 1, "run": "y", "agents": {"count": 3}, "stations": [{"name": "S", "h": 2}], "n": 0}

    found = [(one.key, one.a, one.b) for one in differing_keys(a, b, without=("run",))]

    assert found == [("agents.count", 2, 3), ("stations[0].h", 1, 2), ("n", None, 0)]


def test_a_mapping_against_null_is_told_by_its_keys_alone():
    a, b = {"thruster": {"isp_s": 220.0, "thrust_n": None}}, {"thruster": None}

    assert [(one.key, one.a, one.b) for one in differing_keys(a, b)] == [
        ("thruster.isp_s", 220.0, None)
    ]


def test_first_different_text_is_kept_with_its_place():
    found = FieldDifference(Field("outcome", "", "str"))

    for start in (0, 2):
        keys = [start, start + 1]
        found.add(
            rows(keys, outcome=["delivered", "delivered"]),
            rows(keys, outcome=["delivered", "lost"]),
        )

    assert (found.different, found.values, found.at.key) == (2, ("delivered", "lost"), 1.0)


@pytest.mark.parametrize("order", [(7, 3), (3, 7)])
def test_first_different_text_of_several_sources_is_the_first_of_all(order):
    total = FieldDifference(Field("outcome", "", "str"))

    for key in order:
        own = FieldDifference(Field("outcome", "", "str"))
        own.add(rows([key], outcome=["delivered"]), rows([key], outcome=[f"lost-{key}"]))
        total.merge(own, f"agent-{key}")

    assert (total.at, total.values) == (total.first, ("delivered", "lost-3"))
    assert (total.at.key, total.at.who) == (3.0, "agent-3")
