"""Orders of a timeline to a device: an end that is repeated is carried out once."""

import pytest

from madns_runtime.hardware.fault_orders import CarriedOutEnds, timeline_order
from tests.hardware.bench import line_bench


def begin(number):
    return timeline_order(number, is_end=False)


def end(number):
    return timeline_order(number, is_end=True)


def test_each_order_has_a_number_of_its_own():
    assert len({order(number) for order in (begin, end) for number in range(100)}) == 200


def test_an_end_is_carried_out_once_and_anew_after_another_begin():
    ends = CarriedOutEnds()

    told = [ends.is_repeated(each) for each in (begin(0), end(0), end(0), begin(1), end(1), end(0))]
    anew = [ends.is_repeated(each) for each in (begin(0), end(0), end(0))]

    assert told == [False, False, True, False, False, True]
    assert anew == [False, False, True]


def test_an_end_whose_begin_went_to_another_process_is_carried_out():
    assert not CarriedOutEnds().is_repeated(end(7))


def test_orders_of_an_operator_are_carried_out_each_time():
    ends = CarriedOutEnds()

    assert [ends.is_repeated(1) for _ in range(3)] == [False] * 3


@pytest.mark.process
def test_an_end_that_an_agent_repeats_clears_no_fault_that_has_begun_since(tmp_path):
    with line_bench(tmp_path) as (bench, _):
        line = bench.hardware["line"]
        bench.until(lambda: line.status == "ok")
        faults = bench.manager._devices["pi22/line"].faults
        line.order_fault(begin(0), "freeze", None)
        bench.until(lambda: "freeze" in faults)
        line.order_fault(end(0), "clear", None)
        bench.until(lambda: not faults)
        bench.manager.insert_fault("pi22/line", "bias", 1e6)
        bench.until(lambda: line["time"].value > 1e6)
        line.order_fault(end(0), "clear", None)
        before = line["time"].number
        bench.until(lambda: line["time"].number > before + 10)
        assert line["time"].value > 1e6
        bench.close()
