import json
import math

import pytest

from cosmos_cli.launch.feasibility import Resources, finite, judge, wire_bytes
from madns_runtime.plugin.api import Demand, Flow
from madns_runtime.protocol.datagram import FRAGMENT_BYTES_MAX

STATES_BYTES = 100 * 6 * 64 // 8
"""S_b of the thesis's table 2.2: 100 x 6 x 64 bits. Table 2.3 lists the same thing as 38,400 bytes."""
GIGABIT_BYTES_S = 1e9 / 8
HEADERS = 1400 - FRAGMENT_BYTES_MAX + 28
"""Seal and frame of a datagram of 1400 bytes, and IP and UDP around it."""


def demand(**changes):
    """The thesis's table 2.2 and 2.3."""
    values = {
        "flows": (
            Flow(name="state updates", message_bytes=STATES_BYTES, rate_hz=0.2),
            Flow(name="status", message_bytes=4000, rate_hz=0.07),
            Flow(name="time updates", message_bytes=200, rate_hz=10),
            Flow(name="hardware", message_bytes=740, rate_hz=10),
        ),
        "buffer_s": 10.0,
        "batch_bytes": STATES_BYTES,
        "batch_compute_s": 0.04,
        "sync_bytes": STATES_BYTES,
        "sync_compute_s": 0.04,
        "sync_rate_hz": 1.0,
        "lead_s": 3.0,
        "measured": False,
    }
    return Demand(**(values | changes))


def resources(**changes):
    values = {"workers": 1, "bandwidth_bytes_s": GIGABIT_BYTES_S, "latency_s": 0.001}
    return Resources(**(values | changes))


def inequality(number, *, agents=10, tick_hz=10.0, asked=None, offered=None):
    result = judge(asked or demand(), offered or resources(), agents=agents, tick_hz=tick_hz)
    return next(item for item in result.inequalities if item.number == number)


def test_thesis_2_11_asynchronous_is_0_401_of_10_s():
    item = inequality("2.7")

    assert item.left == pytest.approx(0.401)
    assert (item.relation, item.right) == ("<=", 10.0)
    assert item.margin == pytest.approx(9.599)


def test_thesis_asynchronous_limit_is_250_by_its_own_numbers():
    # The thesis says 240; (10 - 0.001) / 0.04 = 249.975, so 249 still fit.
    assert inequality("2.7").breaks_at == 250
    assert inequality("2.7", agents=249).holds
    assert not inequality("2.7", agents=250).holds


def test_thesis_2_12_one_synchronous_batch_takes_0_042_s():
    one = resources(maneuvers_at_once=1)

    item = inequality("2.8", offered=one, asked=demand(lead_s=0.1))

    assert item.left == pytest.approx(0.042)
    assert item.holds
    assert item.breaks_at == math.inf


def test_thesis_synchronous_limit_with_all_agents_at_once_is_near_its_71():
    # The thesis multiplies the way there and back too: 3 / 0.042 = 71.4. Latencies overlap, so 74 fit.
    assert inequality("2.8").breaks_at == 75
    assert inequality("2.8", agents=74).holds
    assert not inequality("2.8", agents=75).holds


def test_thesis_2_13_lead_of_3_s_exceeds_a_tick():
    item = inequality("2.9")

    assert (item.left, item.relation, item.right) == (3.0, ">=", 0.1)
    assert item.holds
    assert item.breaks_at == math.inf


def test_lead_shorter_than_a_tick_fails_for_any_number_of_agents():
    item = inequality("2.9", asked=demand(lead_s=0.05))

    assert not item.holds
    assert item.margin == pytest.approx(-0.05)
    assert item.breaks_at == 1


def test_thesis_2_14_is_a_count_of_bytes_with_table_2_3s_size():
    # 10 agents x (38,400 state + 4,000 status + 38,400 maneuver) = 8.08e5: the thesis's 8.1e5 "bits"
    # are bytes, so that its limit of 12,200 agents is eight times too high even at 38,400 bytes.
    assert pytest.approx(8.1e5, rel=3e-3) == 10 * (38_400 + 4_000 + 38_400)
    # Table 2.2's 100 x 6 x 64 bits are an eighth of that.
    assert STATES_BYTES == 4800


