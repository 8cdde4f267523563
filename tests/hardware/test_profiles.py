"""Profiles of outputs: what is due, replaced, overtaken, left and run out, by simulated time alone."""

from __future__ import annotations

import itertools
import math
from collections import Counter

import pytest

from madns_runtime.config import DeviceLaunch
from madns_runtime.errors import PluginError
from madns_runtime.hardware import profiles
from madns_runtime.hardware.contract import NAME_CHARACTERS_MAX, Channel
from madns_runtime.hardware.count_table import NAME_BYTES, NOT_FINITE, REST, missed_name
from madns_runtime.hardware.intake import FROZEN
from madns_runtime.hardware.kind_declaration import CHANNELS_MAX
from madns_runtime.hardware.outbox import USERS_NAMED_MAX
from madns_runtime.hardware.outputs import DeviceOutputs
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.profiles import (
    DECLINED,
    POINT_COUNTS,
    POINTS_MAX,
    UNDERRUNS,
    ChannelProfile,
    count_name,
    counts_by_channel,
    pack_points,
    unpack_points,
)

COIL = Channel(name="coil", direction="out", shape=(3,), limits=(-1.0, 1.0), safe=0.0)
LINE = Channel(name="line", direction="out", passing="queue")
BRAKE = Channel(name="brake", direction="out", safe=0.0, underrun="safe")


def profile_of(channel):
    counts = Counter()
    return ChannelProfile(channel, lambda word, number: counts.update({word: number})), counts


def popped(profile, now_s):
    found = []
    while (point := profile.pop_due(now_s)) is not None:
        found.append((point.t_s, point.numbers))
    return found


def ramp(first_s, count, step_s=0.1, scale=1.0):
    return [(first_s + k * step_s, (scale * k,)) for k in range(count)]


def test_each_point_is_due_at_its_own_time():
    profile, counts = profile_of(LINE)
    profile.replace(0.0, [(0.1, (1.0,)), (0.2, (2.0,))], now_s=0.0)

    assert popped(profile, 0.05) == []
    assert profile.next_s() == 0.1
    assert popped(profile, 0.1) == [(0.1, (1.0,))]
    assert popped(profile, 0.2) == [(0.2, (2.0,))]
    assert counts["points"] == 2
    assert counts["came_late"] == 0


def test_a_newer_profile_replaces_the_future_and_nothing_before_it():
    profile, counts = profile_of(LINE)
    profile.replace(0.0, ramp(0.0, 10), now_s=-1.0)
    profile.replace(0.45, [(0.5, (-5.0,)), (0.6, (-6.0,))], now_s=0.0)

    values = [value for _, (value,) in popped(profile, 0.65)]
    assert values == [0.0, 1.0, 2.0, 3.0, 4.0, -5.0, -6.0]
    assert counts["replaced"] == 5


def test_of_the_newest_alone_what_is_overtaken_is_skipped_and_counted():
    profile, counts = profile_of(COIL)
    points = [(k / 10, (k / 10, 0.0, 0.0)) for k in range(5)]
    held = profile.replace(0.0, [*points, (0.5, (7.0, 0.0, -7.0))], now_s=0.25)

    assert held == 1
    assert counts["came_late"] == 3
    assert popped(profile, 0.25) == [(0.2, (0.2, 0.0, 0.0))]
    assert counts["skipped"] == 2
    assert popped(profile, 0.5) == [(0.5, (1.0, 0.0, -1.0))]


def test_one_that_runs_out_is_told_once_and_holds_or_makes_safe_as_the_kind_says():
    for channel, numbers in ((LINE, ()), (BRAKE, (0.0,))):
        profile, counts = profile_of(channel)
        profile.replace(0.0, ramp(0.0, 3), now_s=0.0)
        popped(profile, 0.2)

        assert profile.next_s() == pytest.approx(0.3)
        [(t_s, left)] = popped(profile, 0.31)
        assert (t_s, left) == (pytest.approx(0.3), numbers)
        assert popped(profile, 5.0) == []
        assert profile.next_s() == math.inf
        profile.replace(5.0, ramp(5.0, 2), now_s=5.0)
        popped(profile, 9.0)
        assert counts["underruns"] == 2


def test_one_that_is_continued_in_time_or_ended_in_order_does_not_run_out():
    profile, counts = profile_of(LINE)
    profile.replace(0.0, ramp(0.0, 3), now_s=0.0)
    popped(profile, 0.25)
    profile.replace(0.3, ramp(0.3, 3), now_s=0.25)
    assert len(popped(profile, 0.35)) == 1
    profile.replace(0.45, (), now_s=0.35)

    assert len(popped(profile, 9.0)) == 1
    assert counts["underruns"] == 0
    assert counts["replaced"] == 1


def test_a_point_before_those_that_wait_and_one_too_many_are_refused_and_counted(monkeypatch):
    monkeypatch.setattr(profiles, "POINTS_MAX", 3)
    profile, counts = profile_of(LINE)
    profile.replace(0.0, ramp(0.0, 2), now_s=0.0)
    profile.replace(0.2, [(0.05, (0.0,)), (0.2, (0.0,)), (0.3, (0.0,))], now_s=0.0)

    assert (len(profile), counts["refused"]) == (3, 2)
    assert profile.clear() == 3


