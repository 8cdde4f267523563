"""What drivers read, before anybody sees it: shapes, numbers that are none, what becomes the newest sample."""

import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from madns_runtime.errors import ConfigurationError, PluginError
from madns_runtime.hardware import page
from madns_runtime.hardware.contract import Channel, Sample
from madns_runtime.hardware.intake import Intake, least_stale_age_s
from madns_runtime.hardware.page import DevicePage
from madns_runtime.hardware.records import SimulatedTime
from madns_runtime.hardware.status import StatusLimits
from madns_runtime.hardware.values import to_numbers, to_output

NAN = float("nan")
FIELD = Channel(name="field", unit="T", shape=(3,))
LEVEL = Channel(name="level", unit="m")
ITSELF: list = []
ITSELF.append(ITSELF)


class Kept:
    """Records that are kept, of a run that began at 0 s of this machine's clock."""

    def __init__(self):
        self.samples, self.events = [], []
        self.time = SimulatedTime()
        self.time.set(0.0, 0.0, 1.0)

    def sample(self, channel, number, taken_s, values, *, told_s):
        self.samples.append((channel, number, tuple(values)))

    def event(self, event, now_s, **values):
        self.events.append((event, now_s, values.get("channel")))


def make_intake():
    kept, device_page = Kept(), DevicePage([FIELD, LEVEL])
    channels = (FIELD, LEVEL)
    return (
        Intake(channels, device_page, kept, seed=[1], frozen_s={}, pass_on=lambda message: 0),
        device_page,
        kept,
    )


@pytest.mark.parametrize(
    "value",
    [
        *("abc", b"abc", bytearray(b"abc"), {1.0, 2.0, 3.0}, {0: 1.0}, None, 1.0),
        *(["a", 1, 2], ["1", "2", "3"], [b"1", 2, 3], (10**400, 0, 0), ITSELF),
        *(np.array(["1", "2", "3"], dtype=kind) for kind in ("U", "S", "O")),
        np.array([1j, 2.0, 3.0]),
    ],
)
def test_what_is_no_vector_is_refused_by_its_channel(value):
    with pytest.raises(PluginError, match="field: expected 3 numbers, got "):
        to_numbers(FIELD, value)


@pytest.mark.parametrize(
    "value",
    [
        *("1.0", " 1_0 ", "nan", b"2", bytearray(b"2"), memoryview(b"2"), None, 1j, [1.0]),
        *(
            np.array("1"),
            np.array(b"1"),
            np.array("1", dtype=object),
            np.str_("1"),
            np.complex128(1),
        ),
    ],
)
def test_what_is_no_number_is_refused_by_its_channel_though_it_spells_one(value):
    with pytest.raises(PluginError, match="level: expected a number, got "):
        to_numbers(LEVEL, value)
    with pytest.raises(PluginError, match="level: expected a number, got "):
        to_output(LEVEL, value)


@pytest.mark.parametrize(
    "value", [2, 2.0, np.float32(2), np.int64(2), np.array(2.0), Fraction(2), Decimal(2)]
)
def test_numbers_of_any_type_are_numbers(value):
    assert to_numbers(LEVEL, value) == (2.0,)
    assert to_numbers(FIELD, [value] * 3) == (2.0, 2.0, 2.0)


def test_nested_rows_become_numbers_row_by_row():
    matrix = Channel(name="matrix", shape=(2, 2))

    assert to_numbers(matrix, [(1, 2), [3, 4]]) == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize(
    ("taken_s", "told_s"), [((), None), ((0.0, 2.0), 98.0), ((0.0, 99.95), None)]
)
def test_the_least_age_of_samples_is_told_where_each_was_stale_as_it_came(taken_s, told_s):
    intake, device_page, _ = make_intake()
    for each in taken_s:
        intake.take(Sample(values={"level": 1.0}, taken_s=each), 100.0)

    assert least_stale_age_s(device_page, StatusLimits.of(0.1, 1.0, 0.1)) == told_s


def test_a_sample_is_on_record_as_handed_over_when_agents_have_it_however_long_that_took():
    sent, told = [], {}
    line = Channel(name="line", is_frame=True, passing="queue")
    queued = Channel(name="queued", passing="queue")
    device_page = DevicePage([LEVEL, queued, line])

    class Told:
        def sample(self, channel, number, taken_s, values, *, told_s):
            told[channel] = told_s

    def handed_s(taken_up_s):
        assert sent or device_page.read("level").number  # agents have it already
        return taken_up_s + 0.3

    intake = Intake(
        (LEVEL, queued, line),
        device_page,
        Told(),
        seed=[1],
        frozen_s={},
        pass_on=lambda message: sent.append(message) or 0,
        handed_s=handed_s,
    )
    for name, value in (("level", 2.0), ("queued", 3.0), ("line", b"x")):
        sent.clear()
        intake.take(Sample(values={name: value}, taken_s=1.0), 1.1)

    assert told == pytest.approx({"level": 1.4, "queued": 1.4, "line": 1.4})


