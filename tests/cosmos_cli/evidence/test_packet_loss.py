from harness.synthetic_run import SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.datagrams import duplicates_by_service, packet_counts
from cosmos_cli.report.build import build_sections
from madns_runtime.analysis.values import TableBlock


def agent(own, **messages):
    return {"simulation": own, "messages": messages}


def test_what_the_link_dropped_is_added_to_what_the_simulation_counted():
    own = {"service": "best", "lost": 4, "duplicated": 1, "out_of_order": 2}
    agents = {
        "a": agent(
            own,
            best={"lost": 3},
            agent={"best": {"duplicates": 10, "late": 20}, "reliable": {"duplicates": 1000}},
            host={"best": {"duplicates": 100, "late": 200}},
            host_earlier=[{"best": {"duplicates": 5, "late": 6}}],
        )
    }

    assert packet_counts(agents) == {"a": {"lost": 4, "duplicated": 116, "out_of_order": 228}}


def test_packets_in_a_stream_are_counted_by_its_fragments():
    own = {"service": "reliable", "lost": 0, "duplicated": 0, "out_of_order": 0}
    agents = {
        "a": agent(
            own,
            agent={"best": {"duplicates": 10, "late": 20}, "reliable": {"duplicates": 7}},
            host={"reliable": {"duplicates": 1}},
        )
    }

    assert packet_counts(agents) == {"a": {"lost": 0, "duplicated": 8, "out_of_order": 0}}


def test_agent_that_summed_nothing_up_has_its_links_counts():
    own = {"service": "best", "lost": 0, "duplicated": 0, "out_of_order": 0}
    dead = agent({}, best={"lost": 9}, agent={}, host={"best": {"duplicates": 2, "late": 3}})

    counts = packet_counts({"a": agent(own), "b": dead})

    assert counts["b"] == {"lost": 9, "duplicated": 2, "out_of_order": 3}


def test_what_a_fault_took_from_an_agent_that_summed_nothing_up_is_lost_too():
    own = {"service": "best", "lost": 5, "duplicated": 0, "out_of_order": 0}
    dead = agent({}, best={"lost": 9}, agent={}, host={})

    counts = packet_counts({"a": agent(own), "b": dead}, {"a": {"lost": 5}, "b": {"lost": 56}})

    assert (counts["a"]["lost"], counts["b"]["lost"]) == (5, 65)


def test_agent_that_came_back_has_lost_what_its_earlier_incarnations_lost_as_well():
    own = {"service": "best", "lost": 1, "duplicated": 0, "out_of_order": 0}
    back = agent(own, best={"lost": 2}, agent={}, host={}) | {"incarnations": 2}

    assert packet_counts({"a": back}, {"a": {"lost": 75}})["a"]["lost"] == 77


def test_loss_that_nobody_counted_is_not_told_as_none_lost():
    own = {"service": "reliable", "lost": 0, "duplicated": 0, "out_of_order": 0}
    dead = agent({}, reliable={"lost": None}, host={})

    assert packet_counts({"a": agent(own), "b": dead})["b"]["lost"] is None


def test_simulation_that_counts_no_packets_has_none():
    assert packet_counts({"a": agent({"lost": 3}), "b": agent({"service": "best"})}) == {}
    assert packet_counts({"a": agent({"satellite": "x"}, host={"best": {"late": 3}})}) == {}


def test_links_duplicates_are_summed_by_class():
    ends = {"agent": {"best": {"duplicates": 1}}, "host": {"sync": {"duplicates": 2}}}

    assert duplicates_by_service({"a": agent({}, **ends), "b": agent({}, **ends)}) == {
        "best": 2,
        "reliable": 0,
        "sync": 4,
    }


def test_summary_and_round_trip_table_tell_what_the_link_dropped(tmp_path):
    made = SyntheticRun(tmp_path).write()
    result = made.result()
    result["agents"]["agent-02"]["messages"] = {
        "agent": {"best": {"duplicates": 3, "late": 5}},
        "host": {"best": {"duplicates": 4, "late": 6}},
    }

    document = finish_run(made.run, result, made.expected).document

    assert document["packets"]["agent-02"] == {"lost": 0, "duplicated": 7, "out_of_order": 11}
    assert document["messages"]["best"]["duplicates"] == 7
    blocks = [b for s in build_sections(made.run, document) for b in s.blocks]
    (table,) = [
        b for b in blocks if isinstance(b, TableBlock) and b.title.startswith("Round trips")
    ]
    columns = [heading.text for heading in table.headings]
    rows = {row[0]: dict(zip(columns, row, strict=True)) for row in table.rows}
    told = [rows["agent-02"][name] for name in ("lost", "duplicated", "out of order")]
    assert told == [0, 7, 11]
