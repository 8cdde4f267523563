"""Processors that agents were refused become remarks of the verdict."""

from harness.synthetic_run import SyntheticRun

from cosmos_cli.collect.finish import finish_run
from cosmos_cli.evidence.remarks import affinity_remarks

REFUSAL = "processors [9] refused ([Errno 22] Invalid argument); this process may use [0, 1]"


def scheduled(refusal):
    return {"scheduling": {"cpu_affinity_refusal": refusal}}


def test_agents_with_the_same_refusal_share_a_remark():
    agents = {f"agent-{number:02d}": scheduled(REFUSAL) for number in range(1, 5)}
    agents |= {"agent-05": scheduled(None), "agent-06": scheduled("other"), "agent-07": {}}

    assert affinity_remarks(agents) == (
        f"agent-[01:04]: scheduling.cpu_affinity: {REFUSAL}",
        "agent-06: scheduling.cpu_affinity: other",
    )


def test_what_is_no_mapping_is_left_alone():
    assert (
        affinity_remarks(
            {"agent-01": None, "agent-02": {"scheduling": {"cpu_affinity_refusal": 3}}}
        )
        == ()
    )


def test_verdict_of_a_run_carries_them_and_stays_what_it_is(tmp_path):
    made = SyntheticRun(tmp_path).write()
    result = made.result()
    for agent in result["agents"].values():
        agent |= scheduled(REFUSAL)

    summary = finish_run(made.run, result, made.expected)

    assert summary.exit_code == 0, summary.verdict.text
    (remark,) = summary.document["remarks"]
    assert remark.endswith(f": scheduling.cpu_affinity: {REFUSAL}")
