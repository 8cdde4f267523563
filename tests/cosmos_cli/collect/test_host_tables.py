"""What a simulation tabulates of its own records: what it may not yield is told, and nobody is left out without a word."""

from __future__ import annotations

import re

import numpy as np
import pytest

from cosmos_cli.collect.host_tables import (
    Wanted,
    layout_with,
    tabulated,
    times_of,
    write_host_table,
)
from cosmos_cli.errors import InputError
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.evidence.table_layout import NO_LABELS
from madns_runtime.config import Agents, RunConfig, Timeouts
from madns_runtime.errors import PluginError

AGENTS = ("agent-01", "agent-02")
TIMES_S = np.arange(3.0)
PLUGIN = """
from dataclasses import dataclass
import numpy as np
from madns_runtime.plugin.api import AgentSimulation, Field, Simulation, Tabulated
@dataclass(frozen=True)
class Parameters:
    pass
class Agent(AgentSimulation):
    pass
def tabulate(folder, agents, times_s):
    for agent in agents:
        yield Tabulated(**{"agent": agent, "fields": (Field("x_m", "m"),), "times_s": times_s, "columns": {"x_m": times_s}, **CHANGE})
simulation = Simulation(name="p", parameters=Parameters, agent=":Agent", tabulate=":tabulate")
"""


def config_of(folder, **more):
    return RunConfig(
        run="0001-t",
        scenario="t",
        simulation="./plug.py:simulation",
        base_directory=str(folder),
        agents=Agents(count=2),
        **more,
    )


def rows(folder, change="{}", agents=AGENTS):
    (folder / "plug.py").write_text(PLUGIN.replace("CHANGE", change))
    return list(tabulated(RunDirectory(folder / "0001-t"), config_of(folder), agents, TIMES_S))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            "{'agent': 'nobody'}",
            "must yield rows of the agents that it is asked for, got those of 'nobody'",
        ),
        (
            "{'agent': agents[0], 'times_s': times_s[agents.index(agent)][None], 'columns': {'x_m': times_s[:1]}}",
            "yielded no rows of agent-02",
        ),
        ("{'agent': 'agent-01'}", "yielded more rows of agent-01 than the 3 times"),
        (
            "{'times_s': times_s[:2], 'columns': {'x_m': times_s[:2]}}",
            "must yield a row for each of 3 times, with NaN where nothing is on record; yielded 2 of agent-01, agent-02",
        ),
        ("{'times_s': times_s + 0.5}", "of agent-01 row 0 is wanted for 0 s"),
        ("{'times_s': times_s * np.nan}", "must yield rows at the times that it is asked for"),
        ("{'columns': None}", "plug.py"),
        ("{'times_s': None}", "plug.py"),
        ("{'fields': 5}", "plug.py"),
        ("{'fields': ()}", "must yield a value a time"),
        (
            "{'fields': (Field('agent'),), 'columns': {'agent': times_s}}",
            "must call no field agent",
        ),
        (
            "{'fields': (Field('t_s', 's'),), 'columns': {'t_s': times_s}}",
            "fields with distinct names",
        ),
        ("{'fields': (Field('x_m', 'm', 'odd'),)}", "expected fields of kind"),
        ("{'columns': {'x_m': np.zeros((3, 2))}}", "must yield a value a time of each of x_m"),
        ("{'columns': {'x_m': np.array(['a'] * 3, object)}}", "could not convert string to float"),
        ("{'columns': {'x_m': times_s * 1j}}", "x_m: expected real numbers, got complex128"),
    ],
)
def test_what_is_no_row_of_an_agent_is_told_with_its_place(tmp_path, change, told):
    with pytest.raises(PluginError, match=re.escape(told)) as raised:
        rows(tmp_path, change)

    assert "plug.py:" in str(raised.value)


def test_of_very_many_agents_without_rows_the_first_are_named(tmp_path):
    agents = tuple(f"agent-{number:03d}" for number in range(500))
    row = "times_s[agents.index(agent) :][:1]"
    change = f"{{'agent': 'agent-000', 'times_s': {row}, 'columns': {{'x_m': {row}}}}}"

    with pytest.raises(PluginError, match=r"no rows of agent-001, .*agent-010 and 489 more$"):
        rows(tmp_path, change, agents)