def test_a_sample_that_holds_no_number_is_on_record_and_no_newest_sample():
    intake, device_page, kept = make_intake()
    intake.take(Sample(values={"field": (1.0, 2.0, 3.0)}, taken_s=1.0), 1.0)
    intake.take(Sample(values={"field": (1.0, NAN, 3.0)}, taken_s=2.0), 2.0)

    assert device_page.header[page.NEWEST_S] == 1.0
    assert device_page.read("field").values == (1.0, 2.0, 3.0)
    assert [str(values) for _, _, values in kept.samples] == ["(1.0, 2.0, 3.0)", "(1.0, nan, 3.0)"]
    assert intake.summary()["field_not_finite"] == 1


def test_samples_without_a_value_are_counted_and_keep_no_device_of_inputs_fresh():
    intake, device_page, kept = make_intake()
    intake.take(Sample(values={"level": 1.0}, taken_s=1.0), 1.0)
    for second in (2.0, 3.0):
        intake.take(Sample(values={}, taken_s=second), second)

    header = device_page.header
    assert (header[page.NEWEST_S], header[page.ARRIVED_S], header[page.SAMPLES]) == (1.0, 1.0, 1)
    assert intake.summary()["empty_samples"] == 2
    assert kept.samples == [("level", 1, (1.0,))]


def test_a_device_of_outputs_alone_shows_by_a_sample_without_a_value_that_it_is_there():
    valve = Channel(name="valve", direction="out")
    device_page = DevicePage([valve])
    intake = Intake((valve,), device_page, Kept(), seed=[1], frozen_s={}, pass_on=len)
    intake.take(Sample(values={}, taken_s=2.0), 2.0)

    assert (device_page.header[page.ARRIVED_S], device_page.header[page.SAMPLES]) == (2.0, 1)
    assert "empty_samples" not in intake.summary()


def test_an_input_that_is_no_number_keeps_no_other_from_being_told():
    intake, device_page, _ = make_intake()
    intake.take(Sample(values={"field": (NAN,) * 3, "level": 4.0}, taken_s=2.0), 2.0)

    assert device_page.header[page.NEWEST_S] == 2.0
    assert device_page.read("level").values == (4.0,)


@pytest.mark.parametrize("number", [NAN, float("inf"), 10**400])
def test_a_driver_that_counts_what_is_no_number_is_refused_and_spoils_no_count(number):
    intake, _, _ = make_intake()
    intake.count("spikes", 2)
    with pytest.raises(PluginError, match="expected a name and a number to count, got 'spikes', "):
        intake.count("spikes", number)

    assert intake.summary()["spikes"] == 2


def test_a_driver_that_fills_one_buffer_again_and_again_alters_no_sample_that_a_fault_holds():
    told = {}
    for action, value in (("freeze", None), ("delay", 5.0)):
        intake, device_page, _ = make_intake()
        buffer = [1.0, 1.0, 1.0]
        if action == "delay":
            intake.insert_fault(action, value)
        intake.take(Sample(values={"field": buffer}, taken_s=0.0), 0.0)
        if action == "freeze":
            intake.insert_fault(action, value)
        buffer[:] = [2.0, 2.0, 2.0]
        intake.take(Sample(values={"field": buffer}, taken_s=1.0), 1.0)
        intake.tell_held(5.5)
        told[action] = device_page.read("field").values

    assert told == {"freeze": (1.0, 1.0, 1.0), "delay": (1.0, 1.0, 1.0)}


@pytest.mark.parametrize("action", ["delay", "drop", "freeze", "bias"])
def test_a_value_of_another_shape_is_refused_as_it_comes_whatever_fault_is_in_force(action):
    intake, _, kept = make_intake()
    intake.insert_fault(action, None if action == "freeze" else 1.0)
    with pytest.raises(PluginError, match="field: expected 3 numbers, got 'north'"):
        intake.take(Sample(values={"level": 1.0, "field": "north"}, taken_s=1.0), 1.0)
    intake.tell_held(9.0)

    assert kept.samples == []


LARGE = (pytest.param(10**400, id="10**400"), pytest.param(-(10**400), id="-10**400"))


@pytest.mark.parametrize("taken_s", [-1e300, -2e9, -math.inf, NAN, 11.0, "1", *LARGE])
def test_a_time_that_is_none_or_to_come_or_beyond_any_age_is_refused_and_reaches_nobody(taken_s):
    intake, device_page, kept = make_intake()
    with pytest.raises(PluginError, match="taken_s: expected a time until now, 10.0000"):
        intake.take(Sample(values={"level": 1.0}, taken_s=taken_s), 10.0)

    assert (device_page.read("level").number, kept.samples) == (0, [])


def test_samples_that_a_delay_holds_at_the_end_are_counted():
    intake, _, kept = make_intake()
    intake.insert_fault("delay", 5.0)
    for number in range(3):
        intake.take(Sample(values={"level": 1.0}, taken_s=float(number)), float(number))
    intake.close()

    assert kept.samples == []
    assert intake.summary()["delayed_left"] == 3