def test_bandwidth_counts_rates_maneuvers_and_all_headers():
    item = inequality("2.10")

    each = (
        0.2 * (4800 + 4 * HEADERS)
        + 0.07 * (4000 + 4 * HEADERS)
        + 10 * (200 + HEADERS)
        + 10 * (740 + HEADERS)
        + 1.0 * (4800 + 4 * HEADERS)
    )
    assert item.left == pytest.approx(10 * each)
    assert item.right == GIGABIT_BYTES_S
    assert item.breaks_at == math.floor(GIGABIT_BYTES_S / each) + 1


def test_thesis_1000_agents_fit_with_45_s_lead_and_five_workers():
    result = judge(demand(lead_s=45.0), resources(workers=5), agents=1000, tick_hz=10.0)

    assert result.holds


def test_workers_take_maneuvers_in_rounds():
    # 2 workers do 75 at once in 38 rounds of 40 ms.
    item = inequality("2.8", agents=75, offered=resources(workers=2))

    assert item.left == pytest.approx(38 * 0.04 + 0.002)
    assert item.breaks_at == 149


def test_measured_work_runs_on_no_more_workers_than_there_are_processors():
    offered = resources(workers=64, processors=2)

    measured = judge(demand(measured=True), offered, agents=75, tick_hz=10.0)
    declared = judge(demand(measured=False), offered, agents=75, tick_hz=10.0)

    assert (measured.workers, declared.workers) == (2, 64)
    assert [item.left for item in measured.inequalities[:2]] == [
        pytest.approx(75 * 0.04 / 2 + 0.001),
        pytest.approx(38 * 0.04 + 0.002),
    ]
    assert measured.inequalities[1].breaks_at == 149
    assert declared.inequalities[1].left == pytest.approx(2 * 0.04 + 0.002)
    assert measured.to_mapping()["workers"] == 2


def test_binding_is_the_one_that_breaks_at_the_fewest_agents():
    assert judge(demand(), resources(), agents=10, tick_hz=10.0).binding.number == "2.8"


def test_binding_is_a_broken_one_if_there_is_one():
    result = judge(demand(lead_s=0.05), resources(), agents=1, tick_hz=10.0)

    assert result.binding.number == "2.9"
    assert not result.holds


def test_simulation_without_needs_never_breaks_and_gives_valid_json():
    idle = demand(
        flows=(), buffer_s=math.inf, batch_compute_s=0.0, sync_bytes=0, sync_compute_s=0.0,
        sync_rate_hz=0.0, lead_s=math.inf,
    )  # fmt: skip

    result = judge(idle, resources(), agents=5000, tick_hz=100.0)

    assert result.holds
    text = json.dumps(result.to_mapping(), allow_nan=False)
    assert [item["breaks_at_agents"] for item in json.loads(text)["inequalities"]] == [None] * 4


@pytest.mark.parametrize("number", ["2.7", "2.8", "2.10"])
@pytest.mark.parametrize("workers", [1, 2, 3, 7])
def test_breaks_at_is_where_it_first_does_not_hold(number, workers):
    offered = resources(workers=workers, bandwidth_bytes_s=1e6)

    limit = int(inequality(number, offered=offered).breaks_at)

    assert inequality(number, agents=limit - 1, offered=offered).holds
    assert not inequality(number, agents=limit, offered=offered).holds