def test_points_travel_in_messages_of_a_bounded_size():
    points = [(k * 0.01, (k, -k, 0.5)) for k in range(5000)]
    packs = pack_points(COIL, points)

    assert max(8 * len(pack) for pack in packs) <= 48_000
    told = [point for pack in packs for point in unpack_points(COIL, pack.tobytes())]
    assert told == points


@pytest.mark.parametrize(
    ("points", "what"),
    [
        ([(0.0, (1, 2))], "expected 3 numbers, got 2"),
        ([(0.0, (1, 2, math.nan))], "expected numbers"),
        ([(0.2, (1, 2, 3)), (0.2, (1, 2, 3))], "in order of time"),
        ([(math.nan, (1, 2, 3))], "in order of time"),
        ([(k, (1, 2, 3)) for k in range(POINTS_MAX + 1)], "at most 10000 points"),
    ],
)
def test_what_is_no_profile_is_refused_where_it_is_handed_over(points, what):
    with pytest.raises(PluginError, match=what):
        pack_points(COIL, points)


def test_points_without_end_are_refused_after_as_many_as_there_may_be():
    taken = itertools.count()

    with pytest.raises(PluginError, match="at most 10000 points"):
        pack_points(
            LINE, ((float(k), 1.0) for k in itertools.takewhile(lambda k: k < 10**5, taken))
        )
    assert next(taken) <= POINTS_MAX + 1


def test_a_write_before_simulated_time_is_known_ends_a_profile_as_one_after_it():
    launch = DeviceLaunch(
        name="d", place="m", kind="null", base_directory="", rate_hz=10, owner="a", may_move=True
    )
    counts = Counter()
    outputs = DeviceOutputs(launch, [BRAKE], lambda *told: counts.update(dict([told])))
    [pack] = pack_points(BRAKE, ramp(0.0, 3))
    outputs.take_profile("a", "brake", 0.0, pack.tobytes(), t_s=math.nan)
    outputs.take_write("a", "brake", 0.5, 0.0, t_s=math.nan)

    assert [each.value for each in outputs.due(1.0, 1.0, float)] == [0.5]
    assert counts[count_name("replaced", "brake")] == 3


def test_bytes_that_are_no_points_are_refused():
    for data in (b"12345678", b"x" * 7):
        with pytest.raises(ValueError, match=r"no points|multiple"):
            list(unpack_points(COIL, data))


def test_counts_are_told_by_output():
    counts = {"samples": 7, "play:points:coil": 5, "play:late:coil": 2, "play:points:line": 1}
    told = counts_by_channel(counts)

    assert (told["coil"]["points"], told["coil"]["late"], told["coil"]["underruns"]) == (5, 2, 0)
    assert set(told) == {"coil", "line"}


def test_points_of_which_nothing_became_are_lost_with_the_process_that_had_them():
    ends = {"played": 2, "skipped": 3, "replaced": 4, "lost": 5, "unplayed": 6, DECLINED: 7}
    counts = {"points": 40, "refused": 8, **ends}

    told = counts_by_channel({count_name(word, "coil"): n for word, n in counts.items()})["coil"]

    assert (told["lost"], told["refused"]) == (18, 15)
    assert sum(told[word] for word in ends if word != DECLINED) + 7 == told["points"] == 40
    assert set(told) == {*POINT_COUNTS, UNDERRUNS}


def test_what_is_counted_of_the_longest_name_has_room_for_all_of_it():
    """What is cut off would tell the points of one output under several names, and none of them as late."""
    name = "a" * NAME_CHARACTERS_MAX
    assert Channel(name=name).faults() == [] != Channel(name=f"{name}a").faults()

    counted = [count_name(word, name) for word in (*POINT_COUNTS, UNDERRUNS, DECLINED)]

    assert max(map(len, (*counted, f"{FROZEN}{name}", f"{name}{NOT_FINITE}"))) <= NAME_BYTES


def test_a_device_of_as_many_outputs_as_there_may_be_has_each_count_of_each():
    counts = DevicePage(()).counts
    for number in range(USERS_NAMED_MAX):
        counts.add(missed_name(f"agent-{number:03d}"))
    for number in range(CHANNELS_MAX):
        counts.add(f"coil_{number}_limited")
        for word in (*POINT_COUNTS, UNDERRUNS, DECLINED):
            counts.add(count_name(word, f"coil_{number}"))

    told = counts.read()
    assert REST not in told
    assert set(counts_by_channel(told)) == {f"coil_{number}" for number in range(CHANNELS_MAX)}
    assert all(each["played"] == 1 for each in counts_by_channel(told).values())


def test_a_kind_that_makes_safe_needs_a_safe_value():
    channel = Channel(name="brake", direction="out", underrun="safe")
    assert channel.faults() == ["brake: underrun: safe needs a safe value of numbers"]
    assert BRAKE.faults() == []