def test_frames_that_are_the_same_for_too_long_are_frozen_and_pass_a_fault_of_numbers():
    line = Channel(name="line", is_frame=True, passing="queue")
    kept, sent = Kept(), []
    intake = Intake(
        (line, LEVEL),
        DevicePage([line, LEVEL]),
        kept,
        seed=[1],
        frozen_s={"line": 2.0},
        pass_on=lambda message: sent.append(message[-1]) or 0,
    )
    intake.insert_fault("bias", 1.0)
    for second, data in enumerate([b"one", bytearray(b"two"), b"two", b"two", b"two", b"one"]):
        intake.take(Sample(values={"line": data}, taken_s=float(second)), float(second))

    assert sent == [b"one", b"two", b"two", b"two", b"two", b"one"]
    assert kept.events == [("frozen", 3.0, "line")]
    assert intake.summary()["frozen"] == {"line": 1}


@pytest.mark.parametrize("came_s", [0.0, 1.0, math.inf])
def test_an_input_that_does_not_come_while_others_do_is_frozen_once(came_s):
    kept, device_page = Kept(), DevicePage([FIELD, LEVEL])
    intake = Intake(
        (FIELD, LEVEL), device_page, kept, seed=[1], frozen_s={"field": 3.0}, pass_on=len
    )
    device_page.header[page.OPENED_S] = 1.0  # behind the begin of the run
    for second in range(1, 10):
        values = {"level": float(second)}
        if second == came_s:
            values["field"] = (1.0, 2.0, 3.0)
        intake.take(Sample(values=values, taken_s=float(second)), float(second))

    assert kept.events == [("frozen", 4.0, "field")]
    assert intake.summary()["frozen"] == {"field": 1}


@pytest.mark.parametrize(("begun_s", "frozen"), [(math.nan, 0), (8.0, 0), (6.0, 1)])
def test_time_before_the_run_and_after_it_freezes_no_input(begun_s, frozen):
    kept = Kept()
    kept.time.set(begun_s, 0.0, 1.0)
    kept.time.end_s = 4.0
    intake = Intake(
        (FIELD, LEVEL), DevicePage([FIELD]), kept, seed=[1], frozen_s={"level": 3.0}, pass_on=len
    )
    for second in (*range(10), *range(13, 20)):
        intake.take(Sample(values={"field": (float(second),) * 3}, taken_s=0.0), float(second))

    assert intake.summary()["frozen"] == {"level": frozen}


def test_frames_are_numbered_on_by_the_process_that_takes_the_place_of_another():
    line = Channel(name="line", is_frame=True, passing="queue")
    device_page, sent = DevicePage([LEVEL, line]), []
    for _ in range(2):
        intake = Intake(
            (line,),
            device_page,
            Kept(),
            seed=[1],
            frozen_s={},
            pass_on=lambda m: sent.append(m) or 0,
        )
        for _ in range(2):
            intake.take(Sample(values={"line": b"x"}, taken_s=1.0), 1.0)

    assert [number for _, _, number, *_ in sent] == [1, 2, 3, 4]


def test_a_sample_that_is_refused_is_not_counted_as_one():
    intake, _, _ = make_intake()
    with pytest.raises(PluginError, match="'depth', which is no input"):
        intake.take(Sample(values={"depth": 1.0}, taken_s=1.0), 1.0)

    assert intake.summary()["samples"] == 0


@pytest.mark.parametrize(("fault", "value"), [("clear", None), ("delay", 0.1)])
def test_samples_whose_delay_is_lifted_come_before_the_next_one(fault, value):
    intake, device_page, kept = make_intake()
    intake.faults.insert("delay", 0.5)
    for number in range(4):
        intake.take(Sample(values={"level": float(number)}, taken_s=0.1 * number), 0.1 * number)
    intake.faults.insert(fault, value)
    for number in (4, 5):
        intake.take(Sample(values={"level": float(number)}, taken_s=0.1 * number), 0.1 * number)
    intake.tell_held(1.0)

    assert [values for _, _, values in kept.samples] == [(float(number),) for number in range(6)]
    assert device_page.read("level").values == (5.0,)


@pytest.mark.parametrize("action", ["bias", "noise"])
def test_a_fault_of_numbers_is_refused_where_all_inputs_are_frames(action):
    line = Channel(name="received", is_frame=True, passing="queue")
    sent = Channel(name="duty", direction="out")
    intake = Intake((line, sent), DevicePage([line]), Kept(), seed=[1], frozen_s={}, pass_on=len)

    with pytest.raises(ConfigurationError, match=r"no input of numbers \(inputs: received\)"):
        intake.insert_fault(action, 1.0)

    intake.insert_fault("drop", 1.0)
    assert intake.faults.in_force == {"drop": 1.0}
    make_intake()[0].insert_fault(action, 1.0)
