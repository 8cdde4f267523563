"""
What a tick costs, in counts that no other work on the machine changes much: waits, system calls, allocations, bytes.

A busy machine only lowers how many replies arrive together; the limits leave room for that, and not for a
wake-up, a call or a field more per agent.
"""

import orjson
import pytest
from harness.allocations import COMPILER, Allocations
from harness.cosmos_command import LOOSE, CosmosCommand

pytestmark = pytest.mark.process

AGENTS, TICK_HZ, DURATION_S = 16, 50, 6
PACKS = 2


@pytest.fixture(scope="module")
def evidence(runs_folder):
    cosmos = CosmosCommand(runs_folder)
    code, result = cosmos.run(
        "counter24.yaml",
        *LOOSE,
        f"agents.count={AGENTS}",
        f"agents.per_process={AGENTS}",
        f"agents.tick_hz={TICK_HZ}",
        f"time.duration_s={DURATION_S}",
        "health.period_s=5",
    )
    assert code == 0, result["verdict"]
    return result, cosmos.directory(result)


def agent_and_host(evidence):
    _, directory = evidence
    result = orjson.loads((directory / "host" / "result.json").read_bytes())
    return result["agents"]["agent-01"]["records"], result["network"], result


def test_a_pack_wakes_its_process_twice_per_period(evidence):
    records, _, _ = agent_and_host(evidence)

    # Once for the ticks and once for the answers; the rest is set-up, the account of resources and the end.
    periods = DURATION_S * TICK_HZ
    assert records["loop"]["waits"] <= 2.6 * PACKS * periods


def test_an_agents_tick_costs_one_system_call(evidence):
    records, _, _ = agent_and_host(evidence)

    loop, network = records["loop"], records["network"]
    calls = sum(loop.values()) + network["sent"] + network["received"] + network["empty_reads"]
    assert network["agents_sharing"] == AGENTS
    # Eight agents share some eight calls; one each without packs would be five.
    assert calls / (AGENTS * DURATION_S * TICK_HZ) <= 1.25


def test_a_pack_travels_as_one_packet_and_so_does_the_answer(evidence):
    records, host, _ = agent_and_host(evidence)

    # The rest is set-up, acknowledgements and the end; agents by themselves would send eight times as many.
    periods = DURATION_S * TICK_HZ
    assert records["network"]["sent"] <= 2.2 * PACKS * periods
    assert host["sent"] <= 2.2 * PACKS * periods
    assert host["received"] <= 2.2 * PACKS * periods


def test_every_message_arrived_all_the_same(evidence):
    result, _ = evidence
    agents = result["simulation"]["agents"].values()

    ran = result["timing"]["ticks"] - result["timing"]["missed"]
    assert sum(agent["returned"] for agent in agents) == ran
    assert result["messages"]["best"]["lost"] == 0


def test_a_tick_of_the_counter_takes_forty_bytes_on_the_disk(evidence):
    result, directory = evidence
    recorded = sum(
        (directory / "agents").joinpath(name, f"{stream}.jsonl").stat().st_size
        for name in result["simulation"]["agents"]
        for stream in ("ticks", "round_trips")
    )

    assert recorded / result["timing"]["ticks"] <= 40


def test_an_agent_by_itself_waits_twice_per_tick_and_costs_five_system_calls(runs_folder):
    cosmos = CosmosCommand(runs_folder)
    settings = ("agents.count=2", "agents.tick_hz=20", f"time.duration_s={DURATION_S}")
    code, result = cosmos.run("counter24.yaml", *LOOSE, *settings, "health.period_s=0.1")
    assert code == 0, result["verdict"]
    records, _, _ = agent_and_host((result, cosmos.directory(result)))

    # Until the tick and until the answer; set the timer, wait, send, wait, receive. The rest is set-up, clock and end.
    # What the process uses is recorded every other tick, in a wake-up that is for the tick anyway.
    loop, network = records["loop"], records["network"]
    calls = sum(loop.values()) + network["sent"] + network["received"] + network["empty_reads"]
    ticks = DURATION_S * 20
    assert loop["waits"] <= 2.6 * ticks
    assert calls <= 6.8 * ticks


@pytest.mark.skipif(COMPILER is None, reason="no C compiler (Debian: gcc) to count allocations by")
def test_a_tick_makes_so_many_allocations_and_no_more(tmp_path):
    agents, lengths_s = 8, (2, 6)
    made = []
    for duration_s in lengths_s:
        folder = tmp_path / f"{duration_s}"
        folder.mkdir()
        allocations = Allocations(folder)
        cosmos = CosmosCommand(folder, **allocations.environment)
        settings = (f"agents.count={agents}", f"agents.per_process={agents}", "health.period_s=60")
        rate = (f"agents.tick_hz={TICK_HZ}", f"time.duration_s={duration_s}")
        code, result = cosmos.run("counter24.yaml", *LOOSE, *settings, *rate)
        assert code == 0, result["verdict"]
        events = cosmos.directory(result) / "agents" / "agent-01" / "events.jsonl"
        lines = map(orjson.loads, events.read_bytes().splitlines()[1:])
        pid = next(line["pid"] for line in lines if line.get("event") == "start")
        made.append((allocations.of(pid), result["timing"]["ticks"] - result["timing"]["missed"]))
    (before, ticks_before), (after, ticks_after) = made

    # Step, message there and back, two records and the account of it; what set-up made is taken off.
    assert 20 < (after - before) / (ticks_after - ticks_before) <= 150
