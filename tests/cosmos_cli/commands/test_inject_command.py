"""`cosmos inject`: values below zero, words that are no options, orders that have no line."""

import json

import pytest

from cosmos_cli.commands import inject as module
from cosmos_cli.commands.command_group import load_command
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.launch.order_socket import order_action


@pytest.fixture
def ordered(monkeypatch, tmp_path):
    """What was ordered of a run that takes everything."""
    found = []
    monkeypatch.setattr(module, "find_run", lambda root, run: RunDirectory(tmp_path))
    monkeypatch.setattr(module, "order_fault", lambda path, name, fault: found.append(fault) or "")
    return found


def inject(*words, options=("--quiet",)):
    command = load_command("inject")
    with command.make_context("inject", [*words, *options]) as context:
        return command.invoke(context)


@pytest.mark.usefixtures("ordered")
@pytest.mark.parametrize(
    ("words", "line", "is_carried_out_by_agents"),
    [
        (("run", "annotate", "text=hello"), "run annotate: begun", False),
        (("agent-01", "sensor_fault", "sensor=gnss"), "agent-01 sensor_fault: begun", True),
        (("here/load", "freeze"), "here/load freeze: in force", False),
    ],
)
def test_what_an_agent_may_yet_refuse_is_not_told_as_in_force(
    monkeypatch, capsys, words, line, is_carried_out_by_agents
):
    monkeypatch.setattr(module, "order_action", lambda path, name, order: {"refusal": ""})

    assert inject("last", *words, options=()) == 0
    out, err = capsys.readouterr()
    assert out == f"{line}\n"
    assert ("tells so in its own events" in err) is is_carried_out_by_agents


@pytest.mark.usefixtures("ordered")
@pytest.mark.parametrize("text", ["[ok] done", "@home", "100%: it's done", "'", "a: b", "% left"])
def test_a_text_that_is_no_yaml_is_taken_as_it_was_typed(monkeypatch, text):
    orders = []
    answer = {"refusal": ""}
    monkeypatch.setattr(
        module, "order_action", lambda path, name, order: orders.append(order) or answer
    )

    assert inject("last", "run", "annotate", f"text={text}") == 0
    (order,) = orders
    assert text in (order["parameters"]["text"], order["texts"].get("text"))


@pytest.mark.parametrize(
    ("target", "agents"),
    [
        ("IRIDIUM 8", ["agent-02"]),
        ("IRIDIUM*", ["agent-01", "agent-02"]),
        ("ISS/ZARYA", ["agent-03"]),
        ("*", []),
        ("agent-0*", []),
    ],
)
def test_agents_are_found_by_their_second_names(monkeypatch, tmp_path, ordered, target, agents):
    names = {"agent-01": "IRIDIUM 7", "agent-02": "IRIDIUM 8", "agent-03": "ISS/ZARYA"}
    plan = {"labels": {"column": "satellite", "names": names}}
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    orders = []
    monkeypatch.setattr(
        module, "order_action", lambda path, name, order: orders.append(order) or {"refusal": ""}
    )

    assert inject("last", target, "slow", "factor=2") == 0
    assert [(order["target"], order["agents"]) for order in orders] == [(target, agents)]
    assert not ordered


@pytest.mark.parametrize("value", ["-5", "-0.5", "-1e-3", "-.25", "5"])
def test_a_value_below_zero_is_a_value(ordered, value):
    assert inject("last", "here/load", "bias", value) == 0
    assert ordered == [("here/load", "bias", float(value))]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("last", "here/load", "delay", "-5"), "delay: expected the time by which"),
        (("last", "here/load", "freeze", "--lst"), "no such option: --lst; see `cosmos inject --h"),
        (("last", "-x"), "no such option: -x"),
        (("--lst", "last"), "no such option: --lst"),
        (("last", "run", "annotate", "text=.nan"), "^text: expected a finite number, got .nan"),
        (("last", "run", "annotate", f"text={2**70}"), "^text: expected a whole number from"),
    ],
)
def test_what_is_neither_value_nor_option_is_refused(ordered, words, told):
    with pytest.raises(InputError, match=told):
        inject(*words)
    assert ordered == []


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("x" * 70_000, "0007-tiny: expected an order of at most 65536 bytes, got 700"),
        (2**70, "0007-tiny: no order: Integer exceeds 64-bit range"),
    ],
)
def test_an_order_that_has_no_line_is_refused_before_anybody_is_asked(tmp_path, text, told):
    with pytest.raises(InputError, match=told):
        order_action(tmp_path, "0007-tiny", {"target": "run", "parameters": {"text": text}})