def test_rows_come_in_parts_of_several_agents_in_turn(tmp_path):
    (tmp_path / "parts").mkdir()
    halves = PLUGIN.replace(
        "for agent in agents:",
        "for times_s in (times_s[:1], times_s[1:]):\n      for agent in agents:",
    )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(f"{__name__}.PLUGIN", halves)
        found = rows(tmp_path / "parts")

    assert [part.agent for part in found] == [*AGENTS, *AGENTS]


@pytest.mark.parametrize("rate_hz", [1e9, 1e308])
def test_more_times_than_a_table_holds_are_refused(rate_hz):
    config = RunConfig(
        run="r", scenario="s", simulation="x", base_directory=".", agents=Agents(count=2)
    )
    with pytest.raises(InputError, match="times of each agent are more than 20000000"):
        times_of(config, None, rate_hz)


def test_rows_in_lists_become_arrays(tmp_path):
    found = rows(tmp_path, "{'times_s': [0, 1, 2], 'columns': {'x_m': [1, 2, 3]}}")

    assert [part.agent for part in found] == list(AGENTS)
    assert [part.columns["x_m"].tolist() for part in found] == [[1.0, 2.0, 3.0]] * 2
    assert found[0].times_s.dtype == np.float64


def written(folder, change="{}", before="pass", told=lambda what, share: None):
    """Write the table as `cosmos tabulate` does; *before* is done for each agent, before its rows are yielded."""
    code = PLUGIN.replace("for agent in agents:\n", f"for agent in agents:\n        {before}\n")
    (folder / "plug.py").write_text("import os, signal, time\n" + code.replace("CHANGE", change))
    config = config_of(folder, timeouts=Timeouts(loading_s=2.0))
    layout = layout_with(NO_LABELS)
    wanted = Wanted(agents=AGENTS, times_s=TIMES_S, path=folder / "out.parquet", layout=layout)
    return write_host_table(RunDirectory(folder / "0001-t"), config, wanted, told)


@pytest.mark.process
def test_what_a_simulation_prints_while_it_tabulates_is_cleaned_and_leaves_stdout_alone(
    tmp_path, capfd
):
    printing = "os.write(1, b'{} \\x1b[31mred\\x07\\n'); os.write(2, b'\\x1b]0;title\\n')"

    found = written(tmp_path, before=printing)
    told = capfd.readouterr()

    assert (found.rows, found.gaps) == (6, {})
    assert told.out == ""
    assert told.err == "{} \\x1b[31mred\\x07\n\\x1b]0;title\n" * 2


@pytest.mark.process
@pytest.mark.parametrize(
    ("before", "told"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", "tabulate() of ./plug.py:simulation: its process"),
        (
            "os.kill(os.getpid(), signal.SIGSEGV) if agent == agents[1] else None",
            "tabulating agent-01: its process was killed by SIGSEGV without a word",
        ),
        ("time.sleep(1000)", "tabulate(): it was not done within 2 s"),
    ],
)
def test_a_simulation_that_ends_its_process_or_hangs_while_it_tabulates_is_told(
    tmp_path, before, told
):
    with pytest.raises(PluginError, match=re.escape(told)):
        written(tmp_path, before=before)

    assert sorted(path.name for path in tmp_path.glob("*out.parquet*")) == []


@pytest.mark.process
def test_the_progress_of_a_table_is_told_agent_by_agent(tmp_path):
    told = []

    written(tmp_path, told=lambda what, share: told.append((what, share)))

    assert told == [("tabulating agent-01", 0.0), ("tabulating agent-02", 0.5)]


@pytest.mark.process
def test_what_a_simulation_may_not_yield_and_where_nothing_can_be_written_is_told_as_it_is(
    tmp_path,
):
    with pytest.raises(PluginError, match=r"plug.py:.*must yield rows of the agents"):
        written(tmp_path, "{'agent': 'nobody'}")
    (tmp_path / "out.parquet").mkdir()

    with pytest.raises(InputError, match=r"out.parquet: cannot be written"):
        written(tmp_path)
