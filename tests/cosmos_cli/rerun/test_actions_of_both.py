"""Actions that took place in one of two runs alone are told, refused ones as what did not."""

import json
from types import SimpleNamespace

from cosmos_cli.rerun.actions import action_remarks


def an_event(word, number, t_s, **more):
    told = {"action": "gust", "agents": ["a"], "parameters": {"lift_m_s": 2.0}}
    return {"t_s": t_s, "event": word, "number": number, **told, **more}


def a_run(folder, *events):
    (folder / "host").mkdir(parents=True)
    lines = [json.dumps(event) for event in events]
    (folder / "host" / "events.jsonl").write_text("\n".join(lines) + "\n")
    return SimpleNamespace(path=folder)


def test_action_that_both_had_is_not_told(tmp_path):
    recorded = a_run(tmp_path / "a", an_event("action_began", 0, 1.0))
    rerun = a_run(tmp_path / "b", an_event("action_began", 0, 1.1))

    assert action_remarks(recorded, rerun) == ()


def test_action_that_neither_carried_out_is_not_told(tmp_path):
    recorded = a_run(tmp_path / "a", an_event("action_refused", 0, 1.0, reason="too early"))
    rerun = a_run(tmp_path / "b")

    assert action_remarks(recorded, rerun) == ()


def test_action_that_was_refused_in_one_of_both_took_place_in_the_other_alone(tmp_path):
    recorded = a_run(tmp_path / "a", an_event("action_began", 0, 1.0))
    rerun = a_run(tmp_path / "b", an_event("action_refused", 0, 1.0, reason="too early"))

    assert action_remarks(recorded, rerun) == (
        "1 action only on record, ordered live or by a condition: gust lift_m_s=2.0 a at 1 s",
    )
    assert action_remarks(rerun, recorded) == (
        "1 action only in the rerun: gust lift_m_s=2.0 a at 1 s",
    )