@pytest.mark.parametrize(
    ("number", "allowed_s", "offered", "breaks_at"),
    [
        ("2.7", 0.3, {"latency_s": 0.0, "workers": 1}, 4),
        ("2.7", 0.3, {"latency_s": 0.1, "workers": 3}, 7),
        ("2.7", 1.001, {"latency_s": 0.001, "workers": 1}, 11),
        ("2.8", 0.3, {"latency_s": 0.0, "workers": 3}, 10),
        ("2.8", 0.7, {"latency_s": 0.1, "workers": 1}, 6),
        ("2.8", 1.001, {"latency_s": 0.0005, "workers": 7}, 71),
    ],
)
def test_sides_that_are_equal_but_for_rounding_hold(number, allowed_s, offered, breaks_at):
    # Decimals as people type them: none of these left sides is the right one in floats.
    asked = demand(batch_compute_s=0.1, buffer_s=allowed_s, sync_compute_s=0.1, lead_s=allowed_s)
    offered = resources(**offered)

    last = inequality(number, agents=breaks_at - 1, asked=asked, offered=offered)

    assert last.breaks_at == breaks_at
    assert last.holds
    assert last.margin == pytest.approx(0.0, abs=1e-12)
    assert last.margin >= 0.0
    assert not inequality(number, agents=breaks_at, asked=asked, offered=offered).holds


def test_latency_beyond_the_buffer_breaks_at_the_first_agent():
    assert inequality("2.7", offered=resources(latency_s=11.0)).breaks_at == 1


def test_wire_bytes_add_headers_for_every_datagram():
    assert [wire_bytes(size) for size in (0, 1, FRAGMENT_BYTES_MAX, FRAGMENT_BYTES_MAX + 1)] == [
        HEADERS,
        1 + HEADERS,
        1400 + 28,
        FRAGMENT_BYTES_MAX + 1 + 2 * HEADERS,
    ]


def test_empty_messages_have_headers_to_carry():
    empty = (Flow(name="empty", message_bytes=0, rate_hz=10_000),)

    item = inequality("2.10", agents=3, asked=demand(**WITHOUT, flows=empty))

    assert item.left == pytest.approx(3 * 10_000 * HEADERS)


def test_infinity_becomes_null():
    assert finite(math.inf) is None
    assert finite(1.5) == 1.5


WITHOUT = {"sync_bytes": 0, "sync_compute_s": 0.0, "sync_rate_hz": 0.0, "lead_s": 0.0}


def test_inequalities_of_maneuvers_do_not_apply_without_any():
    result = judge(demand(**WITHOUT), resources(), agents=10, tick_hz=10.0)

    applies = {item.number: item.applies for item in result.inequalities}
    assert applies == {"2.7": True, "2.8": False, "2.9": False, "2.10": True}
    assert result.holds
    assert result.binding.number in ("2.7", "2.10")
    told = result.to_mapping()["inequalities"][1]
    assert (told["applies"], told["left"], told["margin"], told["holds"]) == (
        False,
        None,
        None,
        True,
    )


@pytest.mark.parametrize("name", ["sync_bytes", "sync_compute_s", "sync_rate_hz"])
def test_any_sign_of_a_maneuver_makes_them_apply(name):
    asked = demand(**WITHOUT | {name: 1})

    assert not inequality("2.9", asked=asked).holds


def test_nothing_computed_ahead_needs_no_buffer():
    asked = demand(batch_bytes=0, batch_compute_s=0.0, buffer_s=0.0)

    assert not inequality("2.7", asked=asked).applies
    assert inequality("2.7", asked=asked).holds


@pytest.mark.parametrize("each", [0.0, 5e-324, 1e-320, 1e-9, 0.1, 1.0, 1e18])
@pytest.mark.parametrize("allowed", [0.0, 1e-320, 1.0, 1e15, 1e18, 1e300, math.inf])
def test_any_pair_of_figures_has_a_limit_in_agents(each, allowed):
    item = inequality(
        "2.7", asked=demand(batch_compute_s=each, buffer_s=allowed), offered=resources(latency_s=0)
    )

    assert item.breaks_at == math.inf or 1 <= item.breaks_at <= 2**53 + 1
    assert item.breaks_at == math.inf or item.breaks_at * each > allowed
    assert json.dumps(item.to_mapping(), allow_nan=False)
